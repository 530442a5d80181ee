"""Mesh: triangles of a mesh file, by colour, repaired where that is harmless and with a note of it."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.names import RefusedError

SUFFIXES = (".dae", ".glb", ".obj", ".ply", ".stl")
"""Formats that can be read; textures are not."""

Rgba = tuple[float, float, float, float]


@dataclass(frozen=True)
class MeshPart:
    """Triangles of one colour."""

    vertices: NDArray[np.float64]
    """Vertices, no two alike [m], shape (V, 3)."""

    faces: NDArray[np.int64]
    """Corners of the triangles, shape (F, 3)."""

    colour: Rgba | None
    """Colour that the file gives, as screens show it (sRGB), 0 to 1; none where it gives none."""


@dataclass(frozen=True)
class Mesh:
    """A mesh file."""

    path: Path
    parts: tuple[MeshPart, ...]
    notes: tuple[str, ...]
    """What was repaired, one line each."""

    def merged(self) -> MeshPart:
        """All parts as one, without colour."""
        counts = np.cumsum([0, *(len(part.vertices) for part in self.parts)])
        faces = [part.faces + n for part, n in zip(self.parts, counts, strict=False)]
        return _clean(np.vstack([part.vertices for part in self.parts]), np.vstack(faces), None)[0]

    def hull(self) -> MeshPart:
        """The convex hull of all parts."""
        from scipy.spatial import ConvexHull, QhullError

        points = self.merged().vertices
        try:
            hull = ConvexHull(points)
        except QhullError as error:
            raise RefusedError(
                f"{self.path}: is flat and has no convex hull to collide with; use a box instead"
            ) from error
        faces, normals = hull.simplices, hull.equations[:, :3]
        a, b, c = np.moveaxis(points[faces], 1, 0)
        inwards = np.sum(np.cross(b - a, c - a) * normals, axis=1) < 0
        faces = np.where(inwards[:, None], faces[:, ::-1], faces)
        first = np.argmin(faces, axis=1)[:, None]  # each from its least corner, then in order of corners
        faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
        return _clean(points, faces[np.lexsort(faces.T[::-1])], None)[0]


def mesh_path(filename: str, urdf: Path) -> Path:
    """The file that a `<mesh filename=>` means: relative to the URDF's folder, or in a package.

    `package://NAME/rest` is looked for in the folders called NAME that hold the URDF or lie beside
    it or its parents.

    Raises:
        RefusedError: The file is missing, lies outside that folder, or is of an unknown format.
    """
    folder, rest = urdf.resolve().parent, filename.removeprefix("file://")
    if filename.startswith(("package://", "model://")):
        name, _, rest = filename.partition("://")[2].partition("/")
        around = [p for parent in (folder, *folder.parents) for p in (parent, parent / name)]
        found = next((p for p in around if p.name == name and p.is_dir()), None)
        if found is None:
            raise RefusedError(
                f"{urdf}: mesh {filename!r} is in a package {name!r}, and no folder of that name holds the "
                "URDF or lies beside it; put the package there"
            )
        folder = found
    path = Path(os.path.normpath(folder / rest))
    if not path.resolve().is_relative_to(folder):
        raise RefusedError(
            f"{urdf}: mesh {filename!r} lies outside {folder}; meshes are read from there only, move it in"
        )
    if path.suffix.lower() not in SUFFIXES:
        raise RefusedError(f"{urdf}: mesh {filename!r} is of no known format ({', '.join(SUFFIXES)})")
    if not path.is_file():
        raise RefusedError(f"{urdf}: mesh {filename!r} is missing; looked for {path}")
    return path


def read_mesh(path: Path) -> Mesh:
    """Read a mesh file.

    Lengths are metres; a COLLADA file's unit is applied, its up axis is not, as in RViz.

    Raises:
        RefusedError: The file cannot be read, or holds no triangle.
    """
    notes: list[str] = []
    try:
        raw = _read_collada(path, notes) if path.suffix.lower() == ".dae" else _read_other(path)
    except RefusedError:
        raise
    except Exception as error:  # mesh readers raise whatever they stumble upon
        reason = str(error).strip().splitlines() or [type(error).__name__]
        raise RefusedError(f"{path}: cannot be read as a mesh: {reason[0]}; export it again") from error
    by_colour: dict[Rgba | None, list[tuple[NDArray, NDArray]]] = {}
    for vertices, faces, colour in raw:
        by_colour.setdefault(colour, []).append((vertices, faces))
    parts, lost = [], 0
    for colour, pieces in by_colour.items():
        counts = np.cumsum([0, *(len(v) for v, _ in pieces)])
        faces = np.vstack([f + n for (_, f), n in zip(pieces, counts, strict=False)])
        part, dropped = _clean(np.vstack([v for v, _ in pieces]), faces, colour)
        lost += dropped
        if len(part.faces):
            parts.append(part)
    if not parts:
        raise RefusedError(f"{path}: holds no triangle; export it again, or use a primitive")
    if lost:
        notes.append(f"{path.name}: {lost} triangles without an area left out")
    return Mesh(path, tuple(parts), tuple(notes))


def _read_other(path: Path) -> list[tuple[NDArray, NDArray, Rgba | None]]:
    """STL, OBJ, PLY and glTF by trimesh: vertices, faces and colour of each piece."""
    import trimesh

    scene = trimesh.load_scene(path, process=False, skip_materials=path.suffix.lower() != ".glb")
    pieces = []
    for node in sorted(scene.graph.nodes_geometry):
        to_world, name = scene.graph[node]
        mesh = scene.geometry[name]
        if not hasattr(mesh, "faces"):
            continue
        vertices = mesh.vertices @ to_world[:3, :3].T + to_world[:3, 3]
        faces = mesh.faces[:, ::-1] if np.linalg.det(to_world[:3, :3]) < 0 else mesh.faces
        colour = None
        if path.suffix.lower() == ".glb" and hasattr(mesh.visual, "material"):
            r, g, b, a = (float(c) / 255 for c in mesh.visual.material.main_color)
            colour = (r, g, b, a)
        pieces.append((np.asarray(vertices, float), np.asarray(faces, int), colour))
    return pieces


def _read_collada(path: Path, notes: list[str]) -> list[tuple[NDArray, NDArray, Rgba | None]]:
    """COLLADA by pycollada, which composes the nodes' transforms in the order that they nest.

    Malformed colours make it drop the effect, then the material, then the geometry; they are mended
    in the text first.
    """
    import io

    import collada
    from collada.common import DaeError

    text, mended = _mend_colours(path.read_text(encoding="utf-8", errors="replace"))
    notes += [f"{path.name}: {line}" for line in mended]
    file = collada.Collada(io.BytesIO(text.encode()), ignore=[DaeError])
    if file.assetInfo.upaxis not in (None, collada.asset.UP_AXIS.Z_UP):
        notes.append(f"{path.name}: its up axis {file.assetInfo.upaxis} is not applied, as in RViz")
    for error in file.errors:
        notes.append(f"{path.name}: {type(error).__name__}: {str(error).strip() or 'malformed'}")
    if file.scene is None:
        raise RefusedError(f"{path}: has no scene to show; export it again")
    unit, pieces = float(file.assetInfo.unitmeter or 1.0), []
    shown = set()
    for geometry in file.scene.objects("geometry"):
        shown.add(geometry.original.id)
        for primitive in geometry.primitives():
            pieces += _collada_piece(primitive, unit, path, notes)
    for geometry in file.geometries:
        if geometry.id not in shown:
            notes.append(f"{path.name}: geometry {geometry.id!r} is not in the file's scene and is left out")
    return pieces


def _collada_piece(
    primitive: Any, unit: float, path: Path, notes: list[str]
) -> list[tuple[NDArray, NDArray, Rgba | None]]:
    """Triangles of one bound primitive; lines and points have none."""
    kind = type(primitive).__name__
    if hasattr(primitive, "triangleset"):
        primitive = primitive.triangleset()
    if not hasattr(primitive, "vertex_index") or np.shape(primitive.vertex_index)[-1] != 3:
        notes.append(f"{path.name}: a {kind} holds no triangles and is left out")
        return []
    if primitive.vertex_index is None or not len(primitive.vertex_index):
        return []
    effect = getattr(primitive.material, "effect", None)
    diffuse = getattr(effect, "diffuse", None)
    colour: Rgba | None = None
    if isinstance(diffuse, tuple):
        r, g, b, a = (float(np.clip(c, 0, 1)) for c in (*diffuse, 1.0)[:4])
        colour = (r, g, b, a)
    elif diffuse is not None:
        notes.append(f"{path.name}: a texture is not converted")
    return [(np.asarray(primitive.vertex, float) * unit, np.asarray(primitive.vertex_index, int), colour)]


def _mend_colours(text: str) -> tuple[str, list[str]]:
    """`<color>` elements of effects with four numbers again: fused numbers parted, opacity added."""
    mended: list[str] = []

    def mend(match: re.Match[str]) -> str:
        tokens = match[2].split()
        parted = [piece for token in tokens for piece in _part(token)]
        try:
            numbers = [float(piece) for piece in parted]
        except ValueError:
            numbers = []
        if len(tokens) == 4 and numbers and len(numbers) == 4:
            return match[0]
        numbers = [*numbers, 1.0] if len(numbers) == 3 else numbers
        numbers = numbers if len(numbers) == 4 else [0.5, 0.5, 0.5, 1.0]
        new = " ".join(f"{n:g}" for n in numbers)
        mended.append(f"malformed colour {match[2].strip()!r} read as {new!r}")
        return f"{match[1]}{new}{match[3]}"

    start = text.find("<library_effects")
    end = text.find("</library_effects>")
    if start < 0 or end < 0:  # colours of lights have three numbers and matter to nobody here
        return text, mended
    effects = re.sub(r"(<color[^>]*>)([^<]*)(</color>)", mend, text[start:end])
    return text[:start] + effects + text[end:], mended


def _part(token: str) -> list[str]:
    """Two numbers that were written without a space: "0.01.0" is 0.0 and 1.0."""
    fused = re.fullmatch(r"(\d+\.\d+?)(\d\.\d+)", token)
    return [fused[1], fused[2]] if fused else [token]


def _clean(vertices: NDArray, faces: NDArray, colour: Rgba | None) -> tuple[MeshPart, int]:
    """Like vertices made one, triangles without an area and unused vertices left out; and how many went."""
    points, index = np.unique(np.asarray(vertices, np.float32), axis=0, return_inverse=True)
    faces = index.reshape(-1)[faces]
    a, b, c = np.moveaxis(points[faces].astype(float), 1, 0)
    flat = np.linalg.norm(np.cross(b - a, c - a), axis=1) <= 1e-14
    used, kept = np.unique(faces[~flat], return_inverse=True)
    part = MeshPart(points[used].astype(float), kept.reshape(-1, 3), colour)
    return part, int(flat.sum())
