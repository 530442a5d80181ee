"""Recorder: append a growing run, block by block, to files and live viewers."""

import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Event
from typing import Protocol, Self

import numpy as np

from magtwin.errors import InputError
from magtwin.run.run import Run

PARTIAL = ".partial"
"""Inserted before the suffix of a file until its run has ended."""

FLUSH_S = 0.5
"""Time between writes to files [s], which is the most that a killed process loses."""

TICK_S = 0.05
"""Time between blocks of a run that is played in real time [s]."""


def partial_of(path: Path) -> Path:
    """Path of a file until it is complete: run.partial.rrd for run.rrd."""
    return path.with_name(f"{path.stem}{PARTIAL}{path.suffix}")


class Sink(Protocol):
    """Takes a growing run, such as RrdWriter, ParquetParts, BagWriter; a context ends it."""

    def append(self, run: Run) -> None:
        """Take the next rows, with the metadata; from then on they are readable, whatever happens."""

    def close(self) -> None:
        """Complete the output and give it its name."""

    def abort(self) -> None:
        """Leave the output as it is, or nothing if nothing was written."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        (self.close if kind is None else self.abort)()


class Recorder:
    """Writes a growing run to several sinks.

    The end of the `with` block completes them. An error leaves the files under their partial names, readable
    up to their last rows.
    """

    def __init__(self, files: Sequence[Sink], viewers: Sequence[Sink] = ()) -> None:
        """Start.

        Args:
            files: Sinks that get rows every `FLUSH_S`.
            viewers: Sinks that get every block at once.
        """
        self._files, self._viewers = list(files), list(viewers)
        self._waiting: list[Run] = []
        self._flushed = time.monotonic()
        self.rows = 0
        """Number of rows so far."""

    def append(self, run: Run) -> None:
        """Append the next rows of the run.

        Raises:
            InputError: A sink cannot take them.
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
        """Write all waiting rows to the files.

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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        sinks = [*self._files, *self._viewers][::-1]
        try:
            if kind is None:
                self.flush()
                while sinks:
                    sinks[0].close()
                    sinks.pop(0)
        finally:
            for sink in sinks:
                with suppress(InputError, OSError, RuntimeError):
                    sink.abort()


def in_step(run: Run, pace: float = 1.0, *, stop: Event | None = None) -> Iterator[Run]:
    """A run in blocks, each at its time.

    Args:
        run: The run.
        pace: Simulated seconds per second, above 0; inf does not wait.
        stop: Ends it at once when set.

    Raises:
        InputError: The pace is not above 0.
    """
    if not pace > 0:
        raise InputError(f"pace must be above 0 simulated seconds per second, got {pace:g}")
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
