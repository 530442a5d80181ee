"""Walk: places of a sensor that was carried past marks, by the times at which it passed them."""

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.run.thinning import stretches
from magtwin.tables.labels import words_of
from magtwin.tables.table import Column, Table, since_1970

Array = NDArray[np.float64]

NOTES = ("text", "note", "notes", "annotation", "comment", "label", "remark", "event", "description")
"""Names of columns whose words may be places."""

_PLACE = re.compile(r"\D*?([+-]?\d+(?:\.\d+)?)\s*[,;/ ]\s*(?:y\s*=?\s*)?([+-]?\d+(?:\.\d+)?)\s*\D*", re.ASCII)
"""A place in a note: `1.5,2`, `(1.5; 2)` or `x=1.5 y=2`."""

LEAST_COVERED = 0.1  # Share of the log's time below which marks must be in another unit
STEP_M_S2 = 0.6  # Acceleration about its mean over a second beyond which a foot falls, below which it rises
STILL_M_S2 = 0.4  # Standard deviation of the acceleration within a second below which nobody walks [m/s^2]
LEAST_PAUSE_S = 1.5  # Shortest pause that counts [s]

QUIET, LIVELY = 4.0, 20.0
"""Changes of the field within a second, in standard deviations of its means over a second: below the first
in a pause, and above the second usually. Fields that hardly change show no pauses."""


@dataclass(frozen=True)
class Marks:
    """When a walker passed which places."""

    t: Array | None  # Times [s], ascending, shape (M,); None if only their order is known
    p_xy: Array  # Places [m], shape (M, 2)
    name: str  # Their file


def marks_of(table: Table, *, timed: bool = True) -> Marks | None:
    """The marks in a table: columns t, x and y, or t and notes such as `1.5,2`; None if it has none.

    If they need not be `timed`, their order is enough.
    """
    name = "".join(table.find("t"))
    if not name and timed:
        return None
    t = since_1970(table, name)[0] if name else np.arange(float(table.rows))
    if labels := table.find("x", "y"):
        p = np.column_stack([table.numbers(label, axis) for label, axis in zip(labels, "xy", strict=True)])
    else:
        notes = next((label for label in table.names if set(words_of(label)) & set(NOTES)), None)
        found = [_PLACE.fullmatch(text) for text in table.texts(notes)] if notes else []
        if not any(found):
            return None
        p = np.array([[float(m[1]), float(m[2])] if m else [np.nan, np.nan] for m in found])
    known = np.isfinite(t) & np.isfinite(p).all(axis=1)
    order = np.flatnonzero(known)[np.argsort(t[known], kind="stable")]
    t, p = t[order], p[order]
    if len(t) < 2:
        raise InputError(f"{table.path}: {len(t)} mark; a walk needs two or more, as t,x,y")
    if len(same := np.flatnonzero(np.diff(t) <= 0)):
        raise InputError(f"{table.path}: two marks at {t[same[0]]:g} s; a walker passes one place at a time")
    return Marks(t if name else None, p, table.path.name)


def walked(
    table: Table, marks: Marks, moving: tuple[Array, Array] | None = None, step_m: float | None = None
) -> Table:
    """A table of readings with the columns x and y of a walk: from mark to mark at a steady pace.

    In pauses the walker stands still. They are found by times [s] and accelerations [m/s^2] `moving`, shapes
    (K,) and (K, 3), or else where the field does not change. Marks are in the clock of the table, or in
    seconds since its first row; rows before the first and behind the last have no place. Of marks without
    times the first is where the log begins. The last is where it ends, unless the length of a step `step_m`
    is given: then the walker is as far along as the steps in the accelerations.
    """
    name = "".join(table.find("t"))
    if not name:
        raise InputError(f"{table.path}: no column of time; marks are joined to readings by their times")
    t, _ = since_1970(table, name)
    begin, end = float(np.nanmin(t)), float(np.nanmax(t))
    steady = ", at a steady pace between them" * (step_m is None)
    notes = [f"places from {len(marks.p_xy)} marks of {marks.name}{steady}"]
    if step_m is not None and (marks.t is not None or moving is None or not step_m > 0):
        why = "has the times of its marks" if marks.t is not None else "needs a length above 0 m"
        why = why if moving or marks.t is not None else "needs a log with accelerations"
        raise InputError(f"{table.path}: {marks.name} {why}; drop --step-m", parameter="step_m")
    at = np.array([begin, end]) if marks.t is None else _in_clock(marks.t, begin, end, table, marks, notes)
    stills = _stills(*moving) if moving else _quiet(table, t)
    stills = [(a, b) for a, b in stills if b > at[0] and a < at[-1]]
    if stills and step_m is None:
        by = "the acceleration" if moving else "a field that did not change"
        notes.append(f"{len(stills)} pauses, {sum(b - a for a, b in stills):.0f} s in all, by {by}")
    way_at, way = _moved(at, stills), _moved(t, stills)
    if marks.t is None:
        length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(marks.p_xy, axis=0), axis=1)))
        if step_m is None:
            way_at = way_at[0] + np.ptp(way_at) * length / length[-1]
        elif moving is not None:
            steps = _steps(*moving)
            way, way_at = step_m * np.interp(t, steps, np.arange(len(steps))), length
            notes.append(f"{len(steps) - 1} steps of {step_m:g} m, on a way of {length[-1]:.4g} m")
    way_at = np.where(np.diff(way_at, prepend=-np.inf) > 0, way_at, way_at + 1e-9 * np.arange(len(way_at)))
    p = np.column_stack([np.interp(way, way_at, part) for part in marks.p_xy.T])
    p[~((t >= at[0]) & (t <= at[-1]) & (way <= way_at[-1]))] = np.nan
    columns = [c for c in table.columns if c.name not in ("x", "y")]
    placed = (Column(axis, part, table.path, None) for axis, part in zip("xy", p.T, strict=True))
    return Table((*columns, *placed), (*table.notes, *notes), table.comments)


def _in_clock(at: Array, begin: float, end: float, table: Table, marks: Marks, notes: list[str]) -> Array:
    """Times of marks in the clock of a table, whose begin and end are given."""
    if at[-1] < begin or at[0] > end:
        if not -1 <= at[0] < at[-1] <= 1.05 * (end - begin) + 1:
            both = f"{begin:.10g} to {end:.10g} s, and {marks.name}: {at[0]:.10g} to {at[-1]:.10g} s"
            text = f"{both}, have no time in common; count both from the start of the log"
            raise InputError(f"{table.path}: {text}")
        at = at + begin
        notes.append(f"the times of {marks.name} from the start of {table.path.name}")
    if (covered := (min(at[-1], end) - max(at[0], begin)) / max(end - begin, 1e-9)) < LEAST_COVERED:
        text = f"{marks.name} covers {100 * covered:.2g} % of its {end - begin:.6g} s"
        raise InputError(f"{table.path}: {text}; give both times in one unit, such as t [ms]")
    return at


def _steps(t: Array, acceleration: Array) -> Array:
    """The begin of a walk and the times of its steps [s], by accelerations that rise beyond a bound again."""
    size = np.linalg.norm(acceleration, axis=1)
    grid = np.arange(t[0], t[-1], 0.02)
    size = np.convolve(np.interp(grid, t, size), np.ones(7) / 7, "same")
    size -= np.convolve(np.pad(size, 25, "edge"), np.ones(51) / 51, "valid")
    turns = np.flatnonzero(np.abs(size) > STEP_M_S2)
    falls = turns[1:][(size[turns[1:]] > 0) & (size[turns[:-1]] < 0)]
    return np.append(t[0], grid[falls])


def _moved(t: Array, stills: list[tuple[float, float]]) -> Array:
    """Time on the move until each time [s], without pauses."""
    return np.asarray(t - sum((np.clip(t, a, b) - a for a, b in stills), start=np.zeros(len(t))))


def _stills(t: Array, acceleration: Array) -> list[tuple[float, float]]:
    """Begin and end of the pauses of a walker [s], by accelerations."""
    halves, second = np.unique(np.floor(2 * (t - t[0])), return_inverse=True)  # of a second
    count = np.bincount(second)
    spread = np.zeros(len(count))
    for part in acceleration.T:
        mean = np.bincount(second, part) / count
        spread += np.bincount(second, (part - mean[second]) ** 2) / count
    return _pauses(t[0] + np.append(halves, halves[-1] + 1) / 2, np.sqrt(spread) < STILL_M_S2)


def _quiet(table: Table, t: Array) -> list[tuple[float, float]]:
    """Begin and end of the pauses of a walker [s], by a field that does not change."""
    names = table.find("field") or table.find("bx", "by", "bz")
    if not names or len(t) < 100:
        return []
    b = np.linalg.norm([table.numbers(name) for name in names], axis=0)
    good = np.isfinite(b) & np.isfinite(t)
    b, t = b[good], t[good]
    window = int(1 / max(float(np.median(np.diff(t))), 1e-3))
    if window < 5 or len(b) < 4 * window:
        return []
    noise = 1.4826 * float(np.median(np.abs(np.diff(b, 2)))) / np.sqrt(6 * window)
    mean = np.convolve(b, np.ones(window) / window, "same")
    change = np.abs(mean[window:] - mean[:-window])
    if noise == 0 or np.median(change) < LIVELY * noise:
        return []
    return _pauses(t[window // 2 :][: len(change) + 1], change < QUIET * noise)


def _pauses(edges: Array, flags: NDArray[np.bool_]) -> list[tuple[float, float]]:
    """Begin and end of the stretches of flags of `LEAST_PAUSE_S` or more."""
    return [(a, b) for a, b in edges[stretches(flags)].tolist() if b - a >= LEAST_PAUSE_S]
