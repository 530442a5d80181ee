"""Doctor: what a recorded field is like, and what it is fit for."""

import shlex
from collections.abc import Collection
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.survey.hold import LEAST_MEAN, held
from magtwin.field.survey.readings import taken_of
from magtwin.field.survey.steps import step_of
from magtwin.field.units import INDOORS_NT
from magtwin.io.surveys.columns import Columns
from magtwin.report.report import Figure, Report

Array = NDArray[np.float64]

FILTER_HZ = 5.0  # Rate at which the localizers read the field [Hz]
SECTORS = 12  # Sectors of 30 degrees in which headings are counted
LEAST_READINGS, LEAST_SPAN_M = 100, 0.5  # Fewest readings and least extent [m] of a map
LEAST_SECTORS = 6  # Fewest sectors for the hard iron, and for a robot's own field

USES = {"map": ("pose",), "training": ("pose", "odometry", "imu", "battery"), "localization": ("odometry",)}
"""Roles beside the field that each use needs."""


def examine(
    b_nt: Array | None = None,
    *,
    vector_nt: Array | None = None,
    t: Array | None = None,
    p_xy: Array | None = None,
    yaw: Array | None = None,
    roles: Collection[str] = (),
    unit: str = "nT",
) -> Report:
    """Figures on a recorded field, and what it is fit for: metadata that begin with yes or no.

    Magnitudes `b_nt` [nT], shape (N,), are by default those of the vectors `vector_nt`, shape (N, 3), in the
    sensor's axes, z up or down. `t` are ascending times [s], `p_xy` positions [m], shape (N, 2), `yaw`
    headings [rad]. `roles` are what else the recording holds: pose, odometry, imu, battery, commands, scan.
    `unit` is that of the file, and how it is known, such as "uT, by its size".

    The hard iron is the centre of the circle that level vectors lie on (I. Kasa, "A circle fitting procedure
    and its error analysis", 1976). What a filter at `FILTER_HZ` aliases is the rest about means over its
    period.
    """
    if b_nt is None:
        if vector_nt is None:
            raise ValueError("examine needs magnitudes or vectors")
        b_nt = np.linalg.norm(vector_nt, axis=1)
    known = np.isfinite(b_nt)
    known &= True if t is None else np.isfinite(t)
    known &= True if vector_nt is None else np.isfinite(vector_nt).all(axis=1)
    share = round(100 * float(known.mean()), 1) if len(b_nt) else 0.0
    figures = [Figure("field in", unit), Figure("finite readings", share, "%", note=f"of {len(b_nt):,}")]
    b, given = b_nt[known], (vector_nt, t, p_xy, yaw)
    vector, clock, p, angle = (None if values is None else values[known] for values in given)
    doubts, sectors = list[str](), 0
    if len(b) > 2:
        low, usual, high = np.quantile(b, (0.01, 0.5, 0.99))
        figures.append(Figure("range", f"{low:,.0f} to {high:,.0f}", "nT", note="98 % of the readings"))
        if not INDOORS_NT[0] <= usual <= INDOORS_NT[1]:
            doubts.append(f"the median of {usual:,.0f} nT is not that of the Earth's field: check the unit")
        stuck = _stuck(b, clock)
        if float(stuck.value) * 4 > len(b):
            doubts.append(f"{stuck.value:,} of {len(b):,} readings repeat one value: the sensor was stuck")
        turns, sectors = _turns(vector, angle)
        figures += [_rounding(b if vector is None else vector), stuck, *turns]
        figures += [] if clock is None else _rate(b, clock)
    has = {*roles, *(["pose"] if p is not None else [])}
    fit = {use: _fit(use, has, b, p) for use in USES}
    if fit["map"] == "yes" and angle is not None and sectors < LEAST_SECTORS // 2:
        fit["map"] = "yes, if the sensor was carried by hand: a robot's own field needs more headings"
    metadata: dict[str, object] = {f"fit for {'a ' * (use == 'map')}{use}": text for use, text in fit.items()}
    return Report("field", tuple(figures), metadata | ({"doubts": doubts} if doubts else {}))


def info_of_survey(file: Path, told: Columns, waypoints: Path | None, step_m: float | None) -> Report:
    """What the field in a table or a log is like, what it is fit for, and the command to type next.

    `told` are columns and units that the user knows, and `waypoints` the table of a walk's marks,
    with the length of a step [m].
    """
    from magtwin.io.surveys.logs import table_of_log
    from magtwin.io.surveys.tabled import field_of_table, rows_of_table

    table = table_of_log(file, waypoints, step_m)
    vector, b, t, unit = field_of_table(table, told)
    options = {"waypoints": waypoints, "step_m": step_m, **asdict(told)}
    flags = [(f"--{name.replace('_', '-')}", str(value)) for name, value in options.items() if value]
    then = shlex.join([str(file), *(word for flag in flags for word in flag)])
    roles = ["odometry"] if table.find("v", "w") else []
    try:
        readings, rows = rows_of_table(table, told, file.stem, file.name)
    except InputError as error:
        report = examine(b, vector_nt=vector, t=t, roles=roles, unit=unit)
        more: dict[str, object] = {"no survey yet": str(error).removeprefix(f"{table.path}: ")}
        then = f"{then} --waypoints MARKS.csv" if "--waypoints" in str(error) else ""
    else:
        b[rows] = readings.b_nt
        p, yaw = np.full((len(b), 2), np.nan), np.full(len(b), np.nan)
        p[rows], yaw[rows] = readings.p_xy, readings.yaw
        report = examine(
            b, vector_nt=vector, t=t, p_xy=p, yaw=None if readings.by_hand else yaw, roles=roles, unit=unit
        )
        more = {"taken": taken} if (taken := taken_of(readings)) else {}
    more |= {"next": f"magtwin map import {then}"} if then else {}
    facts = (Figure("columns", ", ".join(table.names)),)
    return replace(report, title=str(file), figures=facts + report.figures, metadata=report.metadata | more)


def _fit(use: str, has: set[str], b: Array, p: Array | None) -> str:
    """Yes, or no and why."""
    if missing := [role for role in USES[use] if role not in has]:
        return f"no, because it has no {' and no '.join(missing)}"
    if len(b) < LEAST_READINGS:
        return f"no, because {len(b)} finite readings are fewer than {LEAST_READINGS}"
    placed = p[np.isfinite(p).all(axis=1)] if use == "map" and p is not None else np.zeros((0, 2))
    if len(placed) and np.ptp(placed, axis=0).max() < LEAST_SPAN_M:
        return f"no, because its positions span less than {LEAST_SPAN_M:g} m"
    return "no, because the field has one value only" if np.ptp(b) == 0 else "yes"


def _rounding(values: Array) -> Figure:
    """The step to which the sensor or the logger rounds [nT], if it does."""
    steps = [step_of(column, 0.99) for column in values.reshape(len(values), -1).T]
    if not all(steps):
        return Figure("sensor's step", "none seen")
    return Figure("sensor's step", float(f"{max(steps):.3g}"), "nT")


def _stuck(b: Array, t: Array | None) -> Figure:
    """Readings in stretches of one value that are far longer than chance or a fast logger makes."""
    stuck, starts, usual = held(b)
    lengths = np.diff(np.append(starts, len(b)))
    note = ""
    if stuck.any():
        k = int(np.argmax(np.where(stuck, lengths, 0)))
        seconds = f", {t[starts[k] + lengths[k] - 1] - t[starts[k]]:.1f} s" if t is not None else ""
        note = f"in {np.count_nonzero(stuck)} stretches; the longest {lengths[k]:,} readings{seconds}"
    elif usual > LEAST_MEAN:
        note = f"each value comes {usual:.2g} times: a coarse sensor, or a logger faster than it"
    return Figure("stuck readings", int(lengths[stuck].sum()), note=note)


def _turns(vector: Array | None, yaw: Array | None) -> tuple[list[Figure], int]:
    """Coverage of headings and the hard iron, and the number of sectors of headings."""
    centre, sd = (np.zeros(2), 0.0) if vector is None else _circle(vector[:, :2])
    if yaw is not None and np.isfinite(yaw).any():
        sectors, by = _sectors(yaw[np.isfinite(yaw)]), ""
    elif vector is not None:
        sectors, by = _sectors(np.arctan2(*(vector[:, 1::-1] - centre).T)), "by the level field's direction"
    else:
        return [], 0
    figures = [Figure("headings", f"{sectors} of {SECTORS}", "sectors of 30 deg", note=by)]
    if vector is not None and sectors >= LEAST_SECTORS:
        text = f"{centre[0]:,.0f}, {centre[1]:,.0f}"
        figures.append(Figure("hard iron", text, "nT", spread=float(f"{sd:.3g}"), note="x and y, estimated"))
    return figures, sectors


def _sectors(angle: Array) -> int:
    """Number of sectors with a hundredth of the readings each."""
    sector = np.floor(angle / (2 * np.pi) * SECTORS).astype(int) % SECTORS
    count = np.bincount(sector, minlength=SECTORS)
    return int(np.count_nonzero(count > 0.01 * len(angle)))


def _circle(xy: Array) -> tuple[Array, float]:
    """Centre of the circle through points, shape (2,), and its standard deviation if errors are white."""
    mean = xy.mean(axis=0)
    d = xy - mean
    design = np.column_stack([2 * d, np.ones(len(d))])
    size = (d**2).sum(axis=1)
    solution, *_ = np.linalg.lstsq(design, size, rcond=None)
    rest = size - design @ solution
    variance = float(rest @ rest) / max(1, len(d) - 3) * np.linalg.pinv(design.T @ design)
    return mean + solution[:2], float(np.sqrt(variance[0, 0] + variance[1, 1]))


def _rate(b: Array, t: Array) -> list[Figure]:
    """Rate and gaps of the readings, and what a filter aliases."""
    steps = np.diff(t)
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    if not usual:
        return []
    gaps = int(np.count_nonzero(steps > 5 * usual))
    note = f"{gaps} gaps, the longest {steps.max():.2f} s" if gaps else ""
    figures = [Figure("rate", float(f"{1 / usual:.4g}"), "Hz", note=note)]
    window = int(1 / usual / FILTER_HZ)
    if window < 2:
        return figures
    kernel = np.ones(window) / window
    parts = np.concatenate([[0], np.flatnonzero(steps > 5 * usual) + 1, [len(b)]])
    rests = [
        b[i:j][window // 2 :][: j - i - window + 1] - np.convolve(b[i:j], kernel, "valid")
        for i, j in pairwise(parts)
        if j - i >= window
    ]
    if rests:
        rms = float(np.sqrt(np.mean(np.concatenate(rests) ** 2)))
        note = f"what single readings alias in a filter at {FILTER_HZ:g} Hz; means over {window} do not"
        figures.append(Figure("faster than the filter", float(f"{rms:.3g}"), "nT", note=note))
    return figures
