"""Scan: STL and PLY, triangles without materials, read by trimesh."""

from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.urdf.meshes.piece import Piece
from magtwin.urdf.meshes.reading import Reading
from magtwin.usd.geometry import linear_from_srgb

LONGEST_LINE = 4096
"""Most characters of a line of a PLY's header."""


def read_scan(reading: Reading) -> list[Piece]:
    """The triangles of an STL or PLY file, for `read_mesh`.

    Normals of an STL are ignored: they are those of the faces, from which smooth ones are computed. Texture
    coordinates of a PLY are ignored, since the format references no image.
    """
    with reading.path.open("rb") as stream:
        if reading.path.suffix.lower() == ".stl":
            from trimesh.exchange.stl import load_stl

            read = load_stl(stream)
        else:
            from trimesh.exchange.ply import load_ply

            _check_counts(stream, reading)
            read = load_ply(stream)
    parts = read["geometry"].values() if "geometry" in read else [read]  # an ASCII STL may have several
    pieces = [_piece(part) for part in parts if part.get("faces") is not None and len(part["faces"])]
    if not pieces and reading.path.suffix.lower() == ".stl":
        raise InputError(f"{reading.path}: holds no triangle, or is cut short; export it again")
    return pieces


def _check_counts(stream: BinaryIO, reading: Reading) -> None:
    """Refuse a PLY whose header claims more elements than the file has bytes, before they are read."""
    size = reading.path.stat().st_size
    for line in iter(lambda: stream.readline(LONGEST_LINE), b""):
        words = line.split()
        if words[:1] == [b"element"]:
            count = int(words[2])
            if len(words) != 3 or not 0 <= count <= size:
                raise InputError(
                    f"{reading.path}: claims {count} of {words[1].decode()[:40]} in {size} bytes"
                )
        if words[:1] == [b"end_header"]:
            break
    else:
        raise ValueError("its header has no end")
    stream.seek(0)


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
