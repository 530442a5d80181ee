"""Hold: find loggers that are faster than the magnetometer, and keep one reading of each value.

Such a logger writes each value several times in a row. The repeats are no independent readings, and the
robot has moved on since the value was measured.

The lengths of groups of equal values distinguish a hold from repeats by rounding. If a value repeats the one
before by chance, the lengths have a geometric distribution, with variance m (m - 1) about the mean m. A
logger that is m times as fast as the sensor makes lengths near m, with variance 1/4 at most if both clocks
are regular.
"""

import numpy as np
from numpy.typing import NDArray

from magtwin.field.survey.readings import TAKEN, Readings

Rows = NDArray[np.intp]

LEAST_GROUPS = 24  # Fewest groups of equal values whose lengths are tested
LEAST_MEAN = 1.35  # Least mean length of groups in a hold; below it, holds and chance look alike
REGULAR = 0.5  # Variance of the lengths, as a share of that by chance, below which they are regular
LONG = 4.0  # Lengths above this many medians are those of a robot that waited or a stuck sensor
DIGITS = 6  # Decimals of a magnitude [nT] that are compared; further ones are floating-point errors


STUCK = 4.0  # Factor above the longest repeat by chance from which a value counts as stuck
LEAP = 2.0  # Factor above large usual changes of the change by which a coarse sensor leaves such a value


def held(b_nt: NDArray[np.float64]) -> tuple[NDArray[np.bool_], Rows, float]:
    """Which groups of equal values are too long for chance and for a fast logger.

    A sound coarse sensor leaves a value by a step, however long it stayed there. With b (N,), returns flags
    and the first rows of the groups, and the usual length.
    """
    starts = np.flatnonzero(np.append(True, np.diff(b_nt) != 0))
    lengths = np.diff(np.append(starts, len(b_nt)))
    usual = float(lengths[lengths <= LONG * np.median(lengths)].mean())
    again = min(0.99, max(0.1, 1 - 1 / usual))
    longest = max(LONG * float(np.median(lengths)), np.log(len(b_nt)) / -np.log(again))
    stuck = lengths > STUCK * longest
    if usual > LEAST_MEAN:
        jump = np.abs(np.append(np.diff(b_nt[starts]), 0.0))
        stuck &= jump > LEAP * np.quantile(jump, 0.9)
    return stuck, starts, usual


def without_repeats(readings: Readings) -> Readings:
    """Drop the repeats in runs whose logger was faster than the magnetometer.

    The first reading of each group of equal values is kept. Of a longer group than the logger makes, one
    reading per usual length is kept, so that a stuck sensor still shows.

    A gridded survey is returned as it is. The `source` of the result gives the number of readings that are
    kept.
    """
    if readings.grid is not None:
        return readings
    kept, lengths = np.ones(len(readings), bool), list[float]()
    for rows in in_order(readings):
        starts = np.flatnonzero(np.append(True, ~repeats(readings, rows)))
        size = np.diff(np.append(starts, len(rows)))
        usual = size[size <= LONG * np.median(size)]
        mean = float(usual.mean())
        if len(usual) < LEAST_GROUPS or mean < LEAST_MEAN or usual.var() > REGULAR * mean * (mean - 1):
            continue
        every = int(np.ceil(np.quantile(usual, 0.95)))
        kept[rows] = (np.arange(len(rows)) - np.repeat(starts, size)) % every == 0
        lengths.append(mean)
    if not lengths:
        return readings
    runs = f" in {len(lengths)} of {len(readings.runs)} runs" if len(readings.runs) > 1 else ""
    note = (
        f"{TAKEN}one reading of each value, {kept.sum()} of {len(readings)}: each value is repeated "
        f"{np.mean(lengths):.2g} times{runs}, by a logger faster than the sensor (--keep-stuck keeps all)"
    )
    return readings.take(kept).with_(source="; ".join(part for part in (readings.source, note) if part))


def in_order(readings: Readings) -> list[Rows]:
    """Good rows of each run, in the order of time; in that of the rows if there are no times."""
    good = np.flatnonzero(readings.good)
    clock = np.zeros(len(readings)) if readings.t is None else readings.t
    order = good[np.lexsort((clock[good], readings.run[good]))]
    parts = np.split(order, np.flatnonzero(np.diff(readings.run[order])) + 1)
    return [rows for rows in parts if len(rows)]


def repeats(readings: Readings, rows: Rows) -> NDArray[np.bool_]:
    """Whether each of `rows` but the first has the value of the one before, shape (len(rows) - 1,).

    Of vectors the lengths are compared: a turn into the robot's axes keeps them.
    """
    same = np.diff(np.round(readings.b_nt[rows], DIGITS)) == 0
    if readings.b_body_nt is not None:
        same &= np.diff(np.round(np.linalg.norm(readings.b_body_nt[rows], axis=1), DIGITS)) == 0
    return np.asarray(same)
