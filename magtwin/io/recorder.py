"""Recorder: a run that goes on, appended block by block to files and a live viewer at once."""

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Protocol

from magtwin.names import RefusedError
from magtwin.run import Run

PARTIAL = ".partial"
"""What stands before the ending of a file's name until the run in it has ended."""

FLUSH_S = 0.5
"""Length of the blocks that are appended [s]: what a process that is killed loses at most, and then some."""

LIVE_S = 0.05
"""Length of the blocks that a viewer is shown [s]."""


def partial_of(path: Path) -> Path:
    """Where a file lies until it is complete: run.partial.rrd for run.rrd."""
    return path.with_name(f"{path.stem}{PARTIAL}{path.suffix}")


class Sink(Protocol):
    """What takes a run as it comes."""

    def append(self, run: Run) -> None:
        """The next rows, with the facts; what they hold can be read from then on, whatever happens."""

    def close(self) -> None:
        """No rows come any more: complete what is written, and give it its name."""


class Recorder:
    """A run on its way to several sinks. The end of the block completes them, also one by Ctrl-C.

    Whatever else ends it leaves the files as they are, under names that tell that they are unfinished; they
    can be read up to the last block.
    """

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = list(sinks)
        self.rows = 0
        """Rows appended so far."""

    def __enter__(self) -> "Recorder":
        return self

    def append(self, run: Run) -> None:
        """The next rows, to every sink.

        Raises:
            RefusedError: A sink cannot take them; the text says which and why.
        """
        if not run.rows:
            return
        for sink in self._sinks:
            sink.append(run)
        self.rows += run.rows

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None or issubclass(kind, KeyboardInterrupt):
            for sink in self._sinks:
                sink.close()
            return
        for sink in self._sinks:
            with suppress(RefusedError, OSError, AttributeError):
                sink.abandon()  # type: ignore[attr-defined]
