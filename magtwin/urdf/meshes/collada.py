"""COLLADA: reader of .dae files, versions 1.4 and 1.5.

pycollada is not used, because it loses meshes: it drops a geometry whose material has a malformed colour (all
5,282 triangles of the real TurtleBot 4's LiDAR), and does not read strips and fans.
"""

import re
from collections.abc import Iterator
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files import read_bytes
from magtwin.urdf.meshes.piece import GREY, Map, Paint, Piece, Rgba, linear, normal_map, smoothness
from magtwin.urdf.meshes.polygon import cut_polygons, strips
from magtwin.urdf.meshes.reading import Reading, numbers
from magtwin.urdf.meshes.texture import Image, read_image
from magtwin.urdf.source.markup import parse_markup
from magtwin.usd.geometry import linear_from_srgb

Element = ElementTree.Element

SHADERS = ("phong", "lambert", "blinn", "constant")

POLYGONS = ("triangles", "polylist", "polygons", "tristrips", "trifans")
"""Primitives with faces."""

SHOWN = ("node", "instance_node", "instance_geometry", "instance_controller")
"""Contents of a node that may have faces."""

MOST_INPUTS = 1_000
"""Most inputs of a primitive."""

LUMINANCE = (0.212671, 0.715160, 0.072169)
"""Weights of linear red, green and blue, from the specification."""


class _Input(NamedTuple):
    """An `<input>` of a primitive."""

    semantic: str
    source: str
    offset: int
    set: int


def read_collada(reading: Reading) -> list[Piece]:
    """The triangles of a COLLADA file, for `read_mesh`."""
    return _Collada(reading).pieces()


class _Collada:
    """A COLLADA file."""

    def __init__(self, reading: Reading) -> None:
        self._reading = reading
        text = read_bytes(reading.path, "mesh file", "XML")
        if re.match(rb"\s*<\?xml[^>]*encoding", text) is None:  # names in other encodings are harmless
            text = text.decode("utf-8", errors="replace").encode()
        markup = parse_markup(text, reading.path)
        self._root, self._lines = markup.root, markup.lines
        for element in markup.lines:
            element.tag = element.tag.rpartition(":")[2]
        if self._root.tag != "COLLADA":
            raise InputError(
                f"{reading.path}: begins with <{self._root.tag}>; a COLLADA file begins with <COLLADA>"
            )
        self._ids = {e.get("id"): e for e in markup.lines if e.get("id")}
        self._sources: dict[str, NDArray] = {}
        self._paints: dict[Element, Paint | None] = {}
        self._placed: dict[Element, tuple[NDArray, list[Element]]] = {}  # transforms and contents of nodes
        self._primitives: dict[Element, list[Element]] = {}  # of geometries
        self._vertices: dict[Element, list[Element]] = {}  # inputs of meshes
        self._parameters: dict[Element, dict[str | None, Element]] = {}  # of profiles
        self._colours: dict[Element, Rgba] = {}

    def pieces(self) -> list[Piece]:
        """The pieces of the file's scene, in metres."""
        axis = self._root.findtext("asset/up_axis", "Z_UP").strip()
        if axis != "Z_UP":
            self._reading.note(f"its up axis {axis} is not applied, as in RViz; turn the visual instead")
        instance = self._root.find("scene/instance_visual_scene")
        scene, scenes = self._target(instance), self._root.findall("library_visual_scenes/visual_scene")
        if scene is None and instance is not None and len(scenes) == 1:
            scene = scenes[0]
            self._reading.note(f"its scene {instance.get('url')!r} is not there: its only one is shown")
        if scene is None:
            raise InputError(f"{self._reading.path}: has no scene to show; export it again")
        unit = self._root.find("asset/unit")
        metre = float(unit.get("meter", 1)) if unit is not None else 1.0
        shown: set[Element] = set()
        pieces = [
            piece.moved(T)
            for node in scene.findall("node")
            for geometry, instance, T in self._walk(node, np.diag([metre, metre, metre, 1.0]), ())
            for piece in self._geometry(geometry, instance, shown)
            if piece.faces.size and self._reading.spend(piece.nbytes)
        ]
        for geometry in self._root.iterfind("library_geometries/geometry"):
            if geometry not in shown:
                self._reading.note(
                    f"geometry {geometry.get('id')!r} is not in the file's scene and is left out"
                )
        return pieces

    def _walk(
        self, node: Element, T: NDArray, above: tuple[Element, ...]
    ) -> Iterator[tuple[Element, Element, NDArray]]:
        """Geometries below a node, with their instance elements and their transforms to metres."""
        if node in above:
            raise self._refused(node, f"node {node.get('id')!r} is within itself")
        if node not in self._placed:
            self._placed[node] = self._transform(node), [child for child in node if child.tag in SHOWN]
        local, children = self._placed[node]
        T = T @ local
        for child in children:
            self._reading.visit(where=self._line(child))  # nodes that show each other twice multiply
            if child.tag == "node":
                yield from self._walk(child, T, (*above, node))
            elif child.tag == "instance_node":
                target = self._target(child)
                if target is None:
                    self._reading.lose(f"node {child.get('url')!r} is not there")
                else:
                    yield from self._walk(target, T, (*above, node))
            elif child.tag == "instance_geometry":
                geometry = self._target(child)
                if geometry is None:
                    self._reading.lose(f"geometry {child.get('url')!r} is not there")
                else:
                    yield geometry, child, T
            elif child.tag == "instance_controller":
                yield from self._skinned(child, T)

    def _skinned(self, instance: Element, T: NDArray) -> Iterator[tuple[Element, Element, NDArray]]:
        """The geometry of a skin in its bind pose."""
        controller = self._target(instance)
        skin = None if controller is None else controller.find("skin")
        geometry = None if skin is None else self._ids.get(skin.get("source", "").removeprefix("#"))
        if skin is None or geometry is None:
            self._reading.lose(f"controller {instance.get('url')!r} is no skin of a geometry")
            return
        self._reading.note(f"skin {controller.get('id')!r} is shown as it is without its bones")  # type: ignore[union-attr]
        bind = skin.find("bind_shape_matrix")
        yield geometry, instance, T if bind is None else T @ self._floats(bind, 16).reshape(4, 4)

    def _transform(self, node: Element) -> NDArray:
        """Product of a node's transforms in file order, shape (4, 4)."""
        T = np.eye(4)
        for child in node:
            step = np.eye(4)
            if child.tag == "matrix":
                step = self._floats(child, 16).reshape(4, 4)
            elif child.tag == "translate":
                step[:3, 3] = self._floats(child, 3)
            elif child.tag == "scale":
                step[:3, :3] = np.diag(self._floats(child, 3))
            elif child.tag == "rotate":
                x, y, z, degrees = self._floats(child, 4)
                step[:3, :3] = _rotation(np.array([x, y, z]), np.radians(degrees))
            elif child.tag in ("lookat", "skew"):
                self._reading.lose(f"<{child.tag}> of node {node.get('id')!r} is not applied")
            T = T @ step
        return T

    def _geometry(self, geometry: Element, instance: Element, shown: set[Element]) -> Iterator[Piece]:
        """Pieces of a geometry in its own frame."""
        shown.add(geometry)
        mesh = geometry.find("mesh")
        if mesh is None:
            self._reading.lose(f"geometry {geometry.get('id')!r} is no mesh and is left out")
            return
        bound = {m.get("symbol"): m for m in instance.iter("instance_material")}
        if geometry not in self._primitives:
            for kind in ("lines", "linestrips"):
                if mesh.find(kind) is not None:
                    self._reading.note(f"<{kind}> of geometry {geometry.get('id')!r} are left out")
            self._primitives[geometry] = [p for p in mesh if p.tag in POLYGONS and p.find("p") is not None]
        self._reading.visit(len(bound), self._line(instance))
        for primitive in self._primitives[geometry]:
            self._reading.visit(where=self._line(primitive))
            yield self._piece(primitive, mesh, bound)

    def _piece(self, primitive: Element, mesh: Element, bound: dict[str | None, Element]) -> Piece:
        inputs = self._inputs(primitive, mesh)
        index, counts = self._index(primitive, 1 + max((i.offset for i in inputs), default=0))
        positions = next((i for i in inputs if i.semantic == "POSITION"), None)
        if positions is None:
            raise self._refused(primitive, f"<{primitive.tag}> has no POSITION")
        points = self._source(positions, 3)
        corners = index[:, positions.offset]
        if len(corners) and not 0 <= corners.min() <= corners.max() < len(points):
            raise self._refused(primitive, f"a face names vertex {corners.max()} of {len(points)}")
        if primitive.tag in ("tristrips", "trifans"):
            triangles = strips(counts, fans=primitive.tag == "trifans")
        else:
            triangles = cut_polygons(points, corners, counts, self._reading)
        binding = bound.get(primitive.get("material"))
        paint, uvs, colours = self._paint(primitive, binding), None, None
        if paint is None or paint.textured:
            binds = [] if binding is None else binding.findall("bind_vertex_input")
            of_uvs = (b.get("input_set", 0) for b in binds if b.get("input_semantic") == "TEXCOORD")
            uvs = self._picked(inputs, "TEXCOORD", 2, index, triangles, int(next(of_uvs, -1)))
        if paint is None:
            colours = self._picked(inputs, "COLOR", 3, index, triangles)
        return Piece(
            points=points,
            faces=corners[triangles],
            paint=paint,
            normals=self._picked(inputs, "NORMAL", 3, index, triangles),
            uvs=uvs,
            colours=None if colours is None else linear_from_srgb(colours),
        )

    def _inputs(self, primitive: Element, mesh: Element) -> list[_Input]:
        """Inputs of a primitive, with VERTEX replaced by the inputs of the mesh's vertices."""
        if mesh not in self._vertices:
            self._vertices[mesh] = mesh.findall("vertices/input")
        inputs: list[_Input] = []
        for element in primitive.findall("input"):
            is_vertex = element.get("semantic") == "VERTEX"
            if len(inputs) > MOST_INPUTS:
                raise self._refused(primitive, f"<{primitive.tag}> has over {MOST_INPUTS} inputs")
            for each in self._vertices[mesh] if is_vertex else (element,):
                semantic, source = each.get("semantic", ""), each.get("source", "")[1:]
                offset = int(element.get("offset", 0))
                inputs.append(_Input(semantic, source, offset, int(each.get("set", 0))))
        return inputs

    def _index(self, primitive: Element, stride: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Indices at a primitive's corners, shape (C, inputs), and corners of each polygon, shape (P,)."""
        texts = [p.text or "" for p in primitive.findall("p")]
        self._reading.spend(sum(map(len, texts)))  # nodes that share it read it again
        lists = [numbers(text, np.int64) for text in texts]
        wanted = 3 * stride * int(primitive.get("count", 0)) if primitive.tag == "triangles" else -1
        for p, values in zip(primitive.findall("p"), lists, strict=True):
            whole = len(values) == wanted or len(values) == len((p.text or "").split())
            if len(values) % stride or not whole:
                raise self._refused(p, f"its indices are not whole numbers in rows of {stride}")
        index = np.concatenate(lists).reshape(-1, stride)
        if primitive.tag == "polylist":
            counts = numbers(primitive.findtext("vcount", ""), np.int64)
        elif primitive.tag == "triangles":
            counts = np.full(len(index) // 3, 3)
        else:
            counts = np.array([len(values) // stride for values in lists])
        if counts.sum() != len(index) or (len(counts) and counts.min() < 3):
            raise self._refused(
                primitive, f"its polygons have {counts.sum()} corners, its indices are {len(index)}"
            )
        return index, counts

    def _picked(
        self,
        inputs: list[_Input],
        semantic: str,
        width: int,
        index: NDArray,
        triangles: NDArray,
        number: int = -1,
    ) -> NDArray | None:
        """Values at the triangles' corners, shape (F, 3, width); None if the file gives none that fit."""
        matches = [i for i in inputs if i.semantic == semantic]
        chosen = next((i for i in matches if i.set == number), matches[0] if matches else None)
        if chosen is None:
            return None
        values, rows = self._source(chosen, width), index[triangles, chosen.offset]
        if not len(values) or rows.max(initial=0) >= len(values):
            self._reading.lose(f"{semantic} {chosen.source!r} has too few values and is left out")
            return None
        return values.astype(np.float32)[rows]

    def _source(self, given: _Input, width: int) -> NDArray:
        """Values of a source, shape (N, width)."""
        if given.source not in self._sources:
            element = self._ids.get(given.source)
            array = None if element is None else element.find("float_array")
            accessor = None if element is None else element.find("technique_common/accessor")
            if array is None or accessor is None:
                raise InputError(
                    f"{self._reading.path}: source {given.source!r} is not there; export it again"
                )
            stride, start = int(accessor.get("stride", 1)), int(accessor.get("offset", 0))
            count = int(accessor.get("count", 0))
            values = numbers(array.text or "", float)[start : start + stride * count]
            if len(values) < stride * count or stride < width:
                raise self._refused(
                    array, f"{len(values)} numbers are too few for {count} rows of {max(stride, width)}"
                )
            self._sources[given.source] = values.reshape(count, stride)
        return self._sources[given.source][:, :width]

    def _paint(self, primitive: Element, binding: Element | None) -> Paint | None:
        """The paint of a primitive's material; None if it has no material or no colour."""
        symbol = primitive.get("material")
        if symbol is None:
            return None
        name = symbol if binding is None else binding.get("target", "")[1:]  # unbound, it may be the id
        material = self._ids.get(name)
        if material is None or material.tag != "material":
            self._reading.lose(f"material {name!r} is not there; shown without it")
            return None
        if material not in self._paints:
            self._paints[material] = self._make(material)
        return self._paints[material]

    def _make(self, material: Element) -> Paint | None:
        effect = self._target(material.find("instance_effect"))
        name = material.get("name") or material.get("id") or ""
        profile = None if effect is None else effect.find("profile_COMMON")
        shader = None if profile is None else next((e for e in profile.iter() if e.tag in SHADERS), None)
        if effect is None or profile is None or shader is None:
            self._reading.lose(f"material {name!r} has no effect that can be read; shown without it")
            return None
        diffuse = shader.find("diffuse")
        if diffuse is None:
            diffuse = shader.find("emission") if shader.tag == "constant" else None
        if diffuse is None or not len(diffuse):
            return None
        if profile not in self._parameters:
            self._parameters[profile] = {p.get("sid"): p for p in profile.iter("newparam")}
            for given in shader:  # also those not used, for notes on malformed colours
                if given.find("color") is not None:
                    self._colour(given, profile)
        opacity = self._opacity(shader, profile, name)
        double_sided = any((e.text or "").strip() == "1" for e in effect.iter("double_sided"))
        texture = diffuse.find("texture")
        image = None if texture is None else self._image(texture, profile)
        if image is not None:
            r, g, b = 1.0, 1.0, 1.0
        else:
            r, g, b, _ = GREY if texture is not None else self._colour(diffuse, profile)
        emissive, emission = (0.0, 0.0, 0.0), shader.find("emission")
        if emission is not None and diffuse is not emission and self._has_colour(emission):
            emissive = linear(self._colour(emission, profile))
        cut_out = self._cut_out(shader, profile, name)
        maps = self._maps(effect, shader, profile, name)
        if cut_out is not None and cut_out != image:
            maps = (*maps, ("opacity", Map(cut_out, "a", (opacity,) * 4)))
        return Paint(
            name,
            (r, g, b, opacity),
            image,
            emissive=emissive,
            **self._highlight(shader, profile, name),
            maps=maps,
            see_through=cut_out is not None and cut_out == image,
            double_sided=double_sided,
        )

    def _cut_out(self, shader: Element, profile: Element, name: str) -> Image | None:
        """The image whose alpha is the opacity; None if the shader has none."""
        transparent = shader.find("transparent")
        texture = None if transparent is None else transparent.find("texture")
        image = None if texture is None else self._image(texture, profile)
        if transparent is None or image is None:
            return None
        if transparent.get("opaque", "A_ONE") == "A_ONE" and image.has_alpha:
            return image
        self._reading.lose(f"material {name!r}: its map of transparency without alpha is left out")
        return None

    @staticmethod
    def _has_colour(element: Element) -> bool:
        return element.find("color") is not None or element.find("param") is not None

    def _highlight(self, shader: Element, profile: Element, name: str) -> dict[str, Any]:
        """Roughness and reflectance of a phong or blinn shader, see `smoothness`, as arguments of a paint.

        Exporters write the exponent of phong and blinn from 0 to 1 or to 1000; below 1 it is a share of 128.
        """
        specular, shininess = shader.find("specular"), shader.find("shininess")
        if specular is None or shininess is None:
            return {}
        if specular.find("texture") is not None:
            self._reading.lose(f"material {name!r}: its map of highlights is left out")
        number = numbers(shininess.findtext("float", ""), float)
        if not self._has_colour(specular) or len(number) != 1 or not np.isfinite(number).all():
            return {}
        exponent = float(number[0]) * (128 if number[0] < 1 else 1)
        highlight = linear(self._colour(specular, profile))
        if max(highlight) == 0:
            return {"roughness": 1.0}
        roughness, reflectance = smoothness(exponent, highlight)
        return {"roughness": roughness, "specular": reflectance}

    def _maps(
        self, effect: Element, shader: Element, profile: Element, name: str
    ) -> tuple[tuple[str, Map], ...]:
        """Maps of emission and of normals (`<bump>`, an extension); others are counted as lost."""
        maps = []
        emission = shader.find("emission/texture")
        image = None if emission is None else self._image(emission, profile)
        if image is not None:
            maps.append(("emissiveColor", Map(image, colour=True)))
        for bump in effect.iter("bump"):
            texture = bump.find("texture")
            image = None if texture is None else self._image(texture, profile)
            if image is not None and (bump.get("bumptype") == "NORMALMAP" or image.shows_normals):
                maps.append(("normal", normal_map(image)))
                break
            if image is not None:
                self._reading.lose(f"material {name!r}: its map of heights {image.name!r} is left out")
        if shader.find("reflective/texture") is not None:
            self._reading.lose(f"material {name!r}: its map of reflections is left out")
        return tuple(maps)

    def _image(self, texture: Element, profile: Element) -> Image | None:
        """The image of a `<texture>`: through sampler and surface, through a sampler (1.5), or directly."""
        name = texture.get("texture", "")
        for _ in range(2):  # a sampler names a surface, a surface an image
            parameter = self._parameters[profile].get(name)
            if parameter is not None:
                url = parameter.find("sampler2D/instance_image")
                paths = ("sampler2D/source", "surface/init_from")
                text = next(filter(None, map(parameter.findtext, paths)), "")
                name = text.strip() if url is None else url.get("url", "")[1:]
        image = self._ids.get(name)
        file = "" if image is None else (image.findtext("init_from/ref") or image.findtext("init_from") or "")
        if not file.strip():
            self._reading.lose(f"texture {texture.get('texture')!r} names no image and is left out")
            return None
        return read_image(file.strip(), self._reading)

    def _opacity(self, shader: Element, profile: Element, name: str) -> float:
        """Opacity of a shader (COLLADA 1.4.1, chapter 7, "Determining Transparency").

        A_ONE: a t. RGB_ZERO: 1 - luminance(r, g, b) t, with the colour (r, g, b, a) of `<transparent>` and
        t of `<transparency>`. Exporters that confuse the two make surfaces invisible; those become opaque.
        """
        transparent, strength = shader.find("transparent"), shader.find("transparency")
        number = None if strength is None else numbers(strength.findtext("float", ""), float)
        t = float(number[0]) if number is not None and len(number) == 1 else 1.0
        if transparent is None or all(transparent.find(kind) is None for kind in ("color", "param")):
            opacity = t
        else:
            r, g, b, a = self._colour(transparent, profile)
            rgb_zero = transparent.get("opaque", "A_ONE") == "RGB_ZERO"
            opacity = 1 - float(np.dot((r, g, b), LUMINANCE)) * t if rgb_zero else a * t
        if not opacity > 0:
            self._reading.note(f"material {name!r} would be invisible; made opaque")
            return 1.0
        return min(opacity, 1.0)

    def _colour(self, element: Element, profile: Element) -> Rgba:
        """The `<color>` of an element or of its parameter, 0 to 1, repaired if malformed."""
        if element not in self._colours:
            self._colours[element] = self._read_colour(element, profile)
        return self._colours[element]

    def _read_colour(self, element: Element, profile: Element) -> Rgba:
        parameter = element.find("param")
        if parameter is not None:
            named = self._parameters[profile].get(parameter.get("ref"))
            text = "" if named is None else named.findtext("float4") or named.findtext("float3") or ""
        else:
            text = element.findtext("color") or ""
        words = text.split()
        values = numbers(" ".join(piece for word in words for piece in _part(word)), float)
        rgba = (*values, 1.0)[:4] if len(values) in (3, 4) and np.isfinite(values).all() else GREY
        if len(words) != 4 or len(values) != 4:
            mended = " ".join(f"{c:g}" for c in rgba)
            self._reading.note(f"malformed colour {text.strip()!r} read as {mended!r}")
        r, g, b, a = (float(np.clip(c, 0, 1)) for c in rgba)
        return (r, g, b, a)

    def _floats(self, element: Element, count: int) -> NDArray:
        values = numbers(element.text or "", float)
        if len(values) != count or not np.isfinite(values).all():
            raise self._refused(element, f"<{element.tag}> needs {count} finite numbers")
        return values

    def _target(self, element: Element | None) -> Element | None:
        """The element that a `url` refers to."""
        return None if element is None else self._ids.get(element.get("url", "").removeprefix("#"))

    def _refused(self, element: Any, text: str) -> InputError:
        return InputError(f"{self._line(element)}: {text}; export it again")

    def _line(self, element: Any) -> str:
        return f"{self._reading.path}:{self._lines[element]}"


def _part(word: str) -> list[str]:
    """Split two numbers written without a space: "0.01.0" is 0.0 and 1.0."""
    fused = re.fullmatch(r"(\d+\.\d+?)(\d\.\d+)", word)
    return [fused[1], fused[2]] if fused else [word]


def _rotation(axis: NDArray, angle: float) -> NDArray:
    """Rotation about an axis [rad], shape (3, 3) (Rodrigues 1840): I + sin a K + (1 - cos a) K^2."""
    length = np.linalg.norm(axis)
    x, y, z = axis / length if length > 0 else axis
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
