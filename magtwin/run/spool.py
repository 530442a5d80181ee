"""Spool: a run that is made and read block by block."""

from collections.abc import Iterator
from typing import Any

from numpy.typing import NDArray

from magtwin.run import mapped
from magtwin.run.run import Run


class Spool:
    """A run that grows block by block to a known number of rows: in memory, or mapped if it is long."""

    def __init__(self, rows: int) -> None:
        """Begin a run."""
        self._rows, self._done = rows, 0
        self._columns: dict[str, NDArray[Any]] = {}
        self._last: Run | None = None

    def append(self, block: Run) -> None:
        """Add the next rows; those of all blocks have the same columns.

        Raises:
            InputError: The disk has no room for the run.
        """
        self._last, first = block, self._done
        self._done += block.rows
        if block.rows == self._rows:
            self._columns = dict(block.columns)
            return
        for name, values in block.items():
            if not first:
                self._columns[name] = mapped.empty((self._rows, *values.shape[1:]), values.dtype)
            self._columns[name][first : self._done] = values
        mapped.release()

    @property
    def run(self) -> Run:
        """The whole run, with the metadata of its last block."""
        assert self._last is not None
        assert self._done == self._rows
        return Run(self._columns, self._last.metadata, self._last.specs)


def blocks(run: Run, rows: int = 0) -> Iterator[Run]:
    """A run in blocks of rows, at least one; the memory of each is given back after it."""
    rows = rows or (mapped.BLOCK if run.rows > mapped.LONG else max(run.rows, 1))
    for first in range(0, max(run.rows, 1), rows):
        yield run.take(slice(first, first + rows))
        if run.rows > mapped.LONG:
            mapped.release()
