"""Scan: STL, triangles without materials."""

import re

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.budget import check_size
from magtwin.urdf.meshes.piece import Piece
from magtwin.urdf.meshes.reading import Reading, numbers

STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
"""A triangle of a binary STL, after 80 bytes of text and the number of triangles."""

VERTEX = re.compile(rb"^\s*vertex\s+(\S+\s+\S+\s+\S+)\s*$", re.MULTILINE | re.IGNORECASE)

WORD = 250
"""Bytes that a corner of an STL in text takes while it is read."""


def read(reading: Reading) -> list[Piece]:
    """The triangles of an STL file, for `read_mesh`.

    Its normals are ignored: they are those of the faces, from which smooth ones are computed.
    """
    data = reading.path.read_bytes()  # its size is checked
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= 84 and len(data) == 84 + count * STL.itemsize:
        points = np.frombuffer(data, STL, offset=84)["corners"].reshape(-1, 3)
    else:
        points = _corners(data, reading)
    if not len(points) or len(points) % 3:
        raise InputError(f"{reading.path}: holds no triangle, or is cut short; export it again")
    return [Piece(points=points, faces=np.arange(len(points)).reshape(-1, 3))]


def _corners(data: bytes, reading: Reading) -> NDArray[np.float64]:
    """Corners of the triangles of an STL in text, shape (3 F, 3)."""
    if b"\0" in data:
        raise InputError(
            f"{reading.path}: no STL, or cut short: its size does not fit its count; export it again"
        )
    if b"endsolid" not in data.lower():
        return np.empty((0, 3))
    check_size(reading.path, "OBJ")
    reading.spend(WORD * data.lower().count(b"vertex") + 3 * len(data))
    rows = VERTEX.findall(data)
    values = numbers(b" ".join(rows).decode("ascii", errors="replace"), float)
    return values.reshape(-1, 3) if len(values) == 3 * len(rows) else np.empty((0, 3))
