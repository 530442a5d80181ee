"""A drawing: lines on layers, as a reader of a format gives them."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Line:
    """A polyline of a drawing."""

    p: Array
    """Points in units of the drawing, y up, shape (N, 2)."""

    closed: bool = False
    layer: str = ""
    """Names that say what it is: its layer, group, class or properties."""

    width: float = 0.0
    """Width of the stroke in units of the drawing; 0 if it is not known."""

    arc: bool = False
    """Whether it is the swing of a door: hinge, and both ends of an arc about it."""


@dataclass(eq=False)
class Drawing:
    """Lines, and how large they are."""

    lines: list[Line] = field(default_factory=list)

    metres: float | None = None
    """Metres per unit, as the file states it; None if it does not."""

    stated: str = ""
    """Where the file states it, or what is missing."""

    notes: list[str] = field(default_factory=list)
    """What was left out or straightened."""
