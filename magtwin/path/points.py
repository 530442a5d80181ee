"""Paths from points: an array, or a CSV file."""

import math
import os
import warnings
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import ArrayLike

from magtwin.delimited import DEGREES, LENGTHS, QUOTED, Delimited, label_of, number_of, read_delimited
from magtwin.errors import InputError, RepairWarning, hint
from magtwin.kinds import expected
from magtwin.path.curves import CASES, PATHS, path_named
from magtwin.path.polyline import SAME_M, Path, without_repeats
from magtwin.summary import listed

ANGLES = ("lat", "latitude", "lon", "lng", "long", "longitude")
"""Names of columns of places on Earth."""


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

    A header names x and y, and perhaps their unit: `y,x` and `x [cm],y [cm]` are read by their names. Equal
    neighbours are merged. A line whose last point equals the first is closed. Warns of what was repaired or
    left out, such as other columns.

    Raises:
        InputError: The file is missing, empty, has a line that is not two numbers, or columns that are not
            lengths.
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
    labels = [label_of(name) for name in text.names]
    where = f"{text.path}:{text.lines[0]}"
    if not labels:
        if text.width != 2:
            shown = repr(",".join(text.rows[0])[:QUOTED])
            raise InputError(f"{where}: a point is two numbers, x,y in metres; got {shown}")
        return (0, 1), (1.0, 1.0)
    named = [name for name, _ in labels]
    header = ",".join(text.names)[:QUOTED]
    if any(name in ANGLES or unit in DEGREES for name, unit in labels):
        raise InputError(
            f"{text.path}: {header!r} are latitude and longitude; give x,y in metres in the axes of the lab"
        )
    if named.count("x") == named.count("y") == 1:
        x, y = named.index("x"), named.index("y")
    elif text.width == 2:
        x, y = 0, 1
        notes.append(f"columns {header!r} as x,y in metres")
    else:
        raise InputError(f"{where}: a point is two numbers, x,y in metres; no columns x and y in {header!r}")
    if (x, y) == (1, 0):
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
