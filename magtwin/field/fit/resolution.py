"""Resolution: the widest spacing and the fewest headings of a map with almost no loss of accuracy."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.fit.methods import FieldModel, values_of
from magtwin.field.grid import TURN
from magtwin.field.survey.axes import WORLD, SurveyAxes
from magtwin.field.survey.bins import spacing_m
from magtwin.field.survey.readings import Readings

Array = NDArray[np.float64]
Choice = TypeVar("Choice")

LEAST_HEIGHT_M = 0.3  # Assumed least height of a sensor above magnetic sources [m]
# Nodes tried per scale of the field: the larger of the sensor's height and the readings' spacing. A field has
# almost no waves shorter than its height above the sources.
PARTS = (2.0, 2.5, 3.0, 4.0, 5.0, 6.0)
HEADINGS = (4, 6, 8, 12, 24)  # Numbers of headings that are tried
# Allowed error of linear interpolation, as a share of the fit's standard deviation: adds 2 % to it
SHARE = 0.2
PROBES = 400  # Poses at which the error is measured
# Steps of a sequence that fills a cube evenly (Roberts 2018, R3)
GOLDEN = np.array([0.8191725134, 0.6710436067, 0.5497004779])


@dataclass(frozen=True, kw_only=True)
class Resolution:
    """Spacing and headings of a map, and the errors of linear interpolation between them."""

    spacing_m: float  # Distance between nodes [m]
    headings_rad: tuple[float, ...]  # Headings [rad], ascending in [0, 2 pi)
    nodes_nt: float  # RMS error of interpolation between nodes [nT]; nan if not measured
    turn_nt: float  # The same between headings [nT]
    sd_nt: float  # Standard deviation of the fit, median over poses of the readings [nT]


def resolution(
    model: FieldModel,
    readings: Readings,
    axes: SurveyAxes = WORLD,
    *,
    spacing: float | None = None,
    headings_rad: ArrayLike | None = None,
    largest_m: float = np.inf,
) -> Resolution:
    """Choose the widest spacing and the fewest headings with almost no loss of accuracy.

    The error of linear interpolation is measured on the fitted field, at positions of the readings, and must
    be below `SHARE` of the fit's standard deviation. If no choice reaches this, the finest is used. Of a
    spacing [m] or headings [rad] that the caller gives, only the error is measured. `largest_m` is the widest
    spacing that leaves a cell. `readings` are in `axes`, the model in world.
    """
    p, yaw, part = _probes(readings, axes)
    value, variance = model.predict(p, yaw)
    known = np.isfinite(value) & np.isfinite(variance)
    sd = float(np.sqrt(np.median(variance[known]))) if known.any() else float("nan")

    def between_nodes(step: float) -> float:
        corner = p - step * part @ axes.turn.T
        mixed = np.zeros(len(p))
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            weight = np.abs(1 - i - part[:, 0]) * np.abs(1 - j - part[:, 1])
            mixed += weight * values_of(model, corner + step * axes.turn @ [i, j], yaw)
        return _rms(mixed - value)

    def between_headings(headings: Array) -> float:
        if len(headings) == 1:
            return 0.0
        turned = np.mod(yaw[:, None] - headings, TURN)
        low = turned.argmin(axis=1)
        high = (low + 1) % len(headings)
        weight = turned.min(axis=1) / np.mod(headings[high] - headings[low] - 1e-12, TURN)
        below, above = (values_of(model, p, headings[k]) for k in (low, high))
        return _rms(below + weight * (above - below) - value)

    if spacing is None:
        scale = max(spacing_m(readings), readings.height_m or 0.0, LEAST_HEIGHT_M)
        steps = [scale / k for k in PARTS if scale / k <= largest_m] or [largest_m]
        step, nodes = _first_good(((step, between_nodes(step)) for step in steps), sd)
    else:
        step, nodes = float(spacing), between_nodes(float(spacing))
    if headings_rad is None:
        main = axes.main_heading_rad(readings)
        evenly = [main % (TURN / n) + TURN / n * np.arange(n, dtype=float) for n in HEADINGS]
        headings, turn = _first_good(((h, between_headings(h)) for h in evenly), sd)
    else:
        headings = np.asarray(headings_rad, float).ravel()
        turn = between_headings(headings)
    return Resolution(
        spacing_m=step, headings_rad=tuple(headings.tolist()), nodes_nt=nodes, turn_nt=turn, sd_nt=sd
    )


def _first_good(tried: Iterable[tuple[Choice, float]], sd: float) -> tuple[Choice, float]:
    """The first choice whose error is small enough, else the last; with its error."""
    for choice, error in tried:  # noqa: B007
        if error <= SHARE * sd:
            break
    return choice, error


def _probes(readings: Readings, axes: SurveyAxes) -> tuple[Array, Array, Array]:
    """Positions of readings in world (K, 2), even headings (K,), and positions in a cell, 0 to 1 (K, 2)."""
    rows = np.flatnonzero(readings.good)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, PROBES).astype(np.intp))]
    even = np.mod(0.5 + np.arange(1, len(rows) + 1)[:, None] * GOLDEN, 1.0)
    return axes.world_xy(readings.p_xy[rows]), TURN * even[:, 2] + axes.yaw_rad, even[:, :2]


def _rms(error: Array) -> float:
    known = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
