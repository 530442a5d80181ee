"""A stage as binary glTF 2.0 (Khronos Group), in metres with Y up, for web pages and other viewers.

Each body is a node with its own name. Shapes that stand still are merged below the child of the default prim
that they belong to. Sensors are nodes without a mesh, with their attributes in `extras`; the `extras` of the
map name the accessor of its values. Time samples become an animation.
"""

import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade

from magtwin.errors import InputError
from magtwin.usd.geometry import Shape, read_shapes
from magtwin.usd.layers import open_stage, translates
from magtwin.usd.schema import attribute_name, has_api, prims_with, value_of
from magtwin.usd.solids import corner_normals
from magtwin.version import __version__

Y_UP = (-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
"""Rotation (xyzw) from Z up to Y up: (x, y, z) to (x, z, -y)."""

UNLIT = "KHR_materials_unlit"
"""Extension for the colours of the floor, which show nT and must not be lit."""

NOUNS_SHOWN = ("magnetometer", "imu", "lidar", "battery", "robot", "anomalyMap", "earth", "lab")
"""Nouns whose prims become nodes even without a shape."""

MOST_NUMBERS = 64
"""Most numbers of an attribute in `extras`."""

_TYPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4"}
_COMPONENTS = {"f4": 5126, "u4": 5125, "u1": 5121}
_VERTICES, _INDICES = 34962, 34963


@translates
def write_glb(stage_file: Path, out: Path) -> None:
    """Write the visible shapes of a stage.

    Surfaces have the colour and roughness of their material, or their own colours, but no textures. Metals
    are not metallic, since a page without an environment would show them black. Variants stay as selected.

    Args:
        stage_file: Root layer, in metres with Z up.
        out: The .glb file to make.

    Raises:
        InputError: The stage cannot be opened, or has no visible surface.
    """
    stage = open_stage(stage_file)
    shapes = [shape for shape in read_shapes(stage) if len(shape.faces)]
    if not shapes:
        raise InputError(f"{stage_file}: has no visible surface")
    for shape in shapes:
        if not np.isfinite(shape.vertices).all():
            raise InputError(f"{stage_file} <{shape.prim}>: has points or transforms that are not finite")
        colours = shape.colour if shape.vertex_colours is None else shape.vertex_colours
        if not np.isfinite(colours).all():
            raise InputError(f"{stage_file} <{shape.prim}>: has a colour that is not finite; correct it")
    homes: dict[Sdf.Path, list[Shape]] = {}  # prim of the node: the body, or a child of the default prim
    for shape in shapes:
        body = prim = stage.GetPrimAtPath(shape.prim)
        while body and not body.HasAPI(UsdPhysics.RigidBodyAPI):
            body = body.GetParent()
        home = body.GetPath() if body else prim.GetPath().GetPrefixes()[:2][-1]
        homes.setdefault(home, []).append(shape)
    scene = _Scene(stage)
    for home, own in homes.items():
        scene.show(home, own)
    for noun in NOUNS_SHOWN:
        for prim in prims_with(stage.GetPseudoRoot(), noun):
            scene.add_extras(prim)
    scene.animate()
    out.write_bytes(scene.glb())


class _Scene:
    """A glTF that is being built."""

    def __init__(self, stage: Usd.Stage) -> None:
        self.stage, self.rest = stage, UsdGeom.XformCache()
        self.data = bytearray()
        name = Path(stage.GetRootLayer().realPath).stem
        root = {"name": name, "rotation": _plain(Y_UP), "children": []}
        self.nodes: list[dict[str, Any]] = [root]
        self.index: dict[Sdf.Path, int] = {Sdf.Path.absoluteRootPath: 0}
        self.parts: dict[str, list[Any]] = {
            name: [] for name in ("meshes", "materials", "accessors", "bufferViews", "animations")
        }
        self.materials: dict[str, int] = {}

    def node(self, path: Sdf.Path) -> int:
        """The node of a prim, below those of its parents."""
        if path not in self.index:
            above = self.node(path.GetParentPath())
            p, q = self._pose(path, self.rest)
            node = {"name": path.name, "children": []}
            if np.any(p):
                node["translation"] = _plain(p)
            if not np.allclose(q, (0, 0, 0, 1), atol=1e-12):
                node["rotation"] = _plain(q)
            self.index[path] = len(self.nodes)
            self.nodes.append(node)
            self.nodes[above]["children"].append(self.index[path])
        return self.index[path]

    def _pose(self, path: Sdf.Path, cache: UsdGeom.XformCache) -> tuple[NDArray, NDArray]:
        """Position [m] and orientation (xyzw) of a prim in its parent, without scales."""
        here, above = (self._frame(p, cache) for p in (path, path.GetParentPath()))
        local = here * above.GetInverse()
        q = local.ExtractRotationQuat().GetNormalized()
        return np.array(local.ExtractTranslation()), np.array([*q.GetImaginary(), q.GetReal()])

    def _frame(self, path: Sdf.Path, cache: UsdGeom.XformCache) -> Gf.Matrix4d:
        prim = self.stage.GetPrimAtPath(path)
        if path == Sdf.Path.absoluteRootPath or not prim:
            return Gf.Matrix4d(1)
        frame = cache.GetLocalToWorldTransform(prim).RemoveScaleShear()
        if not np.isfinite(np.array(frame)).all():
            raise InputError(f"{path}: its transform is not finite; correct its translation or scale")
        return frame

    def show(self, home: Sdf.Path, shapes: list[Shape]) -> None:
        """Add a mesh to a node, with one primitive per material."""
        groups: dict[int, list[Shape]] = {}
        for shape in shapes:
            groups.setdefault(self._material(shape), []).append(shape)
        stands = not self.stage.GetPrimAtPath(home).HasAPI(UsdPhysics.RigidBodyAPI)
        to_home = np.array(self._frame(home, self.rest).GetInverse()) if stands else np.eye(4)
        primitives = [self._primitive(group, to_home, m) for m, group in groups.items()]
        self.nodes[self.node(home)]["mesh"] = len(self.parts["meshes"])
        self.parts["meshes"].append({"name": home.name, "primitives": primitives})

    def _primitive(self, shapes: list[Shape], to_home: NDArray, material: int) -> dict[str, Any]:
        corners, normals, colours = [], [], []
        for shape in shapes:
            points = np.column_stack([shape.vertices, np.ones(len(shape.vertices))]) @ to_home[:, :3]
            corners.append(points[shape.faces].reshape(-1, 3))
            merged, index = np.unique(points.round(7), axis=0, return_inverse=True)
            with np.errstate(invalid="ignore"):  # flat triangles have no normal
                own = corner_normals(merged, index.reshape(-1)[shape.faces]).reshape(-1, 3)
            normals.append(np.where(np.isfinite(own), own, (0.0, 0.0, 1.0)))
            if shape.vertex_colours is not None:
                colours.append(shape.vertex_colours[shape.faces].reshape(-1, 3))
        rows = np.hstack([np.vstack(a) for a in (corners, normals, colours) if a]).astype("<f4")
        rows, index = np.unique(rows, axis=0, return_inverse=True)
        attributes = {"POSITION": rows[:, :3], "NORMAL": rows[:, 3:6]}
        if colours:
            attributes["COLOR_0"] = rows[:, 6:9]
        return {
            "attributes": {name: self._accessor(a, _VERTICES) for name, a in attributes.items()},
            "indices": self._accessor(index.reshape(-1).astype("<u4"), _INDICES),
            "material": material,
        }

    def _material(self, shape: Shape) -> int:
        r, g, b, a = (1.0, 1.0, 1.0, 1.0) if shape.vertex_colours is not None else shape.colour
        said: dict[str, Any] = {
            "pbrMetallicRoughness": {
                "baseColorFactor": _plain((r, g, b, a)),
                "metallicFactor": 0.0,
                "roughnessFactor": _roughness(self.stage.GetPrimAtPath(shape.prim)),
            },
            "doubleSided": True,
        }
        if a < 1:
            said["alphaMode"] = "BLEND"
        if shape.vertex_colours is not None:
            said["extensions"] = {UNLIT: {}}
        key = json.dumps(said, sort_keys=True)
        if key not in self.materials:
            self.materials[key] = len(self.parts["materials"])
            self.parts["materials"].append(said)
        return self.materials[key]

    def add_extras(self, prim: Usd.Prim) -> None:
        """Write magtwin's attributes of a prim to the extras of its node."""
        extras = self.nodes[self.node(prim.GetPath())].setdefault("extras", {})
        for attribute in prim.GetAuthoredAttributes():
            if attribute.GetNamespace().startswith("magtwin:"):
                value = _json_value(attribute.Get())
                if value not in (None, []):
                    extras[attribute.GetName()] = value
        if has_api(prim, "anomalyMap"):
            values = np.array(value_of(prim.GetAttribute(attribute_name("anomalyMap", "values"))), "<f4")
            valid = np.array(value_of(prim.GetAttribute(attribute_name("anomalyMap", "valid"))), "u1")
            valid &= np.isfinite(values)
            numbers = {"values": np.where(valid, values, 0).astype("<f4"), "valid": valid}
            for name, array in numbers.items():
                extras[attribute_name("anomalyMap", name)] = {"accessor": self._accessor(array)}
        for child in prim.GetChildren() if has_api(prim, "anomalyMap") else ():
            scale = child.GetCustomDataByKey("magtwin") or {}
            if "colourMap" in scale:
                extras["colours"] = {key: _json_value(value) for key, value in scale.items()}

    def animate(self) -> None:
        """Animate the nodes of prims with time samples."""
        forms = [form for prim in self.stage.Traverse() if (form := UsdGeom.Xformable(prim))]
        moving = [form.GetPrim() for form in forms if form.TransformMightBeTimeVarying()]
        rate, start = self.stage.GetTimeCodesPerSecond(), self.stage.GetStartTimeCode()
        channels, samplers, clocks = list[dict[str, Any]](), list[dict[str, Any]](), dict[bytes, int]()
        for prim in moving:
            times = np.array(UsdGeom.Xformable(prim).GetTimeSamples())
            cache, poses = UsdGeom.XformCache(), []
            for time in times.tolist():
                cache.SetTime(time)
                poses.append(self._pose(prim.GetPath(), cache))
            clock = ((times - start) / rate).astype("<f4")
            if clock.tobytes() not in clocks:
                clocks[clock.tobytes()] = self._accessor(clock, limits=True)
            q = np.array([q for _, q in poses])
            flips = np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0))
            q[1:] *= flips[:, None]  # the shorter rotation
            node = self.node(prim.GetPath())
            for path, values in (("translation", np.array([p for p, _ in poses])), ("rotation", q)):
                if np.ptp(values, axis=0).max() > 1e-9:
                    sampler = {"input": clocks[clock.tobytes()], "interpolation": "LINEAR"}
                    samplers.append({**sampler, "output": self._accessor(values.astype("<f4"))})
                    target = {"node": node, "path": path}
                    channels.append({"sampler": len(samplers) - 1, "target": target})
        if channels:
            self.parts["animations"].append({"name": "run", "channels": channels, "samplers": samplers})

    def _accessor(self, array: NDArray, target: int | None = None, *, limits: bool = False) -> int:
        """An array in the buffer; returns the index of its accessor."""
        self.data += bytes(-len(self.data) % 4)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": array.nbytes}
        if target is not None:
            view["target"] = target
        self.data += np.ascontiguousarray(array).tobytes()
        said: dict[str, Any] = {
            "bufferView": len(self.parts["bufferViews"]),
            "componentType": _COMPONENTS[array.dtype.str[1:]],
            "count": len(array),
            "type": _TYPES[array.shape[1:]],
        }
        if limits or (target == _VERTICES and array.shape[1:] == (3,)):
            said["min"], said["max"] = (np.atleast_1d(f(array, axis=0)).tolist() for f in (np.min, np.max))
        self.parts["bufferViews"].append(view)
        self.parts["accessors"].append(said)
        return len(self.parts["accessors"]) - 1

    def glb(self) -> bytes:
        """The file: a header, JSON, and the buffer."""
        metadata = self.stage.GetRootLayer().customLayerData
        for key in ("magtwin", "export"):
            metadata = metadata.get(key) if isinstance(metadata, dict) else None
        extras = dict(metadata) if isinstance(metadata, dict) else {}
        asset = {"version": "2.0", "generator": f"magtwin {__version__}", "extras": extras}
        self.data += bytes(-len(self.data) % 4)
        nodes = [{k: v for k, v in node.items() if v != []} for node in self.nodes]
        said = {
            "asset": asset,
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": nodes,
            "buffers": [{"byteLength": len(self.data)}],
            **{name: part for name, part in self.parts.items() if part},
        }
        if any("extensions" in material for material in self.parts["materials"]):
            said["extensionsUsed"] = [UNLIT]
        try:
            text = json.dumps(said, separators=(",", ":"), allow_nan=False).encode()
        except (TypeError, ValueError) as error:
            name = self.stage.GetRootLayer().identifier
            raise InputError(
                f"{name}: a time, place or text in it cannot be written as JSON ({error}); correct it"
            ) from error
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + len(self.data)
        head = struct.pack("<4sII", b"glTF", 2, size)
        chunks = [struct.pack("<I4s", len(d), k) + d for k, d in ((b"JSON", text), (b"BIN\0", self.data))]
        return head + b"".join(chunks)


def _roughness(prim: Usd.Prim) -> float:
    """Roughness of a prim's material; default: that of UsdPreviewSurface."""
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    shader = material.ComputeSurfaceSource()[0] if material else None
    value = shader.GetInput("roughness").Get() if shader and shader.GetInput("roughness") else None
    return round(float(value), 6) if isinstance(value, int | float) and np.isfinite(value) else 0.5


def _json_value(value: Any) -> Any:
    """A value for JSON; None unless it is a number, text or short list of them."""
    if isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, Sdf.AssetPath):
        return value.path or None
    try:
        array = np.array(value)
    except (TypeError, ValueError):
        return None
    if array.dtype.kind == "U" or array.dtype.kind == "O":
        return [str(v) for v in value] if array.size <= MOST_NUMBERS and array.ndim else None
    finite = array.dtype.kind in "biuf" and array.size <= MOST_NUMBERS and np.isfinite(array).all()
    return array.tolist() if finite else None


def _plain(numbers: Iterable[float]) -> list[float]:
    """Numbers for JSON, to nine digits, as single precision needs."""
    return [float(f"{float(x):.9g}") + 0.0 for x in numbers]
