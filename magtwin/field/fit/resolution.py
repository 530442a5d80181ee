"""Resolution: how far apart a map's nodes and headings may be for what a fit knows."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.fit.methods import FieldModel
from magtwin.field.grid import TURN
from magtwin.field.survey.bins import spacing_m
from magtwin.field.survey.readings import Readings

Array = NDArray[np.float64]
Choice = TypeVar("Choice")

LEAST_HEIGHT_M = 0.3
"""Height of a sensor above magnetic sources that is assumed at least [m]."""

PARTS = (2.0, 2.5, 3.0, 4.0, 5.0, 6.0)
"""Nodes along one scale of the field that are tried, the scale being the larger of the sensor's height and
the distance between readings: a field has nearly no waves shorter than its height above the sources."""

HEADINGS = (4, 6, 8, 12, 24)
"""Numbers of headings that are tried."""

SHARE = 0.2
"""Error of linear interpolation that is allowed, in the fit's standard deviation: it adds 2 % to it."""

PROBES = 400
"""Poses at which the error is measured."""

GOLDEN = np.array([0.8191725134, 0.6710436067, 0.5497004779])
"""Steps of a sequence that fills a cube evenly (Roberts 2018, R3)."""


@dataclass(frozen=True, kw_only=True)
class Resolution:
    """Spacing and headings of a map, and what linear interpolation between them costs."""

    spacing_m: float
    """Distance between nodes [m]."""

    headings_rad: tuple[float, ...]
    """Headings [rad], ascending in [0, 2 pi)."""

    nodes_nt: float
    """Root of the mean squared error of interpolation between nodes [nT]; nan where not measured."""

    turn_nt: float
    """The same between headings [nT]."""

    sd_nt: float
    """The fit's own standard deviation, the median over poses of the readings [nT]."""


def resolution(
    model: FieldModel,
    readings: Readings,
    *,
    spacing: float | None = None,
    headings_rad: ArrayLike | None = None,
    largest_m: float = np.inf,
) -> Resolution:
    """The widest spacing and the fewest headings that cost next to no accuracy.

    The error of linear interpolation is measured on the fitted field itself, at places of the readings, and
    must stay below `SHARE` of the fit's standard deviation. Where no spacing or number that is tried does
    that, the finest counts.

    Args:
        model: What was fitted.
        readings: What it was fitted to.
        spacing: Spacing that the caller chose [m]; its error is measured.
        headings_rad: Headings that the caller chose [rad].
        largest_m: Widest spacing that leaves a cell [m].
    """
    p, yaw, part = _probes(readings)
    value, variance = model.predict(p, yaw)
    known = np.isfinite(value) & np.isfinite(variance)
    sd = float(np.sqrt(np.median(variance[known]))) if known.any() else float("nan")

    def between_nodes(step: float) -> float:
        corner = p - part[:, :2] * step
        mixed = np.zeros(len(p))
        for i in (0, 1):
            for j in (0, 1):
                weight = np.abs(1 - i - part[:, 0]) * np.abs(1 - j - part[:, 1])
                mixed += weight * model.predict(corner + step * np.array([i, j]), yaw)[0]
        return _rms(mixed - value)

    def between_headings(headings: Array) -> float:
        if len(headings) == 1:
            return 0.0
        turned = np.mod(yaw[:, None] - headings, TURN)
        low = turned.argmin(axis=1)
        high = (low + 1) % len(headings)
        weight = turned.min(axis=1) / np.mod(headings[high] - headings[low] - 1e-12, TURN)
        below, above = (model.predict(p, headings[k])[0] for k in (low, high))
        return _rms(below + weight * (above - below) - value)

    if spacing is None:
        scale = max(spacing_m(readings), readings.height_m or 0.0, LEAST_HEIGHT_M)
        steps = [scale / k for k in PARTS if scale / k <= largest_m] or [largest_m]
        step, nodes = _first_good(((step, between_nodes(step)) for step in steps), sd)
    else:
        step, nodes = float(spacing), between_nodes(float(spacing))
    if headings_rad is None:
        evenly: list[Array] = [TURN / n * np.arange(n, dtype=float) for n in HEADINGS]
        headings, turn = _first_good(((h, between_headings(h)) for h in evenly), sd)
    else:
        headings = np.asarray(headings_rad, float).ravel()
        turn = between_headings(headings)
    return Resolution(
        spacing_m=step,
        headings_rad=tuple(headings.tolist()),
        nodes_nt=nodes,
        turn_nt=turn,
        sd_nt=sd,
    )


def _first_good(tried: Iterable[tuple[Choice, float]], sd: float) -> tuple[Choice, float]:
    """The first choice whose error is small against the standard deviation, else the last; with its error."""
    for choice, error in tried:  # noqa: B007
        if error <= SHARE * sd:
            break
    return choice, error


def _probes(readings: Readings) -> tuple[Array, Array, Array]:
    """Places of readings (K, 2), headings evenly all around (K,), places in a cell from 0 to 1 (K, 2)."""
    rows = np.flatnonzero(readings.good)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, PROBES).astype(np.intp))]
    even = np.mod(0.5 + np.arange(1, len(rows) + 1)[:, None] * GOLDEN, 1.0)
    return readings.p_xy[rows], TURN * even[:, 2], even[:, :2]


def _rms(error: Array) -> float:
    known = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
