"""Wavefront: reader of .obj files with the materials of their .mtl.

tinyobjloader is not used: its only wheels are pre-releases, a malformed face makes it drop the whole file,
and it turns a malformed colour into black without a warning.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.file import existing_file
from magtwin.urdf.meshes.piece import GREY, Map, Paint, Piece, linear, normal_map, smoothness
from magtwin.urdf.meshes.polygon import cut_polygons
from magtwin.urdf.meshes.reading import Reading, numbers
from magtwin.urdf.meshes.texture import Image, read_image
from magtwin.usd.geometry import linear_from_srgb

TEXT = 64
"""Bytes that a text takes beside its characters."""

GROUP = 600
"""Bytes that a group of polygons takes beside them."""

HELD = 1 << 24
"""Bytes of texts after which they are counted against the file's budget."""

UNREAD = ("curv", "curv2", "surf", "l", "p")
"""Statements that draw lines, points or curves."""

LEFT_OUT = {
    "map_ks": "map of highlights",
    "map_ns": "map of exponents",
    "disp": "map of displacements",
    "decal": "decal",
    "refl": "map of reflections",
}
"""Maps that UsdPreviewSurface does not have, or not together with the others."""

MAP_ARGUMENTS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2}
"""Most numbers after an option of a texture; other options have one word."""


@dataclass
class _Group:
    """Polygons of one material."""

    material: str
    words: list[str] = field(default_factory=list)
    """Corners of all polygons: `v`, `v/vt`, `v//vn` or `v/vt/vn`, from 1."""
    counts: list[int] = field(default_factory=list)
    """Number of corners of each polygon."""
    lines: list[int] = field(default_factory=list)
    """Line of each polygon."""


def read(reading: Reading) -> list[Piece]:
    """The triangles of a Wavefront OBJ, for `read_mesh`; vertices may have colours as in MeshLab."""
    path = reading.path
    rows: dict[str, list[str]] = {"v": [], "vt": [], "vn": []}
    paints: dict[str, Paint] = {}
    unread: set[str] = set()
    group = _Group("")
    groups = [group]
    held = 0
    for number, kind, rest in _statements(path):
        held += TEXT * (1 + rest.count(" ") if kind == "f" else 1) + len(rest)
        if held > HELD:
            reading.spend(held)
            held = 0
        if kind in rows:
            rows[kind].append(rest)
        elif kind == "f":
            words = rest.split()
            if "-" in rest:
                words = [_absolute(word, rows) for word in words]
            if len(words) >= 3:
                group.words += words
                group.counts.append(len(words))
                group.lines.append(number)
        elif kind == "usemtl" and not group.counts:
            group.material = rest
        elif kind == "usemtl":
            reading.visit()
            held += GROUP
            group = _Group(rest)
            groups.append(group)
        elif kind == "mtllib":
            paints |= _read_library(rest, reading)
        elif kind in UNREAD:
            unread.add(kind)
    if unread:
        reading.lose(f"lines, points and curves ({', '.join(sorted(unread))}) are left out")
    v, vt, vn = (_table(rows[kind], kind, least, path) for kind, least in (("v", 3), ("vt", 2), ("vn", 3)))
    groups = [g for g in groups if g.counts]
    for missing in dict.fromkeys(g.material for g in groups if g.material and g.material not in paints):
        reading.lose(f"material {missing!r} is in none of its libraries; shown without it")
    points = v[:, :3]  # one array, so that the pieces share it
    return [_piece(g, paints.get(g.material), points, v, vt, vn, reading) for g in groups]


def _statements(path: Path) -> Iterator[tuple[int, str, str]]:
    """Line, keyword and the rest of each statement; a backslash continues a line."""
    held = ""
    with existing_file(path, "OBJ or MTL file", "OBJ").open(encoding="utf-8", errors="replace") as file:
        for number, text in enumerate(file, 1):
            line = held + text if held else text
            if line.endswith("\\\n"):
                held = line[:-2] + " "
                continue
            held = ""
            parts = (line.partition("#")[0] if "#" in line else line).split(None, 1)
            if len(parts) == 2:
                yield number, parts[0], parts[1].rstrip()


def _absolute(word: str, rows: dict[str, list[str]]) -> str:
    """A corner whose negative numbers, which count back from the last row, become positive."""
    parts = word.split("/")
    for i, (part, kind) in enumerate(zip(parts, ("v", "vt", "vn"), strict=False)):
        if part.startswith("-") and part[1:].isdecimal():
            parts[i] = str(len(rows[kind]) + 1 - int(part[1:]))
    return "/".join(parts)


def _corners(group: _Group, path: Path) -> NDArray[np.int64]:
    """Vertex, texture coordinate and normal of each corner, from 0; -1 if missing; shape (N, 3)."""
    words = [word + "/0" * (2 - word.count("/")) for word in group.words]
    text = f"{' '.join(words)} ".replace("//", "/0/").replace("/ ", "/0 ")
    values = numbers(text.replace("/", " "), np.int64)
    if len(values) == 3 * len(words) and values.min() >= 0 and values[::3].min() >= 1:
        return values.reshape(-1, 3) - 1
    first = 0
    for number, count in zip(group.lines, group.counts, strict=True):
        polygon, first = group.words[first : first + count], first + count
        if not all(re.fullmatch(r"0*[1-9]\d*(/\d*){0,2}", word) for word in polygon):
            raise InputError(f"{path}:{number}: face {' '.join(polygon)!r} is malformed; export it again")
    raise InputError(f"{path}: has a malformed face; export it again")


def _table(rows: list[str], kind: str, least: int, path: Path) -> NDArray:
    """Numbers of all `v`, `vt` or `vn`, one row each, with the width of the first row or the least."""
    if not rows:
        return np.empty((0, least))
    width = len(rows[0].split())
    values = numbers(" ".join(rows), float)
    if width >= least and len(values) == len(rows) * width:
        return values.reshape(len(rows), width)
    try:
        return np.array([row.split()[:least] for row in rows], float).reshape(len(rows), least)
    except ValueError as error:
        raise InputError(f"{path}: its {kind} are not {least} numbers each; export it again") from error


def _piece(
    group: _Group,
    paint: Paint | None,
    points: NDArray,
    v: NDArray,
    vt: NDArray,
    vn: NDArray,
    reading: Reading,
) -> Piece:
    path = reading.path
    corners, counts = _corners(group, path), np.array(group.counts)
    for column, table, name in ((0, v, "vertex"), (1, vt, "texture coordinate"), (2, vn, "normal")):
        if corners[:, column].max() >= len(table):
            raise InputError(
                f"{path}: a face names {name} {corners[:, column].max() + 1} of {len(table)}; export it again"
            )
    index = corners[cut_polygons(points, corners[:, 0], counts, reading)]
    faces = index[:, :, 0]
    return Piece(
        points=points,
        faces=faces,
        paint=paint,
        normals=_picked(vn, index[:, :, 2]),
        uvs=_picked(vt[:, :2], index[:, :, 1]),
        colours=linear_from_srgb(v[faces, 3:6]) if v.shape[1] >= 6 else None,
    )


def _picked(table: NDArray, index: NDArray) -> NDArray | None:
    """Rows of a table; nan at corners without one (-1), None if no corner has one."""
    if (index < 0).all():
        return None
    return np.where((index < 0)[..., None], np.nan, table[index])


def _read_library(name: str, reading: Reading) -> dict[str, Paint]:
    """Materials of an .mtl by name; empty with a note if it cannot be read.

    `Kd` is the colour, which multiplies `map_Kd`, and `d` (or 1 - `Tr`) the opacity.
    """
    library = reading.path.parent / name.replace("\\", "/")
    if not reading.may_read(library):
        reading.lose(f"material library {name!r} lies outside the robot's packages and is left out")
        return {}
    if not library.is_file():
        reading.lose(f"material library {name!r} is missing; shown without it")
        return {}
    tables: dict[str, dict[str, list[str]]] = {}
    table: dict[str, list[str]] = {}
    for _, kind, rest in _statements(library):
        if kind == "newmtl":
            table = tables.setdefault(rest, {})
        else:
            table[kind.lower()] = rest.split()
    return {material: _paint(material, table, library.parent, reading) for material, table in tables.items()}


def _paint(name: str, table: dict[str, list[str]], folder: Path, reading: Reading) -> Paint:
    library = _Material(name, table, folder, reading)
    try:
        r, g, b = library.colour("kd") or GREY[:3]
        if "d" in table:
            opacity = float(table["d"][-1])
        else:
            opacity = 1 - float(table["tr"][-1]) if "tr" in table else 1.0
    except (ValueError, IndexError):
        reading.note(f"material {name!r} has a malformed colour; grey is used")
        r, g, b, opacity = GREY
    if not opacity > 0 and "map_d" not in table:
        reading.note(f"material {name!r} would be invisible; made opaque")
    opacity = min(opacity, 1.0) if opacity > 0 else 1.0
    image = library.image("map_kd")
    if image is not None and ("kd" not in table or (r, g, b) == (0, 0, 0)):
        r, g, b = 1.0, 1.0, 1.0  # black is what exporters write beside a texture that they mean to show
    surface = library.surface()
    maps = library.maps(opacity, surface.get("emissive", (0.0, 0.0, 0.0)))
    return Paint(name, (r, g, b, opacity), image, **surface, maps=maps)


@dataclass
class _Material:
    """The statements of a material besides its colour."""

    name: str
    table: dict[str, list[str]]
    """Words after each keyword, in small letters."""
    folder: Path
    reading: Reading

    def colour(self, key: str) -> tuple[float, float, float] | None:
        """A colour (sRGB); one number stands for grey. None without the keyword."""
        if key not in self.table:
            return None
        words = self.table[key][:3] if len(self.table[key]) >= 3 else self.table[key][:1] * 3
        r, g, b = (float(np.clip(float(word), 0, 1)) for word in words)
        return (r, g, b)

    def image(self, key: str) -> Image | None:
        """The image of a map."""
        words = self.table.get(key)
        return read_image(_file_of(words), self.reading, self.folder) if words else None

    def surface(self) -> dict[str, Any]:
        """Emission, roughness, metallic, reflectance and index of refraction, as arguments of a paint.

        `Pr` and `Pm` are those of the PBR extension of MTL. Without them `Ks` and `Ns` are, see `smoothness`.
        """
        made: dict[str, Any] = {}
        try:
            emissive, highlight = self.colour("ke"), self.colour("ks")
            pr, pm, ns, ni = (self._number(key) for key in ("pr", "pm", "ns", "ni"))
        except (ValueError, IndexError):
            self.reading.lose(f"material {self.name!r} has malformed Ke, Ks, Ns, Pr, Pm or Ni; left out")
            return made
        if emissive is not None:
            made["emissive"] = linear(emissive)
        if pr is not None or pm is not None:
            made |= {"roughness": _share(pr, 0.5), "metallic": _share(pm, 0.0)}
        elif highlight is not None and max(highlight) > 0 and ns is not None:
            made["roughness"], made["specular"] = smoothness(ns, linear(highlight))
        elif ns is not None and highlight is not None:
            made["roughness"] = 1.0  # without a highlight
        if ni is not None and 1 < ni <= 4 and "specular" not in made:
            made["ior"] = ni
        return made

    def maps(self, opacity: float, emissive: tuple[float, float, float]) -> tuple[tuple[str, Map], ...]:
        """Maps of emission, roughness, metallic, opacity and normals; others are counted as lost."""
        maps: list[tuple[str, Map]] = []
        for key, name in (("map_pr", "roughness"), ("map_pm", "metallic")):
            image = self.image(key)
            if image is not None:
                maps.append((name, Map(image, "r")))
        image = self.image("map_ke")
        if image is not None:
            black = max(emissive) == 0  # as exporters write beside a texture that they mean to show
            scale = (1.0, 1.0, 1.0, 1.0) if black else (*emissive, 1.0)
            maps.append(("emissiveColor", Map(image, scale=scale, colour=True)))
        image = self.image("map_d")
        if image is not None:
            scale = (opacity, opacity, opacity, opacity)
            maps.append(("opacity", Map(image, "a" if image.has_alpha else "r", scale)))
        key = next((key for key in ("norm", "map_bump", "bump") if key in self.table), "")
        image = self.image(key)
        if image is not None and (key == "norm" or image.shows_normals):
            maps.append(("normal", normal_map(image)))
        elif image is not None:
            self.reading.lose(f"material {self.name!r}: its map of heights {image.name!r} is left out")
        for key, what in LEFT_OUT.items():
            if key in self.table:
                self.reading.lose(f"material {self.name!r}: its {what} ({key}) is left out")
        return tuple(maps)

    def _number(self, key: str) -> float | None:
        return float(self.table[key][0]) if key in self.table else None


def _share(value: float | None, default: float) -> float:
    return default if value is None else float(np.clip(value, 0, 1))


def _file_of(words: list[str]) -> str:
    """The file name after a texture's options; it may contain spaces."""
    at = 0
    while at < len(words) and re.fullmatch(r"-[a-z]+", words[at]):
        numbers = MAP_ARGUMENTS.get(words[at], 1)
        at += 1
        for taken in range(min(numbers, len(words) - 1 - at)):
            if taken and not re.fullmatch(r"[-+.\deE]+", words[at]):
                break
            at += 1
    return " ".join(words[at:])
