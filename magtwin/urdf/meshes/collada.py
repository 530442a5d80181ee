"""COLLADA: reader of .dae files, versions 1.4 and 1.5, over pycollada.

pycollada decodes geometries. It is not given whole files, since it leaves out each mesh whose material has a
malformed colour or a missing image (all 5,282 triangles of the real TurtleBot 4's LiDAR), does not know
the images of version 1.5, and takes time by the square of nodes that refer to each other.
"""

import re
import warnings
from collections.abc import Iterator, Mapping
from typing import Any
from xml.etree import ElementTree

import collada
import numpy as np
from collada.geometry import Geometry
from collada.triangleset import TriangleSet
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.file import read_bytes
from magtwin.frames import matrix_from_quat
from magtwin.urdf.meshes.piece import GREY, Map, Paint, Piece, Rgba, linear, normal_map, smoothness
from magtwin.urdf.meshes.polygon import cut_polygons
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

TRANSFORMS = {"matrix": 16, "translate": 3, "scale": 3, "rotate": 4}
"""Numbers of each transform of a node."""

MOST_INPUTS = 64
"""Most inputs of a primitive and its vertices; pycollada looks at all indices for each."""

FUSED = re.compile(r"\b(\d+\.\d+?)(\d\.\d+)\b")
"""Two numbers without a space: "0.01.0" is 0.0 and 1.0."""

LUMINANCE = (0.212671, 0.715160, 0.072169)
"""Weights of linear red, green and blue, from the specification."""


def read(reading: Reading) -> list[Piece]:
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
        self._ids = {(e.tag, e.get("id")): e for e in markup.lines if e.get("id")}
        self._paints: dict[str, Paint | None] = {}  # by the id of their material
        self._placed: dict[Element, tuple[NDArray, list[Element]]] = {}  # transforms and contents of nodes
        self._primitives: dict[Element, list[Any]] = {}  # of geometries
        self._library = collada.Collada(ignore=[collada.DaeError])  # without a file: unknown inputs pass
        self._library.tag = str  # tags have no namespace here

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
        pieces = [
            piece.moved(T)
            for node in scene.findall("node")
            for geometry, instance, T in self._walk(node, np.diag([metre, metre, metre, 1.0]), ())
            for piece in self._geometry(geometry, instance)
            if self._reading.spend(piece.nbytes)
        ]
        for geometry in self._root.iterfind("library_geometries/geometry"):
            if geometry not in self._primitives:
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
            target = child if child.tag == "node" else self._target(child)
            if target is None:
                self._reading.lose(f"{child.tag.removeprefix('instance_')} {child.get('url')!r} is not there")
            elif target.tag == "node":
                yield from self._walk(target, T, (*above, node))
            elif target.tag == "geometry":
                yield target, child, T
            else:
                self._reading.lose(f"skin {child.get('url')!r} is left out; apply its bones and export again")

    def _transform(self, node: Element) -> NDArray:
        """Product of a node's transforms in file order, shape (4, 4)."""
        T = np.eye(4)
        for child in node:
            if child.tag in ("lookat", "skew"):
                self._reading.lose(f"<{child.tag}> of node {node.get('id')!r} is not applied")
            if child.tag not in TRANSFORMS:
                continue
            values, step = numbers(child.text or "", float), np.eye(4)
            if len(values) != TRANSFORMS[child.tag] or not np.isfinite(values).all():
                raise self._refused(child, f"<{child.tag}> needs {TRANSFORMS[child.tag]} finite numbers")
            if child.tag == "matrix":
                step = values.reshape(4, 4)
            elif child.tag == "translate":
                step[:3, 3] = values
            elif child.tag == "scale":
                step[:3, :3] *= values
            else:
                axis, half = values[:3] / (np.linalg.norm(values[:3]) or 1), np.radians(values[3]) / 2
                step[:3, :3] = matrix_from_quat([*np.sin(half) * axis, np.cos(half)])
            T = T @ step
        return T

    def _geometry(self, geometry: Element, instance: Element) -> Iterator[Piece]:
        """Pieces of a geometry in its own frame."""
        bound = {m.get("symbol"): m for m in instance.iter("instance_material")}
        if geometry not in self._primitives:
            self._primitives[geometry] = self._load(geometry)
        self._reading.visit(len(bound), self._line(instance))
        for primitive in self._primitives[geometry]:
            self._reading.visit(where=self._line(primitive.xmlnode))
            yield self._piece(primitive, bound)

    def _load(self, geometry: Element) -> list[Any]:
        """Primitives of a geometry with faces, from pycollada, after repairs of what it would lose."""
        name, mesh = geometry.get("id"), geometry.find("mesh")
        if mesh is None:
            self._reading.lose(f"geometry {name!r} is no mesh and is left out")
            return []
        for kind in ("lines", "linestrips"):
            if mesh.find(kind) is not None:
                self._reading.note(f"<{kind}> of geometry {name!r} are left out")
        shown = [p for p in mesh if p.tag in POLYGONS and p.find("p") is not None]
        mesh[:] = [*mesh.findall("source"), *mesh.findall("vertices"), *shown]
        self._reading.visit(len(shown), self._line(geometry))  # before they are decoded
        of_vertices = len(mesh.findall("vertices/input"))
        for primitive in shown:
            if len(primitive.findall("input")) + of_vertices > MOST_INPUTS:
                raise self._refused(primitive, f"<{primitive.tag}> has over {MOST_INPUTS} inputs")
            if primitive.tag == "triangles":  # pycollada reads the first <p>
                first, *others = primitive.findall("p")
                first.text = " ".join(p.text or "" for p in (first, *others))
        for accessor in mesh.iterfind("source/technique_common/accessor"):  # pycollada counts the names
            stride = str(len(accessor.findall("param")))
            if accessor.get("offset", "0") != "0" or accessor.get("stride", "1") != stride:
                raise self._refused(accessor, "an <accessor> whose values have an offset or no names")
        for array in mesh.iterfind("source/float_array"):  # pycollada makes nan into 0
            array.text = re.sub("nan", "inf", array.text or "", flags=re.IGNORECASE)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", "string or file could not be read")  # an error since numpy 2.3
            try:
                loaded = Geometry.load(self._library, {}, geometry)
            except Exception as error:  # pycollada raises many types on a damaged file
                text = f"geometry {name!r} cannot be read ({getattr(error, 'msg', error)})"
                raise self._refused(geometry, text) from error
        return [primitive for primitive in loaded.primitives if len(primitive.index)]

    def _piece(self, primitive: Any, bound: Mapping[str | None, Element]) -> Piece:
        index = primitive.index.reshape(-1, primitive.nindices)
        points, corners = primitive.vertex, primitive.vertex_index.reshape(-1)
        if index.min() < 0:
            raise self._refused(primitive.xmlnode, f"an index is {index.min()}")
        if isinstance(primitive, TriangleSet):
            triangles = np.arange(len(index)).reshape(-1, 3)
        else:
            counts = primitive.vcounts.astype(np.int64)
            if counts.sum() != len(index) or counts.min() < 3:
                text = f"its polygons have {counts.sum()} corners, its indices are {len(index)}"
                raise self._refused(primitive.xmlnode, text)
            triangles = cut_polygons(points, corners, counts, self._reading)

        def picked(semantic: str, number: str | None = None) -> NDArray | None:
            """Values at the triangles' corners, shape (F, 3, parts); None if the file gives none."""
            inputs = {each[3]: each for each in reversed(primitive.sources.get(semantic, []))}
            if not inputs:
                return None
            offset, *_, source = inputs.get(number) or next(reversed(inputs.values()))
            values: NDArray = source.data[index[triangles, offset]]
            return values

        binding = bound.get(primitive.material)
        paint, uvs, colours = self._paint(primitive.material, binding), None, None
        if paint is None or paint.textured:
            binds = [] if binding is None else binding.findall("bind_vertex_input")
            of_uvs = (b.get("input_set") for b in binds if b.get("input_semantic") == "TEXCOORD")
            uvs = picked("TEXCOORD", next(of_uvs, None))
        if paint is None:
            colours = picked("COLOR")
        return Piece(
            points=points,
            faces=corners[triangles],
            paint=paint,
            normals=picked("NORMAL"),
            uvs=uvs,
            colours=None if colours is None else linear_from_srgb(colours[..., :3]),
        )

    def _paint(self, symbol: str | None, binding: Element | None) -> Paint | None:
        """The paint of a primitive's material; None if it has no material or no colour."""
        if symbol is None:
            return None
        id_ = symbol if binding is None else binding.get("target", "")[1:]  # unbound, it may be the id
        if id_ not in self._paints:
            self._paints[id_] = self._make(id_)
        return self._paints[id_]

    def _make(self, id_: str) -> Paint | None:
        material = self._ids.get(("material", id_))
        if material is None:
            self._reading.lose(f"material {id_!r} is not there; shown without it")
            return None
        effect, name = self._target(material.find("instance_effect")), material.get("name") or id_
        profile = () if effect is None else effect.iterfind("profile_COMMON//*")
        shader = next((e for e in profile if e.tag in SHADERS), None)
        if effect is None or shader is None:
            self._reading.lose(f"material {name!r} has no effect that can be read; shown without it")
            return None
        return _Look(effect, shader, name, self._ids, self._reading).paint()

    def _target(self, instance: Element | None) -> Element | None:
        """The element that an instance refers to, by its kind and id; other kinds may have the same id."""
        kind, url = ("", "") if instance is None else (instance.tag, instance.get("url", ""))
        return self._ids.get((kind.removeprefix("instance_"), url.removeprefix("#")))

    def _refused(self, element: Element, text: str) -> InputError:
        return InputError(f"{self._line(element)}: {text}; export it again")

    def _line(self, element: Element) -> str:
        return f"{self._reading.path}:{self._lines[element]}"


class _Look:
    """The shader of an effect: colours and textures by the tag of its input."""

    def __init__(self, effect: Element, shader: Element, name: str, ids: dict, reading: Reading) -> None:
        self._effect, self._shader, self._name, self._ids, self._reading = effect, shader, name, ids, reading
        self._parameters = {p.get("sid"): p for p in effect.iter("newparam")}
        self._textures = {each.tag: each.find("texture") for each in shader}
        self._colours = {
            each.tag: self._colour(each)
            for each in shader
            if each.find("color") is not None or each.find("param") is not None
        }

    def paint(self) -> Paint | None:
        """Its paint; None if it has no colour."""
        glows = self._shader.tag == "constant" and self._shader.find("diffuse") is None
        base = "emission" if glows else "diffuse"
        textured = self._textures.get(base) is not None
        if base not in self._colours and not textured:
            return None
        opacity, image, cut_out = self._opacity(), self._image(self._textures.get(base)), self._cut_out()
        r, g, b, _ = (1.0,) * 4 if image else GREY if textured else self._colours[base]
        maps = self._maps()
        if cut_out is not None and cut_out != image:
            maps.append(("opacity", Map(cut_out, "a", (opacity,) * 4)))
        lit = "emission" in self._colours and not glows
        return Paint(
            self._name,
            (r, g, b, opacity),
            image,
            emissive=linear(self._colours["emission"]) if lit else (0.0, 0.0, 0.0),
            **self._highlight(),
            maps=tuple(maps),
            see_through=cut_out is not None and cut_out == image,
            double_sided=any((e.text or "").strip() == "1" for e in self._effect.iter("double_sided")),
        )

    def _lose(self, what: str) -> None:
        self._reading.lose(f"material {self._name!r}: its map of {what} is left out")

    def _opaque(self, mode: str) -> bool:
        """Whether `<transparent>` is read in this mode."""
        transparent = self._shader.find("transparent")
        return transparent is not None and transparent.get("opaque", "A_ONE") == mode

    def _cut_out(self) -> Image | None:
        """The image whose alpha is the opacity; None if the shader has none."""
        image = self._image(self._textures.get("transparent"))
        if image is None or (self._opaque("A_ONE") and image.has_alpha):
            return image
        self._lose("transparency without alpha")
        return None

    def _opacity(self) -> float:
        """Opacity of a shader (COLLADA 1.4.1, chapter 7, "Determining Transparency").

        A_ONE: a t. RGB_ZERO: 1 - luminance(r, g, b) t, with the colour (r, g, b, a) of `<transparent>` and
        t of `<transparency>`. Exporters that confuse the two make surfaces invisible; those become opaque.
        """
        t = self._number("transparency", 1.0)
        *rgb, a = self._colours.get("transparent", (0.0, 0.0, 0.0, 1.0))
        rgb_zero = self._opaque("RGB_ZERO") and "transparent" in self._colours
        opacity = 1 - float(np.dot(rgb, LUMINANCE)) * t if rgb_zero else a * t
        if not opacity > 0:
            self._reading.note(f"material {self._name!r} would be invisible; made opaque")
            return 1.0
        return min(opacity, 1.0)

    def _highlight(self) -> dict[str, Any]:
        """Roughness and reflectance of a phong or blinn shader, see `smoothness`, as arguments of a paint.

        Exporters write the exponent of phong and blinn from 0 to 1 or to 1000; below 1 it is a share of 128.
        """
        exponent = self._number("shininess", np.inf)
        if "specular" not in self._colours or not np.isfinite(exponent):
            return {}
        highlight = linear(self._colours["specular"])
        if max(highlight) == 0:
            return {"roughness": 1.0}
        roughness, reflectance = smoothness(exponent * (128 if exponent < 1 else 1), highlight)
        return {"roughness": roughness, "specular": reflectance}

    def _maps(self) -> list[tuple[str, Map]]:
        """Maps of emission and of normals (`<bump>`, an extension); others are counted as lost."""
        maps = []
        if (glow := self._image(self._textures.get("emission"))) is not None:
            maps.append(("emissiveColor", Map(glow, colour=True)))
        for bump in self._effect.iter("bump"):
            image = self._image(bump.find("texture"))
            if image is not None and (bump.get("bumptype") == "NORMALMAP" or image.shows_normals):
                maps.append(("normal", normal_map(image)))
                break
            if image is not None:
                self._lose(f"heights {image.name!r}")
        for tag, what in (("specular", "highlights"), ("reflective", "reflections")):
            if self._textures.get(tag) is not None:
                self._lose(what)
        return maps

    def _image(self, texture: Element | None) -> Image | None:
        """The image of a `<texture>`: through sampler and surface, through a sampler (1.5), or directly."""
        if texture is None:
            return None
        name = texture.get("texture", "")
        for _ in range(2):  # a sampler names a surface, a surface an image
            parameter = self._parameters.get(name)
            if parameter is not None:
                url = parameter.find("sampler2D/instance_image")
                paths = ("sampler2D/source", "surface/init_from")
                text = next(filter(None, map(parameter.findtext, paths)), "")
                name = text.strip() if url is None else url.get("url", "")[1:]
        image = self._ids.get(("image", name))
        file = "" if image is None else (image.findtext("init_from/ref") or image.findtext("init_from") or "")
        if not file.strip():
            self._reading.lose(f"texture {texture.get('texture')!r} names no image and is left out")
            return None
        return read_image(file.strip(), self._reading)

    def _number(self, tag: str, default: float) -> float:
        values = numbers(self._shader.findtext(f"{tag}/float", ""), float)
        return float(values[0]) if len(values) == 1 else default

    def _colour(self, element: Element) -> Rgba:
        """The `<color>` of an element or of its parameter, 0 to 1, repaired if malformed."""
        text, parameter = element.findtext("color") or "", element.find("param")
        if parameter is not None:
            named = self._parameters.get(parameter.get("ref"))
            text = "" if named is None else named.findtext("float4") or named.findtext("float3") or ""
        values = numbers(FUSED.sub(r"\1 \2", text), float)
        rgba = (*values, 1.0)[:4] if len(values) in (3, 4) and np.isfinite(values).all() else GREY
        if len(text.split()) != 4 or len(values) != 4:
            mended = " ".join(f"{c:g}" for c in rgba)
            self._reading.note(f"malformed colour {text.strip()!r} read as {mended!r}")
        r, g, b, a = (float(np.clip(c, 0, 1)) for c in rgba)
        return (r, g, b, a)
