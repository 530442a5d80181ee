"""Case: one run of a benchmark, as a localizer gets it, and the truth that it is scored by."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.localization.problem import FieldBelief, Problem
from magtwin.run.run import Run

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Truth:
    """What no localizer is told."""

    t: Array
    """Times of the readings [s], shape (N,)."""

    pose: Array
    """x, y [m] and yaw [rad] of base_link in world, shape (N, 3)."""

    field: FieldBelief | None = None
    """The field of the surveying robot; None if only readings are known."""

    kidnapped_s: tuple[float, ...] = ()
    """Times at which the robot was put elsewhere [s]."""

    scale_m: float | None = None
    """Distance over which the field changes [m], by which errors are near or far. None: that of a room."""


@dataclass(frozen=True, eq=False)
class Case:
    """A problem, its readings and its truth."""

    problem: Problem
    """What the localizer is told."""

    readings: Run
    """On-board columns."""

    truth: Truth
    """Poses at the readings."""
