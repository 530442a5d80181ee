"""Passes: stretches of a drive that do not come back to a place."""

import numpy as np

from magtwin.field.survey.bins import spacing_m
from magtwin.field.survey.readings import Readings

PLACES = 4  # Places per spacing along x and y
AWAY = 4.0  # Way between two visits of a place, in sides of a place: less is no return


def by_pass(readings: Readings) -> Readings:
    """The readings with passes in place of runs.

    A disturbance that changes slowly, such as the field of motors and battery, is alike in readings that
    follow each other. It differs from the field only where the robot comes back. A pass ends where the robot
    returns to a place of it. A run without times is one pass; a gridded survey keeps its runs.
    """
    if readings.t is None or readings.grid is not None:
        return readings
    order = np.lexsort((readings.t, readings.run))
    p, run = readings.p_xy[order], readings.run[order]
    side = spacing_m(readings) / PLACES
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))]).tolist()
    places = np.floor((p - p.min(axis=0)) / side).astype(np.int64).tolist()
    number = np.empty(len(p), np.intp)
    known: dict[tuple[int, ...], float] = {}
    passes, before = -1, None
    for k, (place, at, of) in enumerate(zip(map(tuple, places), way, run.tolist(), strict=True)):
        if of != before or at - known.get(place, at) > AWAY * side:
            passes, before, known = passes + 1, of, {}
        known[place] = at
        number[k] = passes
    own = np.empty_like(number)
    own[order] = number
    return readings.with_(run=own, runs=tuple(map(str, range(passes + 1))))
