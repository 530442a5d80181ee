"""Cross-validation: how well methods predict readings that they were not fitted to."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, hint
from magtwin.field.fit.fit import fit
from magtwin.field.fit.interpolation import check_readings
from magtwin.field.fit.methods import METHODS, FieldModel
from magtwin.field.survey.axes import SurveyAxes, distinct
from magtwin.field.survey.bins import spacing_m
from magtwin.field.survey.readings import Readings
from magtwin.report.report import Figure, Report
from magtwin.report.verdict import Z_90

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Progress = Callable[[int, int, str], Any]

# Options of methods in a check: held-out nodes are filled, or every cell would be unknown
FILLED: Mapping[str, Mapping[str, Any]] = {"trilinear": {"fill": True}, "cubic": {"fill": True}}
SPLITS = ("checkerboard", "heading", "run", "block")
BLOCK_SPACINGS = 3  # Side of a held-out block, in spacings of the readings
# Number of parts of a floor in blocks: block (i, j) is in part (i + 2 j) mod 5, unlike all eight around it
BLOCKS = 5


def check(
    readings: Readings,
    methods: Sequence[str] | None = None,
    *,
    split: str | Sequence[tuple[Rows, Rows]] | None = None,
    options: Mapping[str, Mapping[str, Any]] = FILLED,
    progress: Progress | None = None,
) -> Report:
    """Fit every method to a part of a survey, and compare its predictions of the rest with the readings.

    Readings that are not good are ignored. Every method is fitted anew to each part, including its
    hyperparameters.

    A split is "checkerboard" (every other node of a gridded survey at all headings, then the others),
    "heading" (one at a time), "run" (one at a time) or "block" (every fifth block of three spacings, in five
    turns); by default the first of checkerboard, run and block that the survey allows. `options` are by name
    of the method.

    For each method (default: all but "auto"), and for the mean of the fitted readings as "naive", the report
    has RMSE, mean and median absolute error [nT]; the shares that it predicts and that lie in its 90 %
    interval; the mean log predictive density [log 1/nT], for normal errors of its variance and noise; for
    gridded surveys also errors and coverage by heading.
    """
    methods = [name for name in METHODS if name != "auto"] if methods is None else list(methods)
    for name in methods:
        METHODS[name]  # refuses unknown names
    if not methods or len(set(methods)) < len(methods):
        raise InputError(f"methods of a check must be one or more, each once, got {methods}")
    check_readings(readings)
    named, turns = _turns(readings, split)
    tested = np.concatenate([test for _, test in turns])
    if not len(tested):
        raise InputError(f"no good reading of {readings.name!r} is left to predict")
    figures = [
        Figure("readings predicted", len(tested), note=f"of {int(readings.good.sum())} good ones"),
        Figure("turns", len(turns), note=f"{min(len(a) for a, _ in turns)} readings fitted at least"),
    ]
    heading = None if readings.node is None else readings.node[tested, 0]
    step, steps, say = 0, len(methods) * len(turns), progress or (lambda done, total, what: None)
    for method in ("naive", *methods):
        mean, variance = [], []
        for train, test in turns:
            if method == "naive":
                seen = readings.b_nt[train]
                m, v = np.full(len(test), seen.mean()), np.full(len(test), seen.var())
            else:
                say(step, steps, method)
                step += 1
                model = fit(shown(readings, train), method, **options.get(method, {}))
                m, v = predict_readings(model, readings.take(test), method)
            mean.append(m)
            variance.append(v)
        figures += _figures(method, readings, tested, np.concatenate(mean), np.concatenate(variance), heading)
    say(steps, steps, "done")
    return Report(f"check of {readings.name or 'survey'}", tuple(figures), {"split": named})


def shown(readings: Readings, rows: Rows) -> Readings:
    """Some readings, on a grid of only the headings that they have."""
    some = readings.take(rows)
    if some.grid is None or some.node is None:
        return some
    left, heading = np.unique(some.node[:, 0], return_inverse=True)
    if len(left) == len(some.grid.headings_rad):
        return some
    grid = replace(some.grid, headings_rad=tuple(some.grid.headings_rad[h] for h in left))
    return some.with_(grid=grid, node=np.column_stack([heading.ravel(), some.node[:, 1:]]))


def predict_readings(model: FieldModel, test: Readings, method: str) -> tuple[Array, Array]:
    """Mean [nT] and variance with noise [nT^2] of readings, at nominal headings if the method uses those."""
    yaw = test.yaw
    if test.grid is not None and test.node is not None and method in FILLED:
        yaw = np.asarray(test.grid.headings_rad)[test.node[:, 0]]
    given: dict[str, Any] = {"signals": test.signals} if getattr(model, "signals", ()) else {}
    mean, variance = model.predict(test.p_xy, yaw, **given)
    return mean, variance + model.noise_nt2


def _turns(
    readings: Readings, split: str | Sequence[tuple[Rows, Rows]] | None
) -> tuple[str, list[tuple[Rows, Rows]]]:
    """Description of a split, and the rows to fit and to predict of each turn."""
    good = np.flatnonzero(readings.good)
    if split is not None and not isinstance(split, str):
        return "given rows", [(np.intersect1d(a, good), np.intersect1d(b, good)) for a, b in split]
    if split is None:
        runs = len(np.unique(readings.run[good])) > 1
        split = "checkerboard" if readings.grid is not None else "run" if runs else "block"
    part, description = parts(readings, split)
    names = np.unique(part[good])
    if len(names) < 2:
        raise InputError(
            f"split {split!r} leaves nothing out of {readings.name!r}: all readings are in one part"
        )
    return description, [(good[part[good] != k], good[part[good] == k]) for k in names]


def parts(readings: Readings, split: str) -> tuple[Rows, str]:
    """Part of each reading in a split, and what a part is."""
    if split not in SPLITS:
        raise InputError(f"no split {split!r}; {hint(split, SPLITS)}")
    if split == "run":
        return readings.run, "one run at a time"
    if split == "block":
        side = BLOCK_SPACINGS * spacing_m(readings)
        p, _ = SurveyAxes.of(distinct(readings)).own_poses(readings.p_xy, readings.yaw)
        i, j = np.floor((p - p[readings.good].min(axis=0)) / side + 1e-6).astype(np.intp).T
        return (i + 2 * j) % BLOCKS, f"every fifth block of {side:.3g} x {side:.3g} m, in turn"
    if readings.node is None:
        raise InputError(
            f"split {split!r} needs the nodes of a gridded survey, {readings.name!r} has none; "
            "take 'run' or 'block'"
        )
    if split == "heading":
        return readings.node[:, 0], "one heading at a time"
    return readings.node[:, 1:].sum(axis=1) % 2, "every other node at all its headings, then the others"


def _figures(
    method: str, readings: Readings, rows: Rows, mean: Array, variance: Array, heading: Rows | None
) -> Iterator[Figure]:
    error = mean - readings.b_nt[rows]
    known = np.isfinite(error) & np.isfinite(variance)
    if not known.any():
        yield Figure(f"{method} predicted", 0.0, "%")
        return
    e, v = error[known], np.maximum(variance[known], np.finfo(float).tiny)
    inside = np.abs(e) <= Z_90 * np.sqrt(v)
    score = -0.5 * (np.log(2 * np.pi * v) + e**2 / v)
    yield Figure(f"{method} RMSE", _rms(e), "nT")
    yield Figure(f"{method} MAE", round(float(np.mean(np.abs(e))), 1), "nT")
    yield Figure(
        f"{method} median error", round(float(np.median(np.abs(e))), 1), "nT", note="of the absolute ones"
    )
    yield Figure(f"{method} coverage", _percent(inside), "%", note="of readings in the 90 % interval")
    yield Figure(f"{method} log score", round(float(score.mean()), 3), note="mean log density [1/nT]")
    yield Figure(f"{method} predicted", _percent(known), "%", note="of readings")
    if heading is None or readings.grid is None:
        return
    for h, angle in enumerate(np.degrees(readings.grid.headings_rad)):
        own = heading[known] == h
        if own.any():
            note = f"coverage {_percent(inside[own]):g} %"
            yield Figure(f"{method} RMSE at {angle:g} deg", _rms(e[own]), "nT", note=note)


def _rms(error: Array) -> float:
    return round(float(np.sqrt(np.mean(error**2))), 1)


def _percent(flags: NDArray[np.bool_]) -> float:
    return round(100 * float(flags.mean()), 1)
