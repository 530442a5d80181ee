"""Reading: state of reading a mesh file: the files that it may reference, and its notes."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtwin.budget import check_decoded

Note = tuple[str, bool]
"""A note for the user on a file, and whether something of the file was left out."""


@dataclass(frozen=True)
class Reading:
    """A mesh file while it is read."""

    path: Path

    may_read: Callable[[Path], bool]
    """Whether a referenced file (material library, texture, buffer) may be read."""

    notes: list[Note] = field(default_factory=list)
    """Repairs, guesses and omissions, each once."""

    spent: list[int] = field(default_factory=lambda: [0])
    """Bytes of its decoded arrays so far."""

    def spend(self, count: int) -> bool:
        """Count bytes of decoded arrays against the file's budget; True if they are within.

        Raises:
            InputError: The file decodes to more than it may.
        """
        self.spent[0] += count
        check_decoded(self.path, self.path.stat().st_size, self.spent[0])
        return True

    def note(self, text: str, *, lost: bool = False) -> None:
        """Add a note on a repair or guess, or an omission if `lost`."""
        note = (f"{self.path.name}: {text}", lost)
        if note not in self.notes:
            self.notes.append(note)

    def lose(self, text: str) -> None:
        """Add a note on an omission."""
        self.note(text, lost=True)


def numbers(text: str, dtype: type) -> NDArray:
    """Numbers separated by blanks, up to the first invalid word, shape (N,)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # for an invalid word
        try:
            return np.fromstring(text, dtype, sep=" ")
        except ValueError:
            return np.empty(0, dtype)
