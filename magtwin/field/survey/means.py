"""Means: readings of a drive that lie together and count as one."""

import numpy as np
from numpy.typing import NDArray

from magtwin.field.survey.bins import bin_readings
from magtwin.field.survey.readings import Readings
from magtwin.frames import wrap_angle

CELL = 1 / 6
"""Way along which the readings of a drive are averaged, in the first layer's depth."""

TURN_M = 0.1
"""Way that a turn of 1 rad counts as [m]."""

MOST_MEANS = 900
"""Means along its way that a drive gives at most; the way of each grows until they are so few."""

LONGEST = 0.75
"""Way of a mean, in the first layer's depth, beyond which passes of one place are averaged together."""

BIN = 2 / 3
"""Side of the squares of the floor in which they are, in the first layer's depth."""

SECTORS = 4
"""Sectors of heading that stay apart in a square."""

MOST_BINS = 1800
"""Means of squares and sectors at most; the squares grow until they are so few."""

WIDEN = 1.1


def means(good: Readings, depth_m: float) -> tuple[NDArray[np.intp], bool]:
    """Which mean each reading belongs to, and whether means that follow each other were read so.

    A reading of a gridded survey stands alone. Those of a drive are averaged along the way. A long drive
    passes each place often: its readings are averaged by place and heading instead, all passes together, for
    means along so long a way would blur the field.

    Args:
        good: Good readings of a survey.
        depth_m: Depth of the first layer of dipoles below the sensor [m].

    Returns:
        Number of the mean of each reading, from 0 up without gaps, shape (N,); and whether the means are
        those along the way of a drive, in its order.
    """
    if good.node is not None:
        return np.arange(len(good)), False
    along = _along(good, CELL * depth_m, LONGEST * depth_m)
    return (_in_squares(good, BIN * depth_m), False) if along is None else (along, True)


def _along(good: Readings, way_m: float, longest_m: float) -> NDArray[np.intp] | None:
    """Means along the way; None where they would be longer than `longest_m`."""
    order = np.lexsort((np.arange(len(good)) if good.t is None else good.t, good.run))
    step = np.linalg.norm(np.diff(good.p_xy[order], axis=0), axis=1)
    step += TURN_M * np.abs(wrap_angle(np.diff(good.yaw[order])))
    other = np.diff(good.run[order]) != 0
    way = np.concatenate([[0.0], np.cumsum(step)])
    while way_m <= longest_m:
        stretch = np.floor(way / way_m).astype(np.int64)
        new = (np.diff(stretch) != 0) | other
        if np.count_nonzero(new) < MOST_MEANS:
            cell = np.empty(len(good), np.intp)
            cell[order] = np.concatenate([[0], np.cumsum(new)])
            return cell
        way_m *= WIDEN
    return None


def _in_squares(good: Readings, side_m: float) -> NDArray[np.intp]:
    """Means of squares of the floor and sectors of heading."""
    while True:
        bins, cell = bin_readings(good, side_m, sectors=SECTORS)
        if len(bins.count) <= MOST_BINS:
            return np.asarray(cell)
        side_m *= WIDEN
