"""Paths from points: an array, or a CSV file."""

import math
import os
import re
import warnings
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import InputError, RepairWarning, hint
from magtwin.files.kinds import expected
from magtwin.path.curves import CASES, PATHS, path_named
from magtwin.path.polyline import SAME_M, Path, without_repeats
from magtwin.report.summary import listed
from magtwin.tables.delimited import DEGREES, LENGTHS, QUOTED, Delimited, number_of, read_delimited
from magtwin.tables.labels import split_label

ANGLES = frozenset({"lat", "latitude", "lon", "lng", "long", "longitude"})
"""Names of columns of places on Earth."""

EAST_NORTH = {"easting": "x", "east": "x", "northing": "y", "north": "y"}
"""Axes by other names."""

OTHERS = frozenset(
    (
        *("t", "time", "stamp", "timestamp", "sec", "nsec", "s", "ms", "index", "idx", "id", "i"),
        *("k", "n", "no", "number", "seq", "frame", "step", "count", "row", "col", "column", "name"),
        *("z", "v", "vel", "velocity", "speed", "linear", "w", "omega", "angular", "rate", "twist"),
        *("a", "acc", "accel", "acceleration", "gyro", "imu", "force", "torque", "q", "quat"),
        *("quaternion", "orientation", "rot", "rotation", "heading", "yaw", "theta", "phi", "psi"),
        *("angle", "roll", "pitch", "radius", "r", "curvature", "b", "mag", "magnetic", "std", "sd"),
        *("sigma", "var", "variance", "cov", "covariance", "err", "error"),
    )
)
"""Words of columns that are no position."""

UNITS = frozenset({*LENGTHS, *DEGREES, "rad", "in", "inch", "inches", "px", "pixel", "pixels"})
"""Words that are a unit at the end of a name."""

TUM = "t x y z qx qy qz qw"
"""A row of a trajectory of TUM's format, which has no header."""

UNIT_WITHIN = 0.01
"""Largest error of the length of a quaternion."""

_AXIS = re.compile(r"(?:p|t|pos|position|pose|point|coord|wp|map|world)?([xy])(?:pos|position|coord)?\d*")
_PLAIN = re.compile(r"[ab]|(?:c|col|column|dim|axis)?[ _]*\d+")
"""Names that say nothing of a column."""


def path_of_points(p_xy: ArrayLike, name: str = "points", file: str = "") -> Path:
    """A polyline through points; it is closed if the last point equals the first.

    Args:
        p_xy: Points in world [m], shape (N, 2), N >= 2. Equal neighbours are merged.
        name: Name of the path.
        file: The file of the points.

    Raises:
        InputError: The points are not finite numbers of that shape, or only one point.
    """
    try:
        p = np.asarray(p_xy, float)
    except (TypeError, ValueError) as error:
        raise InputError(f"path {name!r}: points must be numbers of shape (N, 2) [m] ({error})") from error
    if p.ndim != 2 or p.shape[1] != 2 or not len(p):
        raise InputError(f"path {name!r}: points must have shape (N, 2) [m], got {p.shape}")
    line = without_repeats(p)
    return Path(name, p, len(line) > 2 and math.dist(line[0], line[-1]) < SAME_M, file)


def resolve_path(path: "str | os.PathLike[str] | ArrayLike") -> Path:
    """A path from a name of `PATHS`, a case A to E of `CASES`, a CSV file, or points of shape (N, 2) [m].

    Raises:
        InputError: It is none of these, or the file is not a path.
    """
    if not isinstance(path, str | os.PathLike):
        return path_of_points(path)
    text = os.fspath(path)
    if text in PATHS or text in CASES:
        return path_named(text)
    file = FilePath(text)
    if file.exists() or file.suffix or file.name != text:
        return read_path_csv(file)
    raise InputError(f"no path {text!r}; {hint(text, PATHS)}; or give a CSV file with x,y in metres")


def read_path_csv(file: str | os.PathLike[str]) -> Path:
    """A polyline from a text file of x,y in metres, one point a line, with or without a header.

    A header names x and y, and perhaps their unit: `y,x`, `northing,easting` and `x [cm],y [cm]` are read by
    their names. If only one of two is known, the other column is the other. Rows of eight numbers without a
    header are a trajectory of TUM's format, `t x y z qx qy qz qw`. Equal neighbours are merged. A line whose
    last point equals the first is closed. Warns of what was repaired or left out, such as other columns.

    Raises:
        InputError: The file is missing, empty, has a line that is not two numbers, columns that are not
            lengths, or a header that does not tell x from y.
    """
    wanted = "x,y in metres, one point a line"
    text = read_delimited(expected(file, "path file"), "path file", "text", wanted).named()
    file, notes = text.path, list(text.notes)
    columns, factors = _x_and_y(text, notes)
    points: list[tuple[float, float]] = []
    for number, row in zip(text.lines, text.rows, strict=True):
        x, y = (number_of(row[column]) * factor for column, factor in zip(columns, factors, strict=True))
        if math.isinf(x) or math.isinf(y):
            shown = repr(",".join(row)[:QUOTED])
            raise InputError(f"{file}:{number}: not two finite numbers in {shown}; x,y in metres are wanted")
        if not (math.isnan(x) or math.isnan(y)):
            points.append((x, y))
    if missing := len(text.rows) - len(points):
        notes.append(f"{missing} of {len(text.rows)} points without a value left out")
    if len(without_repeats(np.array(points).reshape(-1, 2))) < 2:
        raise InputError(f"{file}: only {len(points[:1])} point in it; a path needs two that differ")
    if notes:
        warnings.warn(f"{file}: read {'; '.join(notes)}", RepairWarning, stacklevel=2)
    return path_of_points(points, file.name, file.as_posix())


def _x_and_y(text: Delimited, notes: list[str]) -> tuple[tuple[int, int], tuple[float, float]]:
    """Columns of x and y, and metres per unit of each; `notes` gets what is not plain."""
    if not text.names:
        return _without_header(text, notes), (1.0, 1.0)
    labels = [_label(name) for name in text.names]
    header = ",".join(text.names)[:QUOTED]
    x, y = _named(text, labels)
    missing = "columns x and y" if x is y is None else "column x" if x is None else "column y"
    if (
        any(not ANGLES.isdisjoint(words) for words, _ in labels)
        if x is None or y is None
        else labels[x][1] in DEGREES or labels[y][1] in DEGREES
    ):
        raise InputError(
            f"{text.path}: {header!r} are latitude and longitude; give x,y in metres in the axes of the lab"
        )
    if x is None and y is None and text.width == 2 and all(map(_PLAIN.fullmatch, map(str.lower, text.names))):
        x, y = 0, 1
        notes.append(f"columns {header!r} as x,y in metres")
    elif x is None or y is None:
        raise InputError(
            f"{text.path}: a point is two numbers, x,y in metres; no {missing} in {header!r}; "
            "name them in the header, such as x,y"
        )
    elif (labels[x][0], labels[y][0]) != (("x",), ("y",)):
        notes.append(f"{text.names[x]} as x and {text.names[y]} as y")
    elif x > y:
        notes.append("x and y by their names: y comes first")
    factors = []
    for column in (x, y):
        unit = labels[column][1] or "m"
        if unit not in LENGTHS:
            raise InputError(f"{text.path}: {text.names[column]!r} is no length; {hint(unit, LENGTHS)}")
        factors.append(LENGTHS[unit])
    if factors != [1.0, 1.0]:
        notes.append(f"{text.names[x]} and {text.names[y]} by the units in their names")
    if left := [name for k, name in enumerate(text.names) if k not in (x, y)]:
        notes.append(f"x and y, and left out {listed(left)}")
    return (x, y), (factors[0], factors[1])


def _without_header(text: Delimited, notes: list[str]) -> tuple[int, int]:
    """Columns of x and y of points, or of a trajectory of TUM's format."""
    where = f"{text.path}:{text.lines[0]}"
    if text.width == 2:
        return 0, 1
    if text.width != len(TUM.split()):
        shown, example = repr(",".join(text.rows[0])[:QUOTED]), "x,y,yaw" if text.width == 3 else "t,x,y"
        raise InputError(
            f"{where}: a point is two numbers, x,y in metres; got {shown}; add a header line, such as "
            f"{example}"
        )
    for number, row in zip(text.lines, text.rows, strict=True):
        length = math.hypot(*map(number_of, row[4:]))
        if not (math.isnan(length) or abs(length - 1) < UNIT_WITHIN):
            raise InputError(
                f"{text.path}:{number}: {text.width} numbers without a header are {TUM!r}, and the length of "
                f"the quaternion is {length:g}, not 1; add a header line that names x and y"
            )
    notes.append(f"x and y of {TUM!r}, by the eight numbers of a row")
    return 1, 2


def _label(name: str) -> tuple[tuple[str, ...], str]:
    """Words and unit of a label; the unit may be the last word, as in `x_cm`."""
    words, unit = split_label(name)
    if not unit and len(words) > 1 and words[-1] in UNITS:
        return words[:-1], words[-1]
    return words, unit


def _named(text: Delimited, labels: list[tuple[tuple[str, ...], str]]) -> tuple[int | None, int | None]:
    """Columns of x and y by their names; None if there is no such column."""
    names = [words for words, _ in labels]
    if names.count(("e",)) == names.count(("n",)) == 1 and not any(map(_axis, names)):
        return names.index(("e",)), names.index(("n",))
    found: list[int | None] = []
    for axis in "xy":
        plain = [k for k, words in enumerate(names) if words == (axis,)]
        columns = plain or [k for k, words in enumerate(names) if _axis(words) == axis]
        if len(columns) > 1:
            several = listed([text.names[k] for k in columns])
            raise InputError(
                f"{text.path}: no columns x and y alone: {several} could each be {axis}; keep one"
            )
        found.append(columns[0] if columns else None)
    x, y = found
    if text.width == 2 and (x is None) != (y is None):
        other = 1 - (y if x is None else x)  # type: ignore[operator]
        if OTHERS.isdisjoint(names[other]) and ANGLES.isdisjoint(names[other]):
            return (other, y) if x is None else (x, other)
    return x, y


def _axis(words: tuple[str, ...]) -> str:
    """The axis that a label names, "x" or "y"; "" if none, or something else along it, such as a speed."""
    if not OTHERS.isdisjoint(word for word in words if word != "t"):  # t_x is of a translation
        return ""
    axes = {match[1] for word in words if (match := _AXIS.fullmatch(word))}
    axes = axes or {EAST_NORTH[word] for word in words if word in EAST_NORTH}
    return axes.pop() if len(axes) == 1 else ""
