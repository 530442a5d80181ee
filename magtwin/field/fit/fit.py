"""Fit a map method to readings, and lay the fit out as a map.

Linear algebra runs on one thread: its threads spin while they wait, so on a busy machine small matrices take
twenty times as long. Whole headings run in parallel instead.
"""

import inspect
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.compiled import threads
from magtwin.errors import InputError, hint
from magtwin.field.fit.methods import METHODS, FieldModel, MapMethod
from magtwin.field.fit.resolution import GOLDEN, resolution
from magtwin.field.grid import TURN, Grid
from magtwin.field.maps.curvature import interpolation_error_nt2
from magtwin.field.maps.map import NOISE, OFFSET, TABLED, AnomalyMap
from magtwin.field.maps.statistics import offset_figures
from magtwin.field.survey.axes import SurveyAxes, distinct, in_order, in_own_axes
from magtwin.field.survey.bins import distance_m, spacing_m
from magtwin.field.survey.onboard import lacking
from magtwin.field.survey.readings import Readings, checked_earth_nt
from magtwin.report.report import Figure, Report

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], Any]

NARROW = 5.0  # Readings lie on a line if their extent is below their spacing over this
REACH = 2.0  # Largest distance from a known node to a good reading, in spacings of the readings
MOST_DOUBT = 0.5  # Largest standard deviation of a known node, as a share of the readings' own
FLAT_NT = 50.0  # Least scale of that share, for fields that hardly change [nT]
# Parameters of a map: RMS errors of linear interpolation
ERRORS = ("error between nodes [nT]", "error between headings [nT]")
# Standard deviation of what a robot adds alike throughout a drive [nT]: a constant of 500 and, by heading,
# 400, as in drives of the shipped robot (`ROBOT_NOISE` of `magtwin.tasks.localizing`)
OFFSET_SD_NT = 640.0
TRIED = 2000  # Poses at which a map's table is compared with its model
MOST_READ = 400  # Most readings of a drive at which the fields of its signals are averaged
MOST_THREADS = 4  # Headings of a raster that are computed in parallel: each holds blocks of 100 MB


def fit(
    readings: Readings, method: str = "auto", *, progress: Progress | None = None, **options: Any
) -> FieldModel:
    """Fit a method to the good readings of a survey.

    A reading that equals another in every number, time included, is a copy and counts once. Methods see the
    readings in an order and built-in methods also in axes of their own (`magtwin.field.survey.axes`). So the
    field moves and turns with the survey, and the order of its rows does not matter.

    `options` are those of the method; slow ones call progress(done, total, what).
    """
    function = _checked(method, options)
    if not hasattr(function, "own_axes"):
        return fit_as_given(in_order(distinct(readings)), method, progress=progress, **options)
    like, given = options.get("like"), dict(options)
    own, axes = in_own_axes(readings, None if like is None else like.axes)
    if (earth_nt := options.get("earth_nt")) is not None:
        own = own.with_(earth_nt=axes.own_vector(checked_earth_nt(earth_nt)))
        del options["earth_nt"]
    try:
        model = fit_as_given(own, method, progress=progress, **options)
    except InputError:
        fit_as_given(readings, method, **given)  # names places and headings in world
        raise
    return model.placed(axes)  # type: ignore[attr-defined, no-any-return]


def fit_as_given(
    readings: Readings, method: str, *, progress: Progress | None = None, **options: Any
) -> FieldModel:
    """`fit` in the axes and the order of the readings."""
    function = _checked(method, options)
    if progress is not None and "progress" in inspect.signature(function).parameters:
        options["progress"] = progress
    with _one_thread():
        return function(readings, **options)


def _checked(method: str, options: Mapping[str, Any]) -> MapMethod:
    """The method of a name, if it has the options."""
    function = METHODS[method]
    kinds = inspect.signature(function).parameters.values()
    known = [p.name for p in kinds if p.kind is p.KEYWORD_ONLY]
    for name in options:
        if name not in known:
            ends = hint(name, known) if known else "it has none"
            raise InputError(f"method {method!r} has no option {name!r}; {ends}")
    return function


def fit_map(
    survey: Readings,
    method: str = "auto",
    *,
    spacing_m: float | None = None,
    headings_rad: ArrayLike | None = None,
    progress: Progress | None = None,
    **options: Any,
) -> AnomalyMap:
    """Fit a map to a survey.

    Args:
        survey: Readings at known poses.
        method: One of `METHODS`: "auto" (the best at readings left out, see `magtwin.field.fit.choice`),
            "harmonic", "gp", "trilinear", "cubic" or a registered method.
        spacing_m: Distance between nodes [m]. Default: the widest with almost no loss of accuracy.
        headings_rad: Headings of the map's grids [rad], one grid each. Default: the fewest with almost no
            loss of accuracy.
        progress: Called as progress(done, total, what).
        **options: Options of the method.

    Returns:
        The map with its variance.

    Raises:
        InputError: There is no such method or option, or the survey has too few good readings.
    """
    model = fit(survey, method, progress=progress, **options)
    return raster(model, survey, spacing_m=spacing_m, headings_rad=headings_rad, progress=progress)


def _one_thread() -> Any:
    """A context in which linear algebra uses one thread."""
    import scipy.linalg  # noqa: F401  # threadpool_limits sees only libraries that are loaded
    from threadpoolctl import threadpool_limits

    return threadpool_limits(1)


def raster(
    model: FieldModel,
    readings: Readings,
    *,
    spacing_m: float | None = None,
    headings_rad: ArrayLike | None = None,
    progress: Progress | None = None,
) -> AnomalyMap:
    """The map of a model over the floor of its readings.

    A node is valid if the model has a value there, a good reading is within two spacings of the readings, and
    the model's standard deviation is below half that of the readings. Nodes are masked where the sensor was
    stuck: where the nearest reading is not good and good ones are over half a spacing away, at any heading.
    Trilinear and cubic models of gridded surveys have their own mask.

    Nodes are `spacing_m` apart, by default those of a trilinear fit of a gridded survey, else as wide as
    `resolution` finds; so are the headings, in 4 to 24, or the only one of the survey. The parameters of the
    map hold the errors of interpolation between nodes and headings; the variance of a map of one drive has
    that of an offset, see `offset_sd_nt`.
    """
    say = progress or (lambda done, total, what: None)
    say(0, 1, "resolution")
    own, axes = in_own_axes(readings)
    grid, errors = _grid(model, readings, own, axes, spacing_m, headings_rad)
    p, _ = grid.poses()
    values, variance = np.empty(grid.shape), np.empty(grid.shape)
    headings = grid.headings_rad
    predict = getattr(model, "predict_nodes", model.predict)
    workers = threads(min(MOST_THREADS, len(headings)))
    with _one_thread(), ThreadPoolExecutor(workers) as pool:
        for h, predicted in enumerate(pool.map(predict, p, headings)):
            say(h, len(headings), "headings")
            values[h], variance[h] = predicted
    say(len(headings), len(headings), "headings")
    offset = offset_sd_nt(readings, getattr(model, "signals", ()))
    valid = np.isfinite(values) & np.isfinite(variance) & _known(model, readings, own, p[0], variance)
    if not valid.any():
        x0, x1, y0, y1 = grid.extent
        raise InputError(
            f"the {model.method} fit has no valid node in x {x0:g}..{x1:g}, y {y0:g}..{y1:g} m, for survey "
            f"{readings.name!r}: each is too far from a good reading, or its sd is above {MOST_DOUBT:g} of "
            "theirs; mask readings that contradict each other"
        )
    read = model.method == "trilinear" and readings.grid is not None  # its nodes err independently
    field = AnomalyMap(
        values_nt=values,
        valid=valid,
        variance_nt2=variance + offset**2 + readings.rounding_nt**2,
        between_nt2=interpolation_error_nt2(values, valid, headings, variance if read else None),
        origin_m=grid.origin_m,
        cell_m=grid.cell_m,
        headings_rad=np.asarray(grid.headings_rad),
        method=model.method,
        parameters={
            **model.parameters,
            **errors,
            **({OFFSET: offset} if offset else {}),
            NOISE: round(float(np.sqrt(_noise_nt2(model, readings))), 2),
        },
        **readings.about,
        harmonic=getattr(model, "field", None),
    )
    return _with_greatest_error(field) if field.holds_model else field


def _with_greatest_error(field: AnomalyMap) -> AnomalyMap:
    """The map with the greatest difference of its table from its model, at evenly spread poses."""
    even = np.mod(0.5 + np.arange(1, TRIED + 1)[:, None] * GOLDEN, 1.0)
    x0, x1, y0, y1 = field.extent
    p, yaw = (x0, y0) + even[:, :2] * (x1 - x0, y1 - y0), TURN * even[:, 2]
    error = np.abs(field.lookup(p, yaw) - field.exact(p, yaw))
    known = error[np.isfinite(error)]
    more = {TABLED: round(float(known.max()), 2)} if len(known) else {}
    return replace(field, parameters={**field.parameters, **more})


def offset_sd_nt(readings: Readings, signals: Collection[str] = ()) -> float:
    """Standard deviation of an error that is alike all over a map of the readings [nT].

    A robot that drives adds the fields of its motors, battery and LiDAR. What is alike throughout its only
    drive cannot be told from the field of the room, and no reading of the drive disagrees with it, unless
    the fields of all its `signals` were fitted. A sensor carried by hand has no such error.
    """
    drive = readings.grid is None and readings.t is not None and not readings.by_hand
    open_ = drive and np.ptp(readings.run[readings.good]) == 0 and lacking(signals)
    return OFFSET_SD_NT if open_ else 0.0


def _noise_nt2(model: FieldModel, readings: Readings) -> float:
    """Variance of a reading about the map [nT^2], with the fields of its robot's signals, if any."""
    if not getattr(model, "signals", ()) or readings.signals is None:
        return model.noise_nt2
    rows = np.linspace(0, len(readings) - 1, min(len(readings), MOST_READ)).astype(np.intp)
    p, yaw, signals = readings.p_xy[rows], readings.yaw[rows], readings.signals[rows]
    own = model.predict(p, yaw, signals)[0] - model.predict(p, yaw)[0]  # type: ignore[call-arg]
    return model.noise_nt2 + float(np.mean(own**2))


def grid_report(field: AnomalyMap) -> Report:
    """Spacing of a map's nodes and headings, and the error of linear interpolation between them."""
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
    if TABLED in field.parameters:
        note = "against the field of the fit, which the map holds (AnomalyMap.exact); of 2,000 poses"
        figures.append(Figure("greatest error of interpolation", field.parameters[TABLED], "nT", note=note))
    figures += offset_figures(field)
    return Report("grid", tuple(figures), {})


def _grid(
    model: FieldModel,
    readings: Readings,
    own_readings: Readings,
    axes: SurveyAxes,
    spacing: float | None,
    headings_rad: ArrayLike | None,
) -> tuple[Grid, dict[str, float]]:
    """Nodes of the map, and the errors of interpolation between them, by name with unit."""
    own = readings.grid if model.method == "trilinear" else None
    if own is not None and spacing is None:
        if headings_rad is None:
            return own, {}
        return replace(own, headings_rad=tuple(np.asarray(headings_rad, float).ravel().tolist())), {}
    if headings_rad is None:
        headings_rad = own.headings_rad if own is not None else _only_heading(readings)
    low, high = (f(readings.p_xy[readings.good], axis=0) for f in (np.min, np.max))
    box = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    extent = x0, x1, y0, y1 = readings.grid.extent if readings.grid is not None else box
    if spacing is not None:
        Grid.over(extent, spacing, (0.0,))  # refuses a wrong spacing before the errors are measured
    if spacing is None and readings.grid is None and min(x1 - x0, y1 - y0) < spacing_m(own_readings) / NARROW:
        raise InputError(
            f"the readings of {readings.name!r} lie on one line, x {x0:g}..{x1:g}, y {y0:g}..{y1:g} "
            "m; a map needs an area"
        )
    with _one_thread():
        largest = max(min(x1 - x0, y1 - y0), 0.0)
        chosen = resolution(
            model, own_readings, axes, spacing=spacing, headings_rad=headings_rad, largest_m=largest
        )
    errors = zip(ERRORS, (chosen.nodes_nt, chosen.turn_nt), strict=True)
    known = {name: round(error, 2) for name, error in errors if np.isfinite(error)}
    lay = Grid.filling if spacing is None else Grid.over
    return lay(extent, chosen.spacing_m, chosen.headings_rad), known


def _only_heading(readings: Readings) -> tuple[float, ...] | None:
    """The heading of a survey that has only one, else None."""
    if readings.grid is not None:
        only = readings.grid.headings_rad
        return only if len(only) == 1 else None
    yaw = readings.yaw[readings.good]
    return (float(yaw[0] % TURN),) if np.ptp(yaw) == 0 else None


def _known(
    model: FieldModel, readings: Readings, own: Readings, p_xy: Array, variance: Array
) -> NDArray[np.bool_]:
    """Nodes that are near enough to readings, and certain enough."""
    from scipy.spatial import cKDTree

    if readings.grid is not None and model.method in ("trilinear", "cubic"):
        return np.ones(variance.shape, bool)
    good, spacing = readings.good, spacing_m(own)
    far = distance_m(cKDTree(readings.p_xy[good]), p_xy)
    doubt = np.sqrt(variance) / max(float(readings.b_nt[good].std()), FLAT_NT)
    known = (far <= REACH * spacing * (1 + 1e-9)) & (doubt <= MOST_DOUBT)
    if not good.all():
        none = distance_m(cKDTree(readings.p_xy[~good]), p_xy)
        known &= ~((far > spacing / 2 * (1 + 1e-9)) & (none < far * (1 - 1e-9)))
    return known
