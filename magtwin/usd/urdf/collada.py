"""COLLADA: triangles of a .dae, its nested transforms, unit, colours, textures and normals, by pycollada."""

import io
import re
from dataclasses import replace
from typing import Any

import numpy as np

from magtwin.names import RefusedError
from magtwin.usd.geometry import linear_from_srgb
from magtwin.usd.urdf.mesh import Paint, Piece, Rgba
from magtwin.usd.urdf.reading import Reading
from magtwin.usd.urdf.texture import read_image


def read_collada(reading: Reading) -> list[Piece]:
    """The triangles of a COLLADA file, as `read_mesh` has it.

    Malformed colours would make pycollada drop the effect, then the material, then the geometry; they
    are mended in the text first.
    """
    import collada
    from collada.common import DaeError

    text, mended = _mend_colours(reading.path.read_text(encoding="utf-8", errors="replace"))
    for line in mended:
        reading.note(line)
    file = collada.Collada(io.BytesIO(text.encode()), ignore=[DaeError])
    axis = file.assetInfo.upaxis
    if axis not in (None, collada.asset.UP_AXIS.Z_UP):
        reading.note(f"its up axis {axis} is not applied, as in RViz; turn the visual instead")
    for error in file.errors:
        reading.lose(f"{type(error).__name__}: {str(error).strip() or 'malformed'}")
    if file.scene is None:
        raise RefusedError(f"{reading.path}: has no scene to show; export it again")
    unit = float(file.assetInfo.unitmeter or 1.0)
    paints = _Paints(reading)
    pieces, shown = [], set()
    for bound in file.scene.objects("geometry"):
        shown.add(bound.original.id)
        T = np.asarray(bound.matrix, float)
        T = np.vstack([T[:3] * unit, T[3]])
        for primitive in bound.original.primitives:
            piece = _piece(primitive, bound.materialnodebysymbol, paints, reading)
            if piece is not None:
                pieces.append(piece.moved(T))
    for geometry in file.geometries:
        if geometry.id not in shown:
            reading.note(f"geometry {geometry.id!r} is not in the file's scene and is left out")
    if next(iter(file.scene.objects("controller")), None) is not None:
        reading.lose("skinned meshes are left out")
    return pieces


def _piece(primitive: Any, materials: dict[str, Any], paints: "_Paints", reading: Reading) -> Piece | None:
    """Triangles of one primitive in its own frame; lines and points have none."""
    kind = type(primitive).__name__
    if hasattr(primitive, "triangleset"):
        primitive = primitive.triangleset()
    index = primitive.vertex_index
    if index is None or not len(index):
        return None
    if np.shape(index)[-1] != 3:
        reading.note(f"a {kind} holds no triangles and is left out")
        return None
    node = materials.get(primitive.material)
    normals = uvs = colours = None
    if primitive.normal is not None and primitive.normal_index is not None:
        normals = np.asarray(primitive.normal, float)[primitive.normal_index]
    if primitive.texcoordset:
        uvs = np.asarray(primitive.texcoordset[0], float)[primitive.texcoord_indexset[0], :2]
    if primitive.sources.get("COLOR"):
        offset, *_, source = primitive.sources["COLOR"][0]
        colours = linear_from_srgb(np.asarray(source.data, float)[primitive.index[:, :, offset], :3])
    return Piece(
        points=np.asarray(primitive.vertex, float),
        faces=np.asarray(index, np.int64),
        paint=None if node is None else paints.of(node.target),
        normals=normals,
        uvs=uvs,
        colours=colours,
    )


class _Paints:
    """Paints of a file's materials, each made once."""

    def __init__(self, reading: Reading) -> None:
        self._reading = reading
        self._made: dict[str, Paint | None] = {}

    def of(self, material: Any) -> Paint | None:
        """The paint of a material; none where its effect says nothing of its colour."""
        if material is None:
            return None
        if material.id not in self._made:
            self._made[material.id] = self._make(material)
        return self._made[material.id]

    def _make(self, material: Any) -> Paint | None:
        effect = material.effect
        diffuse = getattr(effect, "diffuse", None)
        if diffuse is None:
            return None
        name = material.name or material.id or ""
        opacity = _opacity(effect, name, self._reading)
        if isinstance(diffuse, tuple):
            r, g, b = (float(np.clip(c, 0, 1)) for c in diffuse[:3])
            return Paint(name, (r, g, b, opacity))
        image = read_image(diffuse.sampler.surface.image.path, self._reading)
        paint = Paint(name, (1.0, 1.0, 1.0, opacity), image)
        return paint if image is not None else replace(paint, rgba=(0.5, 0.5, 0.5, opacity))


def _opacity(effect: Any, name: str, reading: Reading) -> float:
    """Opacity of an effect (COLLADA 1.4.1, chapter 7, "Determining Transparency").

    A_ONE: a t. RGB_ZERO: 1 - luminance(r, g, b) t, with the colour (r, g, b, a) of `<transparent>` and t
    of `<transparency>`. Exporters that mix the two up make surfaces that nobody could see: taken as
    opaque, with a note. Without `<transparent>` t alone is the opacity, unless it is 0.
    """
    colour, t = effect.transparent, effect.transparency
    if not isinstance(t, int | float) or not np.isfinite(t):
        return 1.0
    if isinstance(colour, tuple) and effect.opaque_mode == "RGB_ZERO":
        opacity = 1 - float(np.dot(colour[:3], (0.212671, 0.715160, 0.072169))) * t
    else:
        opacity = (colour[3] if isinstance(colour, tuple) and len(colour) > 3 else 1.0) * t
    if opacity <= 0:
        reading.note(f"material {name!r} would be invisible; taken as opaque")
        return 1.0
    return float(min(opacity, 1.0))


def _mend_colours(text: str) -> tuple[str, list[str]]:
    """`<color>` elements of effects with four numbers again: fused numbers parted, opacity added."""
    mended: list[str] = []

    def mend(match: re.Match[str]) -> str:
        tokens = match[2].split()
        numbers = _numbers([piece for token in tokens for piece in _part(token)])
        if len(tokens) == 4 and len(numbers) == 4:
            return match[0]
        new = _rgba(numbers)
        words = " ".join(f"{n:g}" for n in new)
        mended.append(f"malformed colour {match[2].strip()!r} read as {words!r}")
        return f"{match[1]}{words}{match[3]}"

    start = text.find("<library_effects")
    end = text.find("</library_effects>")
    if start < 0 or end < 0:  # colours of lights have three numbers and matter to nobody here
        return text, mended
    effects = re.sub(r"(<color[^>]*>)([^<]*)(</color>)", mend, text[start:end])
    return text[:start] + effects + text[end:], mended


def _numbers(words: list[str]) -> list[float]:
    """Words as finite numbers; none at all if one is not."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return []
    return numbers if np.isfinite(numbers).all() else []


def _rgba(numbers: list[float]) -> Rgba:
    """Four numbers from three or four; grey from any other count."""
    if len(numbers) not in (3, 4):
        return (0.5, 0.5, 0.5, 1.0)
    r, g, b, a = (*numbers, 1.0)[:4]
    return (r, g, b, a)


def _part(token: str) -> list[str]:
    """Two numbers that were written without a space: "0.01.0" is 0.0 and 1.0."""
    fused = re.fullmatch(r"(\d+\.\d+?)(\d\.\d+)", token)
    return [fused[1], fused[2]] if fused else [token]
