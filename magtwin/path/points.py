"""Paths from points: an array, or a CSV file."""

import math
import os
from pathlib import Path as FilePath

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import InputError, hint
from magtwin.files import existing_file
from magtwin.kinds import expected
from magtwin.path.curves import CASES, PATHS, path_named
from magtwin.path.polyline import SAME_M, Path, without_repeats


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
    """A polyline from a CSV file of `x,y` in metres, one point a line, with or without a header.

    Equal neighbours are merged. A line whose last point equals the first is closed.

    Raises:
        InputError: The file is missing, empty, or has a line that is not two numbers.
    """
    file = existing_file(expected(file, "path file"), "path file", "text")
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{file}: not a text file of x,y in metres ({error})") from error
    points: list[tuple[float, float]] = []
    header_seen = False
    for number, line in enumerate(lines, 1):
        cells = [cell.strip() for cell in line.split(",")]
        if cells == [""]:
            continue
        if len(cells) != 2:
            raise InputError(f"{file}:{number}: a point is two numbers, x,y in metres; got {line!r}")
        try:
            point = float(cells[0]), float(cells[1])
        except ValueError:
            if points or header_seen:
                raise InputError(
                    f"{file}:{number}: not a number in {line!r}; x,y in metres are wanted"
                ) from None
            header_seen = True
            continue
        if not (math.isfinite(point[0]) and math.isfinite(point[1])):
            raise InputError(f"{file}:{number}: a point must be finite, got {line!r}")
        points.append(point)
    if not points:
        raise InputError(f"{file}: no points in it; one x,y in metres a line is wanted")
    if len(without_repeats(np.array(points))) < 2:
        raise InputError(f"{file}: only one point in it; a path needs two that differ")
    return path_of_points(points, file.name, file.as_posix())
