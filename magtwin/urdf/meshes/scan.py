"""Scan: STL and PLY, triangles without materials.

trimesh reads PLY and STL in text. Binary STL is an array; it is read here, since importing trimesh takes
longer than most conversions.
"""

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.budget import check_count, check_size
from magtwin.urdf.meshes.piece import Piece
from magtwin.urdf.meshes.reading import Reading
from magtwin.usd.geometry import linear_from_srgb

STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
"""A triangle of a binary STL, after 80 bytes of text and the number of triangles."""

WORD = 250
"""Bytes that a corner of an STL in text takes while it is read: two texts, and its numbers."""

LONGEST_LINE = 4096
"""Most characters of a line of a PLY's header."""


def read(reading: Reading) -> list[Piece]:
    """The triangles of an STL or PLY file, for `read_mesh`.

    Normals of an STL are ignored: they are those of the faces, from which smooth ones are computed. Texture
    coordinates of a PLY are ignored, since the format references no image.
    """
    data = reading.path.read_bytes()  # its size is checked
    stl = reading.path.suffix.lower() == ".stl"
    points = _binary_stl(data) if stl else None
    if points is not None and len(points):
        return [Piece(points=points, faces=np.arange(len(points)).reshape(-1, 3))]
    if points is not None:
        read: dict[str, Any] = {"geometry": {}}
    elif stl:
        text = _text(data, reading)
        from trimesh.exchange.stl import load_stl_ascii

        read = load_stl_ascii(io.StringIO(text))
    else:
        _check_counts(data, reading)
        from trimesh.exchange.ply import load_ply

        read = load_ply(io.BytesIO(data))
    parts = read["geometry"].values() if "geometry" in read else [read]  # an ASCII STL may have several
    pieces = [_piece(part) for part in parts if part.get("faces") is not None and len(part["faces"])]
    if not pieces and stl:
        raise InputError(f"{reading.path}: holds no triangle, or is cut short; export it again")
    return pieces


def _binary_stl(data: bytes) -> NDArray[np.float32] | None:
    """Corners of the triangles of a binary STL, shape (3 F, 3); None if the count does not fit the file."""
    count = int.from_bytes(data[80:84], "little")
    if len(data) < 84 or len(data) != 84 + count * STL.itemsize:
        return None
    return np.frombuffer(data, STL, offset=84)["corners"].reshape(-1, 3)


def _text(data: bytes, reading: Reading) -> str:
    """The text of an STL in text; it is split into words, each of which takes more room than in the file."""
    if b"\0" in data:
        raise InputError(
            f"{reading.path}: no STL, or cut short: its size does not fit its count; export it again"
        )
    check_size(reading.path, "OBJ")
    reading.spend(WORD * data.lower().count(b"vertex") + 3 * len(data))
    check_count(reading.path, "mesh", data.lower().count(b"endsolid"), "solids")
    return data.decode("utf-8", errors="replace")


def _check_counts(data: bytes, reading: Reading) -> None:
    """Refuse a PLY whose header claims more elements than the file has bytes, before they are read."""
    header = io.BytesIO(data)
    for line in iter(lambda: header.readline(LONGEST_LINE), b""):
        words = line.split()
        if words[:1] == [b"element"]:
            count = int(words[2])
            if len(words) != 3 or not 0 <= count <= len(data):
                raise InputError(
                    f"{reading.path}: claims {count} of {words[1].decode()[:40]} in {len(data)} bytes"
                )
        if words[:1] == [b"end_header"]:
            break
    else:
        raise ValueError("its header has no end")


def _piece(part: dict[str, Any]) -> Piece:
    faces = np.asarray(part["faces"], np.int64)
    normals, by_vertex, by_face = (
        part.get(key) for key in ("vertex_normals", "vertex_colors", "face_colors")
    )
    colours = None
    if by_vertex is not None:
        colours = _linear(by_vertex)[faces]
    elif by_face is not None:
        colours = np.repeat(_linear(by_face)[:, None], 3, axis=1)
    return Piece(
        points=np.asarray(part["vertices"], float),
        faces=faces,
        normals=None if normals is None else np.asarray(normals)[faces],
        colours=colours,
    )


def _linear(colours: NDArray) -> NDArray:
    """Linear red, green, blue of sRGB colours in bytes or from 0 to 1, shape (N, 3)."""
    colours = np.asarray(colours)
    return linear_from_srgb(colours[:, :3] / (255 if colours.dtype.kind in "iu" else 1))
