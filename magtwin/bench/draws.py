"""Draws: the odometry and the prior of a case, from its random generator."""

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.localization.problem import HEADING_WITHIN, OdometryModel, Prior

Array = NDArray[np.float64]

Start = Literal["tracking", "heading", "global"]
"""What is known of the first pose: all of it to 0.1 m and 5 deg, the heading within 10 deg, or nothing."""

WITHIN = math.radians(10)
"""Largest error of a known heading."""


def moves(pose: Array) -> Array:
    """Increments between poses: forward, leftward [m] and turn [rad], in axes halfway through the turn."""
    turn = np.diff(pose[:, 2])
    middle = pose[:-1, 2] + turn / 2
    dx, dy = np.diff(pose[:, 0]), np.diff(pose[:, 1])
    c, s = np.cos(middle), np.sin(middle)
    return np.column_stack([dx * c + dy * s, dy * c - dx * s, turn])


def chained(steps: Array) -> Array:
    """Poses from (0, 0, 0) by increments; the inverse of `moves`."""
    yaw = np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    middle = yaw[:-1] + steps[:, 2] / 2
    c, s = np.cos(middle), np.sin(middle)
    xy = np.column_stack([steps[:, 0] * c - steps[:, 1] * s, steps[:, 0] * s + steps[:, 1] * c])
    return np.column_stack([np.vstack([[0.0, 0.0], np.cumsum(xy, axis=0)]), yaw])


def noisy_odometry(pose: Array, t: Array, model: OdometryModel, rng: np.random.Generator) -> Array:
    """Odometry of a true trajectory with the errors of a model.

    Args:
        pose: True x, y [m] and yaw [rad], shape (N, 3).
        t: Times [s], shape (N,).
        model: The errors.
        rng: Source of the errors.

    Returns:
        Poses in odom, from (0, 0, 0), shape (N, 3).
    """
    steps = moves(pose)
    scale = 1.0 + model.scale_std * rng.standard_normal()
    sd = np.sqrt(model.variances(np.hypot(steps[:, 0], steps[:, 1]), steps[:, 2], np.diff(t)))
    noise = sd * rng.standard_normal(steps.shape)
    steps[:, :2] *= scale
    return chained(steps + noise)


def drawn_prior(start: Start, first: Array, rng: np.random.Generator) -> Prior:
    """A prior whose mean errs as its standard deviation states.

    Args:
        start: What is known.
        first: True x, y [m] and yaw [rad] at the first reading, shape (3,).
        rng: Source of the errors.
    """
    x, y, yaw = (first + Prior().sd * rng.standard_normal(3)).tolist()
    within = float(rng.uniform(-WITHIN, WITHIN))
    if start == "tracking":
        return Prior(mean=(x, y, yaw))
    if start == "heading":
        return Prior(mean=(0.0, 0.0, float(first[2]) + within), sd=(math.inf, math.inf, HEADING_WITHIN))
    return Prior(sd=(math.inf, math.inf, math.inf))
