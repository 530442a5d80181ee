"""Reading: state of reading a mesh file: the files that it may reference, and its notes."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.budget import BUDGETS, check_decoded

Note = tuple[str, bool]
"""A note for the user on a file, and whether something of the file was left out."""

MOST_NOTES = 1_000
"""Most notes on a file."""


@dataclass
class Images:
    """Images that were decoded, of one file or of all files of a robot."""

    decoded: dict[bytes, Any] = field(default_factory=dict)
    """What became of each, by the hash of its bytes."""

    size: int = 0
    """Bytes of their files."""

    pixels: int = 0


@dataclass(frozen=True)
class Reading:
    """A mesh file while it is read."""

    path: Path

    may_read: Callable[[Path], bool]
    """Whether a referenced file (material library, texture, buffer) may be read."""

    images: Images = field(default_factory=Images)
    """Its images, with those of other files if they share it."""

    notes: dict[Note, None] = field(default_factory=dict)
    """Repairs, guesses and omissions in order, each once."""

    spent: list[int] = field(default_factory=lambda: [0])
    """Bytes of its decoded arrays so far."""

    visited: list[int] = field(default_factory=lambda: [0])
    """Nodes, and what they show, that were visited so far."""

    def spend(self, count: int) -> bool:
        """Count bytes of decoded arrays against the file's budget; True if they are within.

        Raises:
            InputError: The file decodes to more than it may.
        """
        self.spent[0] += count
        check_decoded(self.path, self.path.stat().st_size, self.spent[0])
        return True

    def visit(self, count: int = 1, where: object = None) -> None:
        """Count nodes, and what they show as often as they show it, against the budget of a mesh.

        Raises:
            InputError: The file shows more than it may.
        """
        self.visited[0] += count
        most = BUDGETS["mesh"].count
        if self.visited[0] > most:
            raise InputError(f"{where or self.path}: shows over {most} nodes; export it again")

    def note(self, text: str, *, lost: bool = False) -> None:
        """Add a note on a repair or guess, or an omission if `lost`."""
        if len(self.notes) >= MOST_NOTES:
            text = f"over {MOST_NOTES} notes; the others are left out"
        self.notes[f"{self.path.name}: {text}", lost] = None

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
