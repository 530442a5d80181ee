"""Mesh layer: the arrays of mesh files and of shown primitives, each once, in a separate layer (.usdc).

The readable root layer references it, since large arrays do not belong in text.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from magtwin.errors import InputError
from magtwin.urdf.description.description import Description
from magtwin.urdf.description.model import Geometry
from magtwin.urdf.meshes.collider import solid_of
from magtwin.urdf.meshes.mesh import READERS, Mesh, UnreadableMeshError, distinct, face_normals, read_mesh
from magtwin.urdf.meshes.piece import PLAIN, Paint
from magtwin.urdf.meshes.reading import Images
from magtwin.urdf.meshes.texture import Textures
from magtwin.urdf.source.package import MissingFileError
from magtwin.usd import solids
from magtwin.usd.attributes import read_number
from magtwin.usd.layers import describe_stage
from magtwin.usd.schema import place

ROOT = Sdf.Path("/Meshes")

MESH = "mesh"
"""Name of the mesh below a visual's prim."""

KINDS = {
    UsdGeom.Cube: "box",
    UsdGeom.Capsule: "capsule",
    UsdGeom.Cylinder: "cylinder",
    UsdGeom.Sphere: "sphere",
}
"""URDF's primitives by USD's, which are along the same axis where the conversion authors them."""

PRIMITIVE = "magtwin:primitive"
"""Custom data of a mesh that shows a primitive: its kind and measures [m]."""


@dataclass(frozen=True)
class Entry:
    """A visual of the layer: an Xform with one mesh below it."""

    path: Sdf.Path

    paints: tuple[Paint | None, ...]
    """Materials of the file; None stands for triangles without one."""

    subsets: tuple[str, ...]
    """Names of the GeomSubsets below the mesh, one for each paint; empty if one paint covers all."""

    textured: bool
    """Whether the mesh has texture coordinates."""


class MeshLayer:
    """A layer of meshes; visuals and colliders with the same file and scale share one."""

    def __init__(self, description: Description, textures: str = "./textures") -> None:
        """Create an empty layer.

        Args:
            description: The description, which receives notes.
            textures: Asset path of the folder for textures, relative to the robot's layer.
        """
        self.textures = Textures(textures)
        self.images = Images()
        """Images of its meshes and of the URDF's materials."""
        self.looks: dict[tuple[Any, ...], Sdf.Path] = {}
        """Path of each material on the robot's stage by its name and values, see `material`."""
        self._description = description
        self._stage = Usd.Stage.CreateInMemory()
        describe_stage(self._stage, f"{description.name}: triangles of its meshes.")
        self._stage.SetDefaultPrim(UsdGeom.Scope.Define(self._stage, ROOT).GetPrim())
        self.failed: dict[str, MissingFileError | UnreadableMeshError] = {}
        """Errors of the meshes that are missing or unreadable, by filename."""
        self._names: set[str] = set()
        self._found: dict[str, Path] = {}
        self._files: dict[Path, Mesh] = {}
        self._visuals: dict[tuple[Path, tuple[float, ...]], Entry] = {}
        self._primitives: dict[tuple[Any, ...], Sdf.Path] = {}
        self._colliders: dict[tuple[Path, tuple[float, ...]], Sdf.Path] = {}
        self._solids: dict[Path, tuple[NDArray, NDArray]] = {}

    def __len__(self) -> int:
        return len(self._visuals) + len(self._colliders) + len(self._primitives)

    def visual(self, mesh: Geometry) -> Entry:
        """The prim of a URDF `<mesh>` as a visual.

        Raises:
            MissingFileError: The file does not exist.
            UnreadableMeshError: It is damaged or empty.
            InputError: The file may not be read, or the scale is invalid.
        """
        path, scale = self._file(mesh)
        key = (path, scale)
        if key not in self._visuals:
            self._visuals[key] = self._define_visual(self._read(path), np.array(scale))
        return self._visuals[key]

    def primitive(self, form: Geometry) -> Sdf.Path:
        """The mesh that shows a box, capsule, cylinder or sphere, which `primitive_of` tells from others.

        Blender drops the materials of USD's own primitives.
        """
        values: dict[str, Any] = {"kind": form.kind}
        if form.kind == "box":
            values["size"] = Gf.Vec3d(*form.size.tolist())
            points, faces = solids.box(1.0)
            points = points * form.size
        elif form.kind == "sphere":
            values["radius"] = form.radius
            points, faces = solids.sphere(form.radius)
        else:
            values |= {"radius": form.radius, "length": form.length}
            make = solids.capsule if form.kind == "capsule" else solids.cylinder
            points, faces = make(form.radius, form.length)
        key = tuple(values.values())
        if key not in self._primitives:
            mesh = UsdGeom.Mesh.Define(self._stage, self._free(form.kind))
            solids.define_triangles(mesh, points, faces, shaded=True)
            mesh.GetPrim().SetCustomDataByKey(PRIMITIVE, values)
            self._primitives[key] = mesh.GetPath()
        return self._primitives[key]

    def collider(self, mesh: Geometry) -> Sdf.Path:
        """The hull of a URDF `<mesh>`; raises as `visual` does."""
        path, scale = self._file(mesh)
        key = (path, scale)
        if key not in self._colliders:
            if path not in self._solids:
                self._solids[path], flat = solid_of(self._read(path))
                if flat:
                    text = f"mesh {mesh.filename!r} is flat: it collides as a plate {flat:.2g} m thick"
                    self._description.repair("mesh-flat", text, self._description.mesh_element(mesh.filename))
            points, faces = _scaled(*self._solids[path], np.array(scale))
            self._colliders[key] = self._free(f"{path.stem}_hull")
            normals = np.round(face_normals(points, faces), 4)
            prim = self._define_mesh(self._colliders[key], points, faces)
            _primvar(prim, "normals", Sdf.ValueTypeNames.Normal3fArray, normals, UsdGeom.Tokens.uniform)
        return self._colliders[key]

    def vertices(self, mesh: Geometry) -> NDArray[np.float64]:
        """Vertices of the file of an added `<mesh>`, scaled [m], shape (V, 3)."""
        path, scale = self._file(mesh)
        return self._files[path].points.astype(float) * scale

    def export(self, path: Path) -> None:
        """Write the layer."""
        self._stage.GetRootLayer().Export(str(path))

    def _file(self, mesh: Geometry) -> tuple[Path, tuple[float, ...]]:
        """File and scale of a URDF `<mesh>`."""
        name, urdf = mesh.filename, self._description.path
        if Path(name).suffix.lower() not in READERS:
            raise UnreadableMeshError(f"{urdf}: mesh {name!r} is of no known format ({', '.join(READERS)})")
        if name not in self._found:
            self._found[name] = self._description.find_file(name, "mesh")
        if not mesh.size.all():
            raise InputError(
                f"{urdf}: mesh {name!r} has scale {mesh.size.tolist()}; give numbers other than 0"
            )
        return self._found[name], tuple(float(f) for f in np.broadcast_to(mesh.size, 3))

    def _read(self, path: Path) -> Mesh:
        if path not in self._files:
            self._files[path] = read_mesh(path, self._description.source.packages.holds, self.images)
            for note, lost in self._files[path].notes:
                self._description.note(note, lost=lost, file=path)
        return self._files[path]

    def _define_visual(self, file: Mesh, scale: NDArray) -> Entry:
        xform = UsdGeom.Xform.Define(self._stage, self._free(file.path.stem))
        points, faces = _scaled(file.points, file.faces, scale)
        corners = slice(None, None, -1) if np.prod(scale) < 0 else slice(None)
        normals = file.shaded()[:, corners] / scale
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.round(normals, 4, out=normals).astype(np.float32)  # in place: a scan has millions
        mesh = self._define_mesh(xform.GetPath().AppendChild(MESH), points, faces)
        _primvar(mesh, "normals", Sdf.ValueTypeNames.Normal3fArray, normals)
        if any(paint is not None and paint.double_sided for paint in file.paints):
            mesh.CreateDoubleSidedAttr(True)
        if file.uvs is not None:
            _primvar(mesh, "st", Sdf.ValueTypeNames.TexCoord2fArray, np.nan_to_num(file.uvs[:, corners]))
        subsets, taken = list[str](), set[str]()
        kind, tokens = Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens
        by_paint = np.array([(paint or PLAIN).display_colour for paint in file.paints], np.float32)
        if len(file.paints) > 1:
            api = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
            order, counts = np.argsort(file.paint, kind="stable"), np.bincount(file.paint)
            for paint, own in zip(file.paints, np.split(order, np.cumsum(counts)[:-1]), strict=True):
                name = Tf.MakeValidIdentifier((paint.name if paint else "") or "plain")
                subsets.append(free_name(name, taken))
                api.CreateMaterialBindSubset(subsets[-1], Vt.IntArray.FromNumpy(own.astype(np.int32)))
            api.SetMaterialBindSubsetsFamilyType(tokens.partition)
        if file.colours is not None:
            colours = np.where(np.isfinite(file.colours), file.colours, by_paint[file.paint][:, None])
            _primvar(mesh, "displayColor", kind, np.round(colours[:, corners], 4))
        elif subsets:  # a mesh of one colour has none here, since its visual has it
            primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("displayColor", kind, tokens.uniform)
            primvar.Set(Vt.Vec3fArray.FromNumpy(by_paint))
            primvar.SetIndices(Vt.IntArray.FromNumpy(file.paint.astype(np.int32)))
        return Entry(xform.GetPath(), file.paints, tuple(subsets), file.uvs is not None)

    def _define_mesh(self, path: Sdf.Path, points: NDArray, faces: NDArray) -> UsdGeom.Mesh:
        mesh = UsdGeom.Mesh.Define(self._stage, path)
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel().astype(np.int32)))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.array([points.min(0), points.max(0)])))
        return mesh

    def _free(self, name: str) -> Sdf.Path:
        """A free path, called `name` if possible."""
        return ROOT.AppendChild(free_name(Tf.MakeValidIdentifier(name), self._names))


def gather(description: Description, textures: str) -> MeshLayer:
    """The layer of all meshes of a description; arguments as for `MeshLayer`.

    Meshes that are missing or unreadable are in its `failed`; see `placeholder`.

    Raises:
        UnsafeError: The description may not read a mesh.
    """
    meshes = MeshLayer(description, textures)
    for link in description.links.values():
        for form in (visual.geometry for visual in link.visuals if visual.geometry.kind != "mesh"):
            meshes.primitive(form)
        for shapes, add in ((link.visuals, meshes.visual), (link.collisions, meshes.collider)):
            for form in (shape.geometry for shape in shapes if shape.geometry.kind == "mesh"):
                try:
                    add(form)
                except (MissingFileError, UnreadableMeshError) as error:
                    meshes.failed[form.filename] = error
    return meshes


def primitive_of(prim: Usd.Prim) -> Geometry | None:
    """The primitive that a gprim is, or that a mesh shows; None for others.

    Raises:
        InputError: The note of a mesh that says so is damaged, or a size is none.
    """
    values = prim.GetCustomDataByKey(PRIMITIVE)
    if not values:
        kind = next((kind for schema, kind in KINDS.items() if prim.IsA(schema)), "")
        if kind == "box":
            return Geometry("box", np.full(3, read_number(prim, "size")))
        length = read_number(prim, "height") if kind in ("capsule", "cylinder") else 0.0
        return Geometry(kind, radius=read_number(prim, "radius"), length=length) if kind else None
    try:
        radius, length = (float(values.get(name, 0.0)) for name in ("radius", "length"))
        size = np.array(values.get("size", (1.0, 1.0, 1.0)), float)
        kind = str(values["kind"])
    except (AttributeError, KeyError, TypeError, ValueError):
        kind, size, radius, length = "", np.ones(3), 0.0, 0.0
    if kind not in KINDS.values() or size.shape != (3,):
        raise InputError(f"{place(prim)}: its customData {PRIMITIVE} is damaged; remove it")
    return Geometry(kind, size, radius, length)


def free_name(name: str, taken: set[str]) -> str:
    """A name that is not in `taken`, to which it is added: `name`, or `name_2` and so on."""
    unique = _free(name, lambda other: other in taken)
    taken.add(unique)
    return unique


def free_child(prim: Usd.Prim, name: str) -> Sdf.Path:
    """A free path below a prim, called `name` if possible."""
    stage, path = prim.GetStage(), prim.GetPath()
    free = _free(
        Tf.MakeValidIdentifier(name), lambda other: bool(stage.GetPrimAtPath(path.AppendChild(other)))
    )
    return path.AppendChild(free)


def _free(name: str, taken: Callable[[str], bool]) -> str:
    """The name, or the name with a number, found by bisection, since a link may have thousands of boxes."""
    if not taken(name):
        return name
    high = 2
    while taken(f"{name}_{high}"):
        high *= 2
    low = high // 2
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if taken(f"{name}_{middle}") else (low, middle)
    return f"{name}_{high}"


def _scaled(points: NDArray, faces: NDArray, scale: NDArray) -> tuple[NDArray[np.float32], NDArray]:
    """Points and faces at a scale; faces stay outwards under a reflection."""
    scaled = (points * scale).astype(np.float32)
    return scaled, faces[:, ::-1] if np.prod(scale) < 0 else faces


def _primvar(
    mesh: UsdGeom.Mesh,
    name: str,
    kind: Sdf.ValueTypeName,
    values: NDArray,
    interpolation: str = UsdGeom.Tokens.faceVarying,
) -> None:
    """Author a primvar, by default of values at corners, shape (F, 3, K), indexed by distinct values."""
    rows = np.ascontiguousarray(values, np.float32).reshape(-1, values.shape[-1])
    first, index = distinct(rows)
    arrays = {2: Vt.Vec2fArray, 3: Vt.Vec3fArray}
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, kind, interpolation)
    primvar.Set(arrays[rows.shape[1]].FromNumpy(rows[first] + np.float32(0)))  # + 0 makes -0 into 0
    primvar.SetIndices(Vt.IntArray.FromNumpy(index.astype(np.int32)))
