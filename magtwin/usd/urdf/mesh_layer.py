"""Meshes: the big arrays of a robot, each mesh file once, in a layer of its own (.usdc).

The readable root layer references them; arrays of more than 64 elements do not belong in text.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Tf, Usd, UsdGeom, Vt

from magtwin.names import RefusedError
from magtwin.usd.layers import describe_stage
from magtwin.usd.urdf.description import Description
from magtwin.usd.urdf.mesh import Mesh, MeshPart, Rgba, mesh_path, read_mesh

CREASE = np.radians(35)
"""Faces that meet at a smaller angle than this are shaded as one smooth surface [rad]."""

ROOT = Sdf.Path("/Meshes")

Form = Literal["parts", "whole", "hull"]


@dataclass(frozen=True)
class Entry:
    """A mesh prim of the layer."""

    path: Sdf.Path
    colour: Rgba | None
    """Colour that the mesh file gives [sRGB], none where it gives none."""


class MeshLayer:
    """A layer of meshes, shared by every visual and collider that shows the same file at the same scale."""

    def __init__(self, description: Description) -> None:
        self._description = description
        self._stage = Usd.Stage.CreateInMemory()
        describe_stage(self._stage, f"{description.name}: triangles of its meshes.")
        self._stage.SetDefaultPrim(UsdGeom.Scope.Define(self._stage, ROOT).GetPrim())
        self._files: dict[Path, Mesh] = {}
        self._entries: dict[tuple[Path, tuple[float, ...], Form], tuple[Entry, ...]] = {}

    def __len__(self) -> int:
        return len(self._entries)

    def add(self, mesh: Any, form: Form) -> tuple[Entry, ...]:
        """The prims of a URDF `<mesh>`.

        Args:
            mesh: yourdfpy's mesh.
            form: "parts" makes one prim a colour, "whole" one without colour, "hull" the convex hull.

        Raises:
            RefusedError: The file is missing, out of bounds, unreadable or empty, or the scale is none.
        """
        urdf = self._description.path
        path = mesh_path(mesh.filename, urdf)
        factors = np.atleast_1d(1.0 if mesh.scale is None else np.asarray(mesh.scale, float))
        if len(factors) not in (1, 3) or not np.isfinite(factors).all() or not factors.all():
            raise RefusedError(
                f"{urdf}: mesh {mesh.filename!r} has scale {factors.tolist()}; give three numbers but 0"
            )
        scale = np.broadcast_to(factors, 3)
        key = (path, tuple(scale), form)
        if key not in self._entries:
            if path not in self._files:
                self._files[path] = read_mesh(path)
                for note in self._files[path].notes:
                    self._description.note(note)
            file = self._files[path]
            parts = {"parts": file.parts, "whole": (file.merged(),), "hull": (file.hull(),)}[form]
            name = Tf.MakeValidIdentifier(path.stem) + ("" if form == "parts" else f"_{form}")
            self._entries[key] = tuple(
                Entry(self._define(part, scale, name if len(parts) == 1 else f"{name}_{i}"), part.colour)
                for i, part in enumerate(parts)
            )
        return self._entries[key]

    def vertices(self, mesh: Any) -> NDArray[np.float64]:
        """Vertices of a URDF `<mesh>` that was added, as its file has them, scaled [m], shape (V, 3)."""
        scale = np.broadcast_to(1.0 if mesh.scale is None else np.asarray(mesh.scale, float), 3)
        file = self._files[mesh_path(mesh.filename, self._description.path)]
        return np.vstack([part.vertices for part in file.parts]) * scale

    def export(self, path: Path) -> None:
        """Write the layer."""
        self._stage.GetRootLayer().Export(str(path))

    def _define(self, part: MeshPart, scale: NDArray, name: str) -> Sdf.Path:
        taken = {child.GetName() for child in self._stage.GetPrimAtPath(ROOT).GetChildren()}
        unique = next(n for n in [name, *(f"{name}_{i}" for i in range(2, 10_000))] if n not in taken)
        points = (part.vertices * scale).astype(np.float32)
        faces = part.faces[:, ::-1] if np.prod(scale) < 0 else part.faces
        normals, index = corner_normals(points, faces)
        mesh = UsdGeom.Mesh.Define(self._stage, ROOT.AppendChild(unique))
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel().astype(np.int32)))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.array([points.min(0), points.max(0)])))
        primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
            "normals", Sdf.ValueTypeNames.Normal3fArray, UsdGeom.Tokens.faceVarying
        )
        primvar.Set(Vt.Vec3fArray.FromNumpy(normals))
        primvar.SetIndices(Vt.IntArray.FromNumpy(index))
        return mesh.GetPath()


def corner_normals(points: NDArray, faces: NDArray) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Unit normals of each triangle's corners: smooth across shallow edges, sharp across creases.

    A corner's normal is the mean, weighted by area, of the faces around its point that turn from its
    own by less than CREASE.

    Args:
        points: Vertices [m], shape (V, 3).
        faces: Corners of the triangles, counter-clockwise from outside, shape (F, 3).

    Returns:
        Normals without repeats, shape (K, 3), and the index of each corner's, shape (3 F,).
    """
    a, b, c = np.moveaxis(points[faces].astype(float), 1, 0)
    area = np.cross(b - a, c - a)
    unit = area / np.linalg.norm(area, axis=1, keepdims=True)
    corner = np.argsort(faces.ravel(), kind="stable")  # corners of one point stand together
    face, point = corner // 3, faces.ravel()[corner]
    count = np.bincount(point, minlength=len(points))
    first = np.cumsum(count) - count
    around = count[point]  # each corner is paired with each corner of its point
    mine = np.repeat(np.arange(len(corner)), around)
    step = np.arange(len(mine)) - np.repeat(np.cumsum(around) - around, around)
    theirs = first[point[mine]] + step
    near = np.sum(unit[face[mine]] * unit[face[theirs]], axis=1) >= np.cos(CREASE)
    total = np.zeros((len(corner), 3))
    for axis in range(3):
        total[:, axis] = np.bincount(mine[near], area[face[theirs[near]], axis], len(corner))
    normals = np.empty_like(total)
    normals[corner] = total / np.linalg.norm(total, axis=1, keepdims=True)
    rounded = np.round(normals, 4) + 0.0
    values, index = np.unique(rounded, axis=0, return_inverse=True)
    values /= np.linalg.norm(values, axis=1, keepdims=True)
    return values.astype(np.float32), index.reshape(-1).astype(np.int32)
