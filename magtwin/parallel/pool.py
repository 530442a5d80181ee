"""What all pools have in common: outcomes of chunks, time limits, retries."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Literal, Protocol, Self, TypeVar, cast

from magtwin.errors import InputError

C = TypeVar("C")
R = TypeVar("R")

RETRIES = 2
"""How often a chunk is tried again after its worker was killed or crashed."""


@dataclass(frozen=True)
class Failure:
    """Why a chunk has no result."""

    kind: Literal["raised", "late", "lost"]
    """The function raised an exception; its time limit passed; or its worker ended, on every try."""

    reason: str
    """The same in one line."""

    trace: str = ""
    """Traceback of the exception in the worker."""

    refused: InputError | None = None
    """The exception, if it is a refusal of wrong input."""

    at: str = ""
    """What the function last said to `beat`."""


@dataclass(frozen=True)
class Outcome(Generic[R]):
    """The result of one chunk."""

    index: int
    """Number of the chunk in the sequence."""

    value: R | None = None
    """What the function returned."""

    failure: Failure | None = None
    """None if it returned."""

    def result(self) -> R:
        """The value.

        Raises:
            InputError: The function refused its input.
            WorkerError: The chunk failed in another way.
        """
        if self.failure is None:
            return cast(R, self.value)
        if self.failure.refused is not None:
            raise self.failure.refused
        text = f"chunk {self.index}: {self.failure.reason}"
        raise WorkerError(f"{text}\n{self.failure.trace}" if self.failure.trace else text)


class WorkerError(RuntimeError):
    """A chunk failed in a worker. The text has the traceback."""


class Pool(Protocol):
    """Workers; `open_pool` gives one."""

    def run(
        self,
        work: Callable[[C], R],
        chunks: Sequence[C],
        *,
        limit_s: float | None = None,
        progress: Callable[[int, int], Any] | None = None,
        heard: Callable[[int, str], Any] | None = None,
    ) -> Iterator[Outcome[R]]:
        """Call a function for every chunk; gives the outcomes in any order.

        Args:
            work: A pure function that can be pickled.
            chunks: What it is called with, one at a time.
            limit_s: Longest time of a chunk, or between two of its beats [s]. Default: no limit.
            progress: Called with the chunks done and all chunks.
            heard: Called with the number of a chunk and what its function says to `beat`; on this machine.

        Raises:
            InputError: Workers cannot start, or the cluster does not fit.
        """
        ...

    def close(self) -> None:
        """End all workers at once."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...
