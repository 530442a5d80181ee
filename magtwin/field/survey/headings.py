"""Headings of a survey: which ones were driven, and how far any other lies between them."""

import numpy as np
from numpy.typing import NDArray

from magtwin.field.grid import TURN

Array = NDArray[np.float64]

FAR_TURN = np.radians(60.0)
"""Gap between headings from which what lies in it counts as not surveyed."""

TURN_SECTORS = 24
"""Sectors into which headings are parted to see where a scattered survey has none."""

STRAY = 0.05
"""Largest share of the readings that a heading may have and still be ignored."""


def surveyed(yaw: Array) -> tuple[Array, NDArray[np.intp]]:
    """Group headings that lie together.

    Args:
        yaw: Headings of the readings [rad], shape (N,).

    Returns:
        Mean heading of each group [rad], ascending, shape (H,); and the group of each reading, -1 for a
        stray one, shape (N,). No groups where the headings are all around, or where there are fewer than 3.
    """
    angle = np.mod(yaw, TURN)
    sorted_angles = np.sort(angle)
    gap = np.diff(np.append(sorted_angles, sorted_angles[0] + TURN))
    wide = gap > TURN / TURN_SECTORS
    none = np.empty(0), np.full(len(yaw), -1)
    if gap.max() < FAR_TURN:
        return none
    edges = np.sort(np.mod(sorted_angles[wide] + gap[wide] / 2, TURN))
    group = np.searchsorted(edges, angle) % len(edges)
    count = np.bincount(group, minlength=len(edges))
    whole = np.flatnonzero(count > STRAY * len(yaw))
    if len(whole) < 3:
        return none
    mean = np.array([np.angle(np.exp(1j * angle[group == k]).sum()) for k in whole]) % TURN
    order = np.argsort(mean)
    rank = np.full(len(edges), -1)
    rank[whole[order]] = np.arange(len(whole))
    return mean[order], rank[group]


def between(headings_rad: Array, yaw: Array) -> Array:
    """(d g)^2, where d and g are the angles from a heading to the nearest surveyed one on each side.

    Args:
        headings_rad: Surveyed headings [rad], shape (H,); with none of them the result is 0.
        yaw: Headings to look at [rad], shape (N,).

    Returns:
        Squared product of the two angles [rad^4], shape (N,).
    """
    if not len(headings_rad):
        return np.zeros(len(yaw))
    up = np.mod(headings_rad[:, None] - yaw, TURN).min(axis=0)
    down = np.mod(yaw - headings_rad[:, None], TURN).min(axis=0)
    return np.asarray((up * down) ** 2)
