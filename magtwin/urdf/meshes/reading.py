"""Reading: a mesh file while it is read, what it may name, and what was found wrong with it."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Note:
    """Something that a user ought to know of a file."""

    text: str

    lost: bool = False
    """Whether less arrives than the file holds."""


@dataclass(frozen=True)
class Reading:
    """A mesh file while it is read."""

    path: Path

    may_read: Callable[[Path], bool]
    """Whether a file that this one names (a material library, a texture, a buffer) may be read."""

    notes: list[Note] = field(default_factory=list)
    """What was repaired, guessed or left out, each once."""

    def note(self, text: str, *, lost: bool = False) -> None:
        """Put down what was repaired or guessed, or, where `lost`, left out."""
        note = Note(f"{self.path.name}: {text}", lost)
        if note not in self.notes:
            self.notes.append(note)

    def lose(self, text: str) -> None:
        """Put down what was left out."""
        self.note(text, lost=True)


def numbers(text: str, dtype: type) -> NDArray:
    """Numbers apart by blanks, up to the first word that is none, shape (N,): quicker than one by one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a word that is none
        try:
            return np.fromstring(text, dtype, sep=" ")
        except ValueError:
            return np.empty(0, dtype)
