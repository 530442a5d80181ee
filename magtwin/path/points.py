"""Paths from points: an array, or a CSV file."""

import math
import os
import re
import warnings
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import InputError, RepairWarning, near
from magtwin.files.kinds import expected
from magtwin.path.curves import CASES, PATHS, path_named
from magtwin.path.polyline import SAME_M, Path, without_repeats
from magtwin.tables.delimited import QUOTED
from magtwin.tables.labels import is_on_earth
from magtwin.tables.table import Table, read_table

TUM = "t x y z qx qy qz qw"
"""A row of a trajectory of TUM's format, which has no header."""

UNIT_WITHIN = 0.01
"""Largest error of the length of a quaternion."""

_PLAIN = re.compile(r"[ab]|(?:c|col|column|dim|axis)?[ _]*\d+", re.IGNORECASE)
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
    meant = near(text, PATHS) or f"; known: {', '.join(sorted(PATHS))}"
    raise InputError(f"no path {text!r}{meant}; give a name, or a CSV file with x,y in metres")


def read_path_csv(file: str | os.PathLike[str]) -> Path:
    """A polyline from a table of x,y in metres, one point a row, with or without a header.

    A header names x and y by any name of `magtwin.tables.quantities`, and perhaps their unit: `y,x`,
    `northing,easting` and `x [cm],y [cm]` are read by their names. Rows of eight numbers without a header are
    a trajectory of TUM's format, `t x y z qx qy qz qw`. Equal neighbours are merged. A line whose last point
    equals the first is closed. Warns of what was repaired or left out, such as other columns.

    Raises:
        InputError: The file is missing, empty, has a cell that is not a number, columns that are not lengths,
            or a header that does not tell x from y.
    """
    table = read_table(expected(file, "path file"), "path file", "x,y in metres, one point a line")
    x, y, notes = _x_and_y(table)
    points = np.column_stack([table.numbers(x, "x"), table.numbers(y, "y")])
    known = np.isfinite(points).all(axis=1)
    if missing := int(np.count_nonzero(~known)):
        notes.append(f"{missing} of {len(points)} points without a value left out")
    points = points[known]
    if len(without_repeats(points)) < 2:
        raise InputError(f"{table.path}: only {len(points[:1])} point in it; a path needs two that differ")
    if notes := [*table.notes, *notes]:
        warnings.warn(f"{table.path}: read {'; '.join(notes)}", RepairWarning, stacklevel=2)
    return path_of_points(points, table.path.name, table.path.as_posix())


def _x_and_y(table: Table) -> tuple[str, str, list[str]]:
    """Columns of x and y, and what was deduced about them."""
    labels = [column.name for column in table.columns if column.name]
    if not labels:
        return ("2", "3", _tum(table)) if len(table.columns) > 2 else ("1", "2", [])
    if found := table.find("x", "y"):
        x, y = found
        return x, y, table.taken({"x": x, "y": y})
    header = ",".join(labels)[:QUOTED]
    if any(map(is_on_earth, labels)):
        raise InputError(
            f"{table.path}: {header!r} are latitude and longitude; give x,y in metres in the axes of the lab"
        )
    if len(labels) == 2 and all(map(_PLAIN.fullmatch, labels)):
        return "1", "2", [f"columns {header!r} as x,y in metres"]
    raise InputError(
        f"{table.path}: a point is two numbers, x,y in metres; no columns x and y in {header!r}; name "
        "them in the header, such as x,y"
    )


def _tum(table: Table) -> list[str]:
    """A note on a trajectory of TUM's format; other rows without a header are refused."""
    where, width = table.columns[0].where(0), len(table.columns)
    if width != len(TUM.split()):
        shown = ",".join(column.cells[0] for column in table.columns)[:QUOTED]
        raise InputError(
            f"{where}: a point is two numbers, x,y in metres; got {shown!r}; add a header line, such as "
            f"{'x,y,yaw' if width == 3 else 't,x,y'}"
        )
    length = np.linalg.norm([table.numbers(name) for name in "5678"], axis=0)
    if len(wrong := np.flatnonzero(np.abs(length - 1) >= UNIT_WITHIN)):
        raise InputError(
            f"{table.columns[0].where(int(wrong[0]))}: {width} numbers without a header are {TUM!r}, and the "
            f"length of the quaternion is {length[wrong[0]]:g}, not 1; add a header line that names x and y"
        )
    return [f"x and y of {TUM!r}, by the eight numbers of a row"]
