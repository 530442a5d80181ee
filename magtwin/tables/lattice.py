"""Lattice: grids of Surfer and of ESRI as columns x, y and field, a row a node that is not blank."""

import re
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError

Array = NDArray[np.float64]

BLANK = 1.7e38  # Least value of a node that Surfer left blank
_ESRI = re.compile(rb"\s*ncols\s+\d+\s+nrows\s", re.IGNORECASE)
_SURFER = struct.Struct("<4s2h6d")  # Version 6: marks, counts, ranges; then floats


def is_lattice(content: bytes) -> bool:
    """Whether bytes are those of a grid that `nodes_of` reads."""
    return content.startswith((b"DSAA", b"DSBB")) or bool(_ESRI.match(content[:80]))


def nodes_of(path: Path, content: bytes) -> tuple[dict[str, Array], str]:
    """Columns of the nodes of a grid, and what it is in words.

    The first row of Surfer's (DSAA, DSBB) is that of the least y, the first of ESRI's (.asc) that of the
    largest. Values of ESRI's belong to the middle of a cell.
    """
    try:
        x, y, z = (_esri if _ESRI.match(content[:80]) else _surfer)(content)
    except (ValueError, KeyError, IndexError, struct.error):
        raise InputError(
            f"{path}: a damaged grid, whose values are not those of its rows and columns"
        ) from None
    places = np.meshgrid(x, y)
    known = np.isfinite(z)
    text = f"{len(x)} x {len(y)} nodes of a grid, {np.count_nonzero(~known)} of them blank"
    return {"x": places[0][known], "y": places[1][known], "field": z[known]}, text


def _surfer(content: bytes) -> tuple[Array, Array, Array]:
    if content.startswith(b"DSBB"):
        _, columns, rows, *ranges = _SURFER.unpack_from(content)
        values = np.frombuffer(content, "<f4", columns * rows, _SURFER.size).astype(float)
    else:
        words = content.decode("ascii").split()[1:]
        columns, rows = int(words[0]), int(words[1])
        ranges, values = [float(word) for word in words[2:8]], np.array(words[8:], float)
    z = np.where(np.abs(values) >= BLANK, np.nan, values).reshape(rows, columns)
    x0, x1, y0, y1 = ranges[:4]
    return np.linspace(x0, x1, columns), np.linspace(y0, y1, rows), z


def _esri(content: bytes) -> tuple[Array, Array, Array]:
    words = content.decode("ascii").lower().split()
    head = dict[str, float]()
    while words[2 * len(head)][0].isalpha() and words[2 * len(head)] != "nan":
        head[words[2 * len(head)]] = float(words[2 * len(head) + 1])
    z = np.array(words[2 * len(head) :], float).reshape(int(head["nrows"]), int(head["ncols"]))[::-1]
    z = np.where(z == head.get("nodata_value", np.nan), np.nan, z)
    sizes = [head["cellsize"] if "cellsize" in head else head[f"d{axis}"] for axis in "xy"]
    corner = (
        head[f"{a}llcenter"] if f"{a}llcenter" in head else head[f"{a}llcorner"] + size / 2
        for a, size in zip("xy", sizes, strict=True)
    )
    x, y = (at + size * np.arange(n) for at, size, n in zip(corner, sizes, z.shape[::-1], strict=True))
    return x, y, z
