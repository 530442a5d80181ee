"""From readings to a map: a method by its name, and the raster of what it fitted.

Linear algebra runs on one thread here. Its own threads wait for each other by spinning, so that on a busy
machine a fit of small matrices takes twenty times as long; what runs beside each other are whole parts.
"""

import inspect
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, hint
from magtwin.field.fit.methods import METHODS, FieldModel
from magtwin.field.fit.resolution import resolution
from magtwin.field.grid import TURN, Grid
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.survey.bins import distance_m, spacing_m
from magtwin.field.survey.readings import Readings
from magtwin.report import Figure, Report

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], Any]

NARROW = 5.0
"""Readings whose extent is narrower than their spacing over this lie on a line."""

REACH = 2.0
"""Distance to the nearest good reading up to which a node is known, in spacings of the readings."""

MOST_DOUBT = 0.5
"""Part of the readings' standard deviation from which a method's own counts as not knowing."""

ERRORS = ("error between nodes [nT]", "error between headings [nT]")
"""Parameters of a map: root of the mean squared error of linear interpolation."""

MOST_THREADS = 4
"""Headings of a raster that are told beside each other: each holds blocks of 100 MB."""


ON_NODES = ("trilinear",)
"""Methods whose raster of a gridded survey is the survey's own nodes."""


def fit(
    readings: Readings, method: str = "harmonic", *, progress: Progress | None = None, **options: Any
) -> FieldModel:
    """Fit a method to the good readings of a survey.

    Args:
        readings: A survey.
        method: One of `METHODS`.
        progress: Called as progress(done, total, what) by the methods that take their time.
        **options: Options of the method.

    Raises:
        InputError: There is no such method or option; or as the method refuses.
    """
    function = METHODS[method]
    kinds = inspect.signature(function).parameters.values()
    known = [p.name for p in kinds if p.kind is p.KEYWORD_ONLY]
    for name in options:
        if name not in known:
            ends = hint(name, known) if known else "it has none"
            raise InputError(f"method {method!r} has no option {name!r}; {ends}")
    if progress is not None and "progress" in known:
        options["progress"] = progress
    with _one_thread():
        return function(readings, **options)


def _one_thread() -> Any:
    """The context in which linear algebra has one thread."""
    import scipy.linalg  # noqa: F401  # threadpool_limits sees only libraries that are loaded
    from threadpoolctl import threadpool_limits

    return threadpool_limits(1)


def raster(
    model: FieldModel,
    readings: Readings,
    *,
    spacing_m: float | None = None,
    headings_rad: ArrayLike | None = None,
    extent: ArrayLike | None = None,
    progress: Progress | None = None,
) -> AnomalyMap:
    """The map of a model over the floor of its readings.

    A node is valid where the model gives a value, where a good reading lies within two spacings of the
    readings, and where the model's standard deviation is below half that of the readings. It is not where
    the sensor latched: where the nearest reading is none that is good, and those that are good are over half
    a spacing away, at whatever heading. Trilinear and cubic maps of nodes know by themselves where they end.

    Args:
        model: What was fitted.
        readings: What it was fitted to.
        spacing_m: Distance between nodes [m]. Default: for "trilinear" on a gridded survey its own nodes,
            else the widest spacing that costs next to no accuracy (`magtwin.field.fit.resolution`).
        headings_rad: Headings of the layers [rad], ascending in [0, 2 pi). Default: for "trilinear" on a
            gridded survey its own; the one heading of a survey that has only one; else the fewest of 4 to
            24 that cost next to no accuracy.
        extent: Least x, greatest x, least y, greatest y [m]; that of the readings unless given.
        progress: Called as progress(done, total, what), once a heading.

    Returns:
        The map, with values, variance, method, parameters and the survey's name, source, licence, day,
        frame, datum and height; and with the harmonic field where the model has one. The parameters hold
        the error of linear interpolation between its nodes and between its headings.

    Raises:
        InputError: The spacing leaves no cell, the headings do not ascend, or no node is valid.
    """
    grid, errors = _grid(model, readings, spacing_m, headings_rad, extent)
    p, _ = grid.poses()
    values, variance = np.empty(grid.shape), np.empty(grid.shape)
    headings = grid.headings_rad
    predict = getattr(model, "predict_nodes", model.predict)
    threads = min(MOST_THREADS, os.cpu_count() or 1, len(headings))
    with _one_thread(), ThreadPoolExecutor(threads) as pool:
        for h, told in enumerate(pool.map(predict, p, headings)):
            if progress is not None:
                progress(h, len(headings), "headings")
            values[h], variance[h] = told
    if progress is not None:
        progress(len(headings), len(headings), "headings")
    valid = np.isfinite(values) & np.isfinite(variance) & _known(model, readings, p[0], variance)
    if not valid.any():
        x0, x1, y0, y1 = grid.extent
        raise InputError(
            f"no node of x {x0:g}..{x1:g}, y {y0:g}..{y1:g} m is known to the {model.method} fit of "
            f"{readings.name!r}: each is too far from a good reading, or its sd is above {MOST_DOUBT:g} of "
            "theirs; keep the extent within the readings, and leave out what contradicts itself"
        )
    return AnomalyMap(
        values_nt=values,
        valid=valid,
        variance_nt2=variance,
        origin_m=grid.origin_m,
        cell_m=grid.cell_m,
        headings_rad=np.asarray(grid.headings_rad),
        name=readings.name,
        method=model.method,
        parameters={**model.parameters, **errors},
        source=readings.source,
        licence=readings.licence,
        created=readings.created,
        frame=readings.frame,
        datum=readings.datum,
        height_m=readings.height_m,
        harmonic=getattr(model, "field", None),
    )


def grid_report(field: AnomalyMap) -> Report:
    """How far a map's nodes and headings are apart, and the error of linear interpolation between them."""
    dx, dy = field.cell_m
    figures = []
    for label, value, unit, error in (
        ("node spacing", round(max(dx, dy), 4), "m", ERRORS[0]),
        ("headings apart", round(360 / len(field.headings_rad), 2), "deg", ERRORS[1]),
    ):
        known = field.parameters.get(error)
        note = "" if known is None else f"interpolation between them errs by {known:.3g} nT RMS"
        figures.append(Figure(label, value, unit, note=note))
    if field.variance_nt2 is not None and field.valid.any():
        sd = float(np.sqrt(np.median(field.variance_nt2[field.valid])))
        figures.append(Figure("standard deviation", round(sd, 1), "nT", note="median over the nodes"))
    return Report("grid", tuple(figures), {})


def _grid(
    model: FieldModel,
    readings: Readings,
    spacing: float | None,
    headings_rad: ArrayLike | None,
    extent: ArrayLike | None,
) -> tuple[Grid, dict[str, float]]:
    """Nodes of the map, and what interpolation between them costs, by name with unit."""
    own = readings.grid if model.method in ON_NODES else None
    if own is not None and spacing is None and extent is None:
        if headings_rad is None:
            return own, {}
        return replace(own, headings_rad=tuple(np.asarray(headings_rad, float).ravel().tolist())), {}
    if headings_rad is None:
        headings_rad = own.headings_rad if own is not None else _only_heading(readings)
    if extent is None:
        extent = readings.grid.extent if readings.grid is not None else _box(readings)
    x0, x1, y0, y1 = (float(v) for v in np.asarray(extent, float))
    if spacing is None and readings.grid is None and min(x1 - x0, y1 - y0) < spacing_m(readings) / NARROW:
        raise InputError(
            f"the readings of {readings.name!r} lie on one line, x {x0:g}..{x1:g}, y {y0:g}..{y1:g} "
            "m; a map needs an area"
        )
    with _one_thread():
        chosen = resolution(
            model,
            readings,
            spacing=spacing,
            headings_rad=headings_rad,
            largest_m=max(min(x1 - x0, y1 - y0), 0.0),
        )
    errors = zip(ERRORS, (chosen.nodes_nt, chosen.turn_nt), strict=True)
    known = {name: round(error, 2) for name, error in errors if np.isfinite(error)}
    lay = Grid.filling if spacing is None else Grid.over
    return lay(extent, chosen.spacing_m, chosen.headings_rad), known


def _only_heading(readings: Readings) -> tuple[float, ...] | None:
    """The heading of a survey that has only one, else None."""
    if readings.grid is not None:
        only = readings.grid.headings_rad
    else:
        yaw = readings.yaw[readings.good]
        only = (float(yaw[0] % TURN),) if np.ptp(yaw) == 0 else ()
    return only if len(only) == 1 else None


def _box(readings: Readings) -> tuple[float, float, float, float]:
    low, high = (f(readings.p_xy[readings.good], axis=0) for f in (np.min, np.max))
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _known(model: FieldModel, readings: Readings, p_xy: Array, variance: Array) -> NDArray[np.bool_]:
    """Nodes that the readings reach, and that the model is sure enough of."""
    from scipy.spatial import cKDTree

    if readings.grid is not None and model.method in ("trilinear", "cubic"):
        return np.ones(variance.shape, bool)
    good, spacing = readings.good, spacing_m(readings)
    far = distance_m(cKDTree(readings.p_xy[good]), p_xy)
    doubt = np.sqrt(variance) / readings.b_nt[good].std()
    known = (far <= REACH * spacing * (1 + 1e-9)) & (doubt <= MOST_DOUBT)
    if not good.all():
        none = distance_m(cKDTree(readings.p_xy[~good]), p_xy)
        known &= ~((far > spacing / 2 * (1 + 1e-9)) & (none < far * (1 - 1e-9)))
    return known
