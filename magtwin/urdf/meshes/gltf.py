"""glTF: reader of .gltf and .glb files, version 2.0.

trimesh is not used for three reasons: it decodes textures instead of keeping their files, rounds linear
colour factors (section 3.9.2) to 8 bits, and drops unsupported contents without a message.
"""

import base64
import json
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.budget import BUDGETS
from magtwin.files.file import read_bytes
from magtwin.frames import matrix_from_quat
from magtwin.urdf.meshes.piece import Map, Paint, Piece, normal_map
from magtwin.urdf.meshes.polygon import strip
from magtwin.urdf.meshes.reading import Reading
from magtwin.urdf.meshes.texture import Image, image_of, read_image
from magtwin.urdf.source.markup import UnsafeError
from magtwin.usd.geometry import linear_from_srgb, srgb_from_linear

Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Turns glTF's Y up to Z up: (x, y, z) -> (x, -z, y)."""

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}

REPEAT = 10497
WRAPS = {33071: "clamp", 33648: "mirror", REPEAT: "repeat"}
"""Wrapping of UsdUVTexture by that of a sampler."""

TRIANGLES, STRIP, FAN = 4, 5, 6
"""Modes of primitives with faces."""

SUPPORTED = ("KHR_materials_unlit", "KHR_mesh_quantization", "KHR_materials_emissive_strength")
"""Required extensions that are supported or do not change the shape."""

JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942


def read(reading: Reading) -> list[Piece]:
    """The triangles of a glTF file, turned to Z up, for `read_mesh`."""
    return _Gltf(reading).pieces()


class _Gltf:
    """A glTF file: its JSON and its buffers."""

    def __init__(self, reading: Reading) -> None:
        self._reading, path = reading, reading.path
        self._json, self._chunk = _parse(path)
        version = str(self._json.get("asset", {}).get("version", "none"))
        if not version.startswith("2."):
            raise InputError(f"{path}: is glTF version {version}; only 2.0 is read, export it again")
        unknown = [e for e in self._json.get("extensionsRequired", ()) if e not in SUPPORTED]
        if unknown:
            raise InputError(
                f"{path}: cannot be read without {', '.join(unknown)}; export it without compression"
            )
        self._buffers: dict[int, bytes] = {}
        self._paints: dict[int, Paint] = {}
        self._images: dict[int, Image | None] = {}

    def pieces(self) -> list[Piece]:
        """The pieces of the file's scene, in node order."""
        scenes, nodes = self._json.get("scenes", []), self._json.get("nodes", [])
        if scenes:
            roots = scenes[self._json.get("scene", 0)].get("nodes", [])
        else:
            below = {child for node in nodes for child in node.get("children", ())}
            roots = [i for i in range(len(nodes)) if i not in below]
        pieces = [
            piece.moved(T)
            for node, T in self._walk(roots)
            for piece in self._mesh(node)
            if piece.faces.size and self._reading.spend(piece.nbytes)
        ]
        for kind in ("skins", "animations"):
            if self._json.get(kind):
                self._reading.lose(f"its {kind} are left out")
        return pieces

    def _walk(self, roots: list[int]) -> Iterator[tuple[dict[str, Any], NDArray]]:
        """Nodes with their transforms to the mesh's frame; refuses circles."""
        pending = [(root, Z_UP) for root in reversed(roots)]
        seen: set[int] = set()
        while pending:
            index, above = pending.pop()
            if index in seen:
                raise self._refused(f"node {index} has two parents")
            seen.add(index)
            self._reading.visit()
            node = self._json["nodes"][index]
            T = above @ _local(node)
            yield node, T
            pending += [(child, T) for child in reversed(node.get("children", []))]

    def _mesh(self, node: dict[str, Any]) -> Iterator[Piece]:
        if "mesh" not in node:
            return
        for primitive in self._json["meshes"][node["mesh"]]["primitives"]:
            self._reading.visit()
            mode, attributes = primitive.get("mode", TRIANGLES), primitive["attributes"]
            if mode not in (TRIANGLES, STRIP, FAN):
                self._reading.lose("lines and points are left out")
                continue
            points = self._numbers(attributes["POSITION"])
            order = (
                self._numbers(primitive["indices"]).ravel().astype(np.int64)
                if "indices" in primitive
                else np.arange(len(points))
            )
            faces = _triangles(order, mode)
            if len(faces) and not faces.max() < len(points):
                raise self._refused(f"a face names vertex {faces.max()} of {len(points)}")
            at = {
                name: self._numbers(attributes[name])[faces]
                for name in ("NORMAL", "TEXCOORD_0", "COLOR_0")
                if name in attributes
            }
            paint = self._paint(primitive["material"]) if "material" in primitive else None
            uvs, colours = at.get("TEXCOORD_0"), at.get("COLOR_0")
            if colours is not None:
                colours = np.clip(colours[..., :3], 0, 1)
                if paint is not None and paint.image is None:  # factors multiply (section 3.9.2)
                    colours = colours * linear_from_srgb(paint.rgba[:3])
                    paint = replace(paint, rgba=(1.0, 1.0, 1.0, paint.rgba[3]), by_vertex=True)
            yield Piece(
                points=points,
                faces=faces,
                paint=paint,
                normals=at.get("NORMAL"),
                uvs=None if uvs is None else uvs * (1, -1) + (0, 1),  # from the upper left to the lower
                colours=colours,
            )

    def _paint(self, index: int) -> Paint:
        """The paint of a material. Colour factors are linear and multiply texture and vertex colours."""
        if index not in self._paints:
            material = self._json["materials"][index]
            surface = material.get("pbrMetallicRoughness", {})
            r, g, b, a = surface.get("baseColorFactor", (1, 1, 1, 1))
            image, wrap = self._texture(surface.get("baseColorTexture"), index)
            roughness, metallic = (
                float(surface.get(f"{name}Factor", 1.0)) for name in ("roughness", "metallic")
            )
            red, green, blue = (float(c) for c in srgb_from_linear((r, g, b)))
            alpha = material.get("alphaMode", "OPAQUE")
            self._paints[index] = Paint(
                name=str(material.get("name", f"material_{index}")),
                rgba=(red, green, blue, 1.0 if alpha == "OPAQUE" else float(a)),
                image=image,
                wrap=wrap,
                roughness=roughness,
                metallic=metallic,
                emissive=self._emissive(material),
                maps=self._maps(material, index, roughness, metallic),
                double_sided=bool(material.get("doubleSided", False)),
                see_through=alpha != "OPAQUE",
                cutoff=float(material.get("alphaCutoff", 0.5)) if alpha == "MASK" else 0.0,
            )
        return self._paints[index]

    def _emissive(self, material: dict[str, Any]) -> tuple[float, float, float]:
        strength = material.get("extensions", {}).get("KHR_materials_emissive_strength", {})
        by = float(strength.get("emissiveStrength", 1.0))
        r, g, b = (by * float(c) for c in material.get("emissiveFactor", (0, 0, 0)))
        return (r, g, b)

    def _maps(
        self, material: dict[str, Any], index: int, roughness: float, metallic: float
    ) -> tuple[tuple[str, Map], ...]:
        """Textures besides the colour (section 3.9.2): green is roughness, blue metallic, red occlusion."""
        maps: list[tuple[str, Map]] = []
        surface = material.get("pbrMetallicRoughness", {})
        image, wrap = self._texture(surface.get("metallicRoughnessTexture"), index)
        if image is not None:
            for name, channel, factor in (("roughness", "g", roughness), ("metallic", "b", metallic)):
                maps.append((name, Map(image, channel, (factor,) * 4, wrap=wrap)))
        given = material.get("normalTexture", {})
        image, wrap = self._texture(given, index)
        if image is not None:
            maps.append(("normal", normal_map(image, float(given.get("scale", 1.0)), wrap)))
        given = material.get("occlusionTexture", {})
        image, wrap = self._texture(given, index)
        if image is not None:  # 1 + strength (texel - 1)
            s = float(given.get("strength", 1.0))
            maps.append(("occlusion", Map(image, "r", (s,) * 4, (1 - s,) * 4, wrap=wrap)))
        image, wrap = self._texture(material.get("emissiveTexture"), index)
        emissive = self._emissive(material)
        if image is not None and max(emissive) > 0:
            maps.append(("emissiveColor", Map(image, "rgb", (*emissive, 1.0), colour=True, wrap=wrap)))
        for name in material.get("extensions", {}):
            if name not in SUPPORTED:
                self._reading.lose(f"material {index}'s extension {name} is left out")
        return tuple(maps)

    def _texture(self, given: dict[str, Any] | None, index: int) -> tuple[Image | None, tuple[str, str]]:
        """Image and wrapping of a texture of a material."""
        if not given:
            return None, ("repeat", "repeat")
        moved = "KHR_texture_transform" in given.get("extensions", {})
        if given.get("texCoord", 0) != 0 or moved:
            self._reading.lose(f"material {index}'s texture uses other coordinates than the first set")
        texture = self._json["textures"][given["index"]]
        sampler = self._json["samplers"][texture["sampler"]] if "sampler" in texture else {}
        s, t = (WRAPS[sampler.get(f"wrap{side}", REPEAT)] for side in "ST")
        return self._image(texture), (s, t)

    def _image(self, texture: dict[str, Any]) -> Image | None:
        """The image of a texture: in a file, inline, or in a buffer."""
        if "source" not in texture:
            self._reading.lose("a texture of an unknown format is left out")
            return None
        source = texture["source"]
        if source not in self._images:
            self._images[source] = self._read_image(source)
        return self._images[source]

    def _read_image(self, source: int) -> Image | None:
        image = self._json["images"][source]
        name = image.get("name") or f"{self._reading.path.stem}_{source}"
        if "bufferView" in image:
            return image_of(bytes(self._view(image["bufferView"])), name, self._reading)
        if image["uri"].startswith("data:"):
            return image_of(_inline(image["uri"]), name, self._reading)
        return read_image(image["uri"], self._reading)

    def _numbers(self, index: int) -> NDArray:
        """Values of an accessor, shape (N, width), as floats or integers (section 3.6.2)."""
        accessor = self._json["accessors"][index]
        dtype, width = np.dtype(COMPONENTS[accessor["componentType"]]), WIDTHS[accessor["type"]]
        count = accessor["count"]
        if "bufferView" not in accessor or "sparse" in accessor:
            raise self._refused(f"accessor {index} is sparse or has no buffer, which is not supported")
        view = self._json["bufferViews"][accessor["bufferView"]]
        data = self._view(accessor["bufferView"])[accessor.get("byteOffset", 0) :]
        stride = view.get("byteStride", dtype.itemsize * width)
        if count and len(data) < stride * (count - 1) + dtype.itemsize * width:
            raise self._refused(f"accessor {index} is longer than its buffer")
        self._reading.spend(8 * count * width)  # before a stride of 0 repeats a few bytes without end
        values = np.ndarray((count, width), dtype, data, 0, (stride, dtype.itemsize))
        if accessor.get("normalized"):
            return np.maximum(values / np.iinfo(dtype).max, -1.0)
        return values.astype(float) if dtype.kind == "f" else values.astype(np.int64)

    def _view(self, index: int) -> memoryview:
        view = self._json["bufferViews"][index]
        start = view.get("byteOffset", 0)
        data = memoryview(self._buffer(view["buffer"]))[start : start + view["byteLength"]]  # no copy
        if len(data) < view["byteLength"]:
            raise self._refused(f"buffer {view['buffer']} is cut short")
        return data

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            uri = self._json["buffers"][index].get("uri")
            if uri is None:
                self._buffers[index] = self._chunk
            elif uri.startswith("data:"):
                self._buffers[index] = _inline(uri)
            else:
                file = self._reading.path.parent / unquote(uri)
                if not self._reading.may_read(file):
                    raise UnsafeError(
                        f"{self._reading.path}: buffer {uri!r} lies outside the robot's packages; move it in"
                    )
                if not file.is_file():
                    raise InputError(f"{self._reading.path}: buffer {uri!r} is missing; looked for {file}")
                self._buffers[index] = read_bytes(file, "buffer", "mesh")
        return self._buffers[index]

    def _refused(self, text: str) -> InputError:
        return InputError(f"{self._reading.path}: {text}; export it again")


def _parse(path: Path) -> tuple[dict[str, Any], bytes]:
    """JSON and binary chunk of a file (section 4)."""
    data = path.read_bytes()  # its size is checked
    if data[:4] != b"glTF":
        return _table(data, path), b""
    if len(data) < 20 or struct.unpack_from("<I", data, 8)[0] > len(data):
        raise InputError(f"{path}: is cut short; export it again")
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    return _table(chunks[JSON_CHUNK], path), chunks.get(BINARY_CHUNK, b"")


def _table(text: bytes, path: Path) -> dict[str, Any]:
    """The JSON of a file."""
    if len(text) > BUDGETS["JSON"].file:
        raise InputError(
            f"{path}: its JSON has {len(text):,} bytes; at most {BUDGETS['JSON'].file:,} are read"
        )
    table: dict[str, Any] = json.loads(text)
    return table


def _inline(uri: str) -> bytes:
    """Bytes of a `data:` URI."""
    head, _, body = uri.partition(",")
    return base64.b64decode(body) if head.endswith(";base64") else unquote(body).encode("latin-1")


def _local(node: dict[str, Any]) -> NDArray:
    """Transform of a node in its parent, shape (4, 4): a matrix by columns, or T R S (section 3.5.2)."""
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T.astype(float)
    T = np.eye(4)
    T[:3, :3] = matrix_from_quat(node.get("rotation", (0, 0, 0, 1))) * node.get("scale", (1, 1, 1))
    T[:3, 3] = node.get("translation", (0, 0, 0))
    return T


def _triangles(order: NDArray, mode: int) -> NDArray:
    """Vertices of the triangles of a list, strip or fan of vertices, shape (F, 3)."""
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    triangles = strip(len(order), fan=mode == FAN)
    return order[np.roll(triangles, -1, axis=1) if mode == FAN else triangles]  # its order of a fan's corners
