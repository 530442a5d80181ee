"""Mesh: triangles of a mesh file with their normals, colours and textures, in metres."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.file import existing_file
from magtwin.urdf.meshes.piece import Paint, Piece
from magtwin.urdf.meshes.reading import Images, Note, Reading
from magtwin.urdf.source.markup import UnsafeError
from magtwin.usd.solids import corner_normals

READERS: Mapping[str, str] = {
    ".dae": "collada",
    ".glb": "gltf",
    ".gltf": "gltf",
    ".obj": "wavefront",
    ".ply": "scan",
    ".stl": "scan",
}
"""Module beside this one by suffix of the files that it reads, imported when first needed."""

MOST_PAINTS = 10_000
"""Most materials of a mesh; in USD, their prims take time by their square."""

HASH = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9)
"""Odd factors of the key that `distinct` sorts by, one a column; any work."""


class UnreadableMeshError(InputError):
    """A mesh file is damaged, empty or of an unknown format."""


@dataclass(frozen=True)
class Mesh:
    """A mesh file. Values at corners are None if no piece has them, and nan for pieces without them."""

    path: Path

    points: NDArray[np.float32]
    """Distinct vertices [m], shape (V, 3)."""

    faces: NDArray[np.int64]
    """Corners of the triangles, counter-clockwise from outside, shape (F, 3)."""

    paints: tuple[Paint | None, ...]
    """Materials; None stands for triangles without one."""

    paint: NDArray[np.int64]
    """Index of each triangle's paint, shape (F,)."""

    normals: NDArray | None
    """Unit normals at the corners, shape (F, 3, 3)."""

    uvs: NDArray | None
    """Texture coordinates at the corners, shape (F, 3, 2)."""

    colours: NDArray | None
    """Linear colours at the corners, shape (F, 3, 3)."""

    notes: tuple[Note, ...] = ()
    """Repairs, guesses and omissions."""

    def shaded(self) -> NDArray[np.float32]:
        """Unit normals at the corners, from the file or computed from the faces; shape (F, 3, 3)."""
        if self.normals is not None and np.isfinite(self.normals).all():
            return self.normals
        computed = corner_normals(self.points, self.faces)
        return (
            computed if self.normals is None else np.where(np.isfinite(self.normals), self.normals, computed)
        )


def read_mesh(
    path: Path, may_read: Callable[[Path], bool] | None = None, images: Images | None = None
) -> Mesh:
    """Read a mesh file.

    As in RViz (rviz_rendering, assimp_loader.cpp), COLLADA's unit is applied but not its up axis, and glTF is
    turned from Y up to Z up.

    Args:
        path: The file; its suffix determines the format.
        may_read: Whether a referenced file (material library, texture, buffer) may be read. Default: files
            in the folder of the mesh and below.
        images: Images that files of the same robot share. Default: none.

    Raises:
        UnreadableMeshError: The file cannot be read, has no triangle, or has vertices that are not finite.
        UnsafeError: It refers to files that it may not read, or has entities.
    """
    folder = path.resolve().parent
    allowed = may_read or (lambda other: other.resolve().is_relative_to(folder))
    reading = Reading(existing_file(path, "mesh file", "mesh"), allowed, images or Images())
    try:
        kind = READERS.get(path.suffix.lower())
        if kind is None:
            raise InputError(f"{path}: is of no known mesh format ({', '.join(READERS)})")
        return _join(reading, import_module(f"magtwin.urdf.meshes.{kind}").read(reading))
    except UnsafeError:
        raise
    except InputError as error:
        raise UnreadableMeshError(str(error)) from error
    except Exception as error:  # readers raise many types on a damaged file
        reason = str(error).strip().splitlines() or [type(error).__name__]
        text = f"{path}: cannot be read as a mesh: {reason[0]}; export it again"
        raise UnreadableMeshError(text) from error


def _join(reading: Reading, pieces: Sequence[Piece]) -> Mesh:
    """All pieces as one mesh, with equal points merged and triangles without an area removed."""
    path, pieces = reading.path, [piece for piece in pieces if piece.faces.size]
    if not pieces:
        raise InputError(f"{path}: holds no triangle; export it again, or use a primitive")
    for piece in pieces:
        if not 0 <= piece.faces.min() <= piece.faces.max() < len(piece.points):
            raise InputError(
                f"{path}: a face names vertex {piece.faces.max()} of {len(piece.points)}; export it again"
            )
    tables = {id(piece.points): piece.points for piece in pieces}  # groups of a file share their vertices
    first = dict(zip(tables, np.cumsum([0, *map(len, tables.values())]), strict=False))
    points = np.vstack([np.asarray(table, np.float32) for table in tables.values()])
    faces = np.vstack([np.asarray(piece.faces, np.int64) for piece in pieces])
    faces += np.repeat([first[id(p.points)] for p in pieces], [len(p.faces) for p in pieces])[:, None]
    del tables
    if not np.isfinite(points).all() and not np.isfinite(points[faces]).all():
        raise InputError(f"{path}: has vertices that are not finite numbers; export it again")
    pieces = [replace(_textured(_coloured(piece, reading), reading), points=points[:0]) for piece in pieces]
    numbers = {paint: number for number, paint in enumerate(dict.fromkeys(p.paint for p in pieces))}
    paints = tuple(numbers)
    if len(paints) > MOST_PAINTS:
        raise InputError(f"{path}: has over {MOST_PAINTS:,} materials; merge those that look alike")
    paint = np.repeat([numbers[p.paint] for p in pieces], [len(p.faces) for p in pieces])
    kept, index = distinct(points)
    points, faces = points[kept], index[faces]
    del kept, index  # as long as the file
    solid = has_area(points, faces)
    if not solid.any():
        raise InputError(f"{path}: holds no triangle with an area; export it again, or use a primitive")
    lost = int(len(faces) - solid.sum())
    if lost:
        reading.note(f"{lost} triangles without an area left out")
    faces, paint = faces[solid], paint[solid]
    used = np.zeros(len(points), bool)
    used[faces] = True
    shown = np.flatnonzero(np.bincount(paint))
    return Mesh(
        path=path,
        points=points[used],
        faces=(np.cumsum(used) - 1)[faces],
        paints=tuple(paints[i] for i in shown),
        paint=np.searchsorted(shown, paint),
        normals=_unit(_at_corners([p.normals for p in pieces], pieces, 3, solid)),
        uvs=_at_corners([p.uvs for p in pieces], pieces, 2, solid),
        colours=_at_corners([p.colours for p in pieces], pieces, 3, solid),
        notes=tuple(reading.notes),
    )


def _coloured(piece: Piece, reading: Reading) -> Piece:
    """A piece with colours at corners only if it has no other look."""
    if piece.colours is None or (piece.paint is not None and piece.paint.by_vertex):
        return piece
    if piece.paint is None:
        return replace(piece, paint=Paint("vertex_colours", by_vertex=True))
    reading.lose("colours of vertices are left out where a material covers them")
    return replace(piece, colours=None)


def _textured(piece: Piece, reading: Reading) -> Piece:
    """A piece with a textured paint only if it has texture coordinates."""
    paint = piece.paint
    if paint is None or not paint.textured or piece.uvs is not None:
        return piece
    reading.lose(f"material {paint.name!r}: its textures are left out where there are no texture coordinates")
    return replace(piece, paint=paint.without_textures)


def _at_corners(
    values: Sequence[NDArray | None], pieces: Sequence[Piece], width: int, kept: NDArray
) -> NDArray | None:
    """Values at the corners of all pieces, nan for pieces without them; None if no piece has them."""
    if all(value is None for value in values):
        return None
    filled = [
        np.full((len(piece.faces), 3, width), np.nan) if value is None else value
        for value, piece in zip(values, pieces, strict=True)
    ]
    return np.vstack(filled).astype(np.float32)[kept]


def _unit(normals: NDArray | None) -> NDArray | None:
    """Normals of length 1; nan for zero vectors."""
    if normals is None:
        return None
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(length > 1e-12, normals / length, np.nan).astype(np.float32)


def has_area(points: NDArray, faces: NDArray) -> NDArray[np.bool_]:
    """Whether each triangle has an area, relative to the square of its longest edge."""
    x, y, z = points.astype(float).T
    a, b, c = faces.T
    u, v, w = ((p[b] - p[a], p[c] - p[a], p[c] - p[b]) for p in (x, y, z))
    uu, vv, ww = (u[i] ** 2 + v[i] ** 2 + w[i] ** 2 for i in range(3))
    nx, ny, nz = v[0] * w[1] - w[0] * v[1], w[0] * u[1] - u[0] * w[1], u[0] * v[1] - v[0] * u[1]
    return nx**2 + ny**2 + nz**2 > (1e-9 * np.maximum(uu, np.maximum(vv, ww))) ** 2


def distinct(rows: NDArray) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The distinct rows of an array of floats, in the order of first occurrence.

    Args:
        rows: Taken in single precision, shape (N, K).

    Returns:
        Index of the first row of each kind, shape (D,), and the kind of each row, shape (N,).
    """
    words = np.ascontiguousarray(rows + np.float32(0), np.float32).view(np.uint32)  # + 0 makes -0 into 0
    if not len(words):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    keys = np.zeros(len(words), np.uint64)
    for column, factor in zip(words.T, HASH, strict=False):  # integers have no fast matrix product
        keys += column * np.uint64(factor)
    order = np.argsort(keys)
    keys = keys[order]
    is_start = np.append(True, keys[1:] != keys[:-1])
    of_key = np.minimum.reduceat(order, np.flatnonzero(is_start))
    first = keys.view(np.int64)  # from here on, the first row that is equal to each
    first[order] = of_key[np.cumsum(is_start) - 1]
    for column in words.T:
        if (column != column[first]).any():  # different rows with one key: by their bits
            return _distinct_words(words)
    is_first = np.zeros(len(words), bool)
    is_first[of_key] = True
    return np.flatnonzero(is_first), (np.cumsum(is_first) - 1)[first]


def _distinct_words(words: NDArray[np.uint32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """`distinct` of rows of bits; takes longer."""
    order = np.lexsort(words.T)  # is stable: of equal rows, the first is first
    starts = np.append(True, (words[order[1:]] != words[order[:-1]]).any(axis=1))
    first = np.empty_like(order)
    first[order] = order[starts][np.cumsum(starts) - 1]
    is_first = first == np.arange(len(order))
    return np.flatnonzero(is_first), (np.cumsum(is_first) - 1)[first]


def face_normals(points: NDArray, faces: NDArray) -> NDArray[np.float64]:
    """Unit normals of triangles, shape (F, 3); args as for `corner_normals`."""
    a, b, c = (points[faces[:, i]].astype(float) for i in range(3))
    area = np.cross(b - a, c - a)
    return area / np.linalg.norm(area, axis=1, keepdims=True)
