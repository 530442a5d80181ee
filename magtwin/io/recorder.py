"""Recorder: a run that goes on, appended block by block to files and a live viewer at once."""

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Event
from types import TracebackType
from typing import Protocol

import numpy as np

from magtwin.errors import InputError
from magtwin.run.run import Run

PARTIAL = ".partial"
"""What stands before the ending of a file's name until the run in it has ended."""

FLUSH_S = 0.5
"""How long files wait for their next rows [s]: what a process that is killed loses at most."""

TICK_S = 0.05
"""Time between blocks of a run that is emitted in step with the clock [s]."""


def partial_of(path: Path) -> Path:
    """Where a file lies until it is complete: run.partial.rrd for run.rrd."""
    return path.with_name(f"{path.stem}{PARTIAL}{path.suffix}")


class Sink(Protocol):
    """What takes a run as it comes, such as RrdWriter, ParquetParts, BagWriter."""

    def append(self, run: Run) -> None:
        """Take the next rows, with the metadata; whatever happens, they can be read from then on."""

    def close(self) -> None:
        """Complete what was written, and give it its name: no rows come any more."""

    def abort(self) -> None:
        """Let go of it: what was written stays as it is, and where nothing was, nothing does."""


class Recorder:
    """A run on its way into several sinks at once.

    The end of the `with` block completes them. Any fault leaves the files as they are, under names that
    tell that they are unfinished; they can be read up to their last rows.
    """

    def __init__(self, files: Sequence[Sink], viewers: Sequence[Sink] = ()) -> None:
        """Begin.

        Args:
            files: Those that are given rows every `FLUSH_S`, for what each block costs them.
            viewers: Those that are given every block at once.
        """
        self._files, self._viewers = list(files), list(viewers)
        self._waiting: list[Run] = []
        self._flushed = time.monotonic()
        self.rows = 0
        """Rows appended so far."""

    def append(self, run: Run) -> None:
        """The next rows, a slice of the run: its columns and metadata.

        Raises:
            InputError: A sink cannot take them; the text says which and why.
        """
        if not run.rows:
            return
        self.rows += run.rows
        self._waiting.append(run)
        for viewer in self._viewers:
            viewer.append(run)
        if time.monotonic() - self._flushed >= FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Give the files what they have not got yet.

        Raises:
            InputError: As for `append`.
        """
        self._flushed = time.monotonic()
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        first = waiting[0]
        columns = {name: np.concatenate([run[name] for run in waiting]) for name in first}
        block = Run(columns, first.metadata, first.specs)
        for file in self._files:
            file.append(block)

    def __enter__(self) -> "Recorder":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        sinks = [*self._files, *self._viewers][::-1]
        if kind is None:
            try:
                self.flush()
                for sink in list(sinks):
                    sink.close()
                    sinks.remove(sink)
                return
            finally:
                self._abort(sinks)
        self._abort(sinks)

    def _abort(self, sinks: Sequence[Sink]) -> None:
        """Let go of what cannot be completed any more."""
        for sink in sinks:
            with suppress(InputError, OSError, RuntimeError):
                sink.abort()


def in_step(run: Run, pace: float = 1.0, *, stop: Event | None = None) -> Iterator[Run]:
    """A run in blocks, each at its time on the clock.

    Args:
        run: What happened.
        pace: Simulated seconds a second of the clock, above 0; inf waits for nothing.
        stop: Ends it when set, at once.

    Raises:
        InputError: The pace is not above 0.
    """
    if not pace > 0:
        raise InputError(f"pace must be above 0 simulated seconds a second, got {pace:g}")
    stop = stop or Event()
    t, begun, sent = run["t"], time.monotonic(), 0
    while sent < run.rows and not stop.is_set():
        now = time.monotonic() - begun
        end = int(np.searchsorted(t, t[0] + now * pace, side="right")) if np.isfinite(pace) else run.rows
        if end == sent:
            stop.wait(max(TICK_S / 5, (t[sent] - t[0]) / pace - now))
            continue
        yield run.take(slice(sent, end))
        sent = end
        stop.wait(TICK_S)
