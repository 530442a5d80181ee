"""Wavefront: triangles of an .obj with the materials of its .mtl."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtwin.names import RefusedError
from magtwin.usd.geometry import linear_from_srgb
from magtwin.usd.urdf.mesh import Paint, Piece
from magtwin.usd.urdf.reading import Reading
from magtwin.usd.urdf.texture import read_image

UNREAD = ("curv", "curv2", "surf", "l", "p")
"""Statements that draw something which is no polygon."""

MAP_ARGUMENTS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2}
"""Numbers that may follow an option of a texture; every other option has one word."""


@dataclass
class _Group:
    """Polygons of one material, as corners (vertex, texture coordinate, normal; 0 is none), 1-based."""

    material: str
    corners: list[tuple[int, int, int]] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)


def read_wavefront(reading: Reading) -> list[Piece]:
    """The triangles of a Wavefront OBJ, as `read_mesh` has it.

    Polygons are cut into fans. A colour after a vertex's coordinates is read (as MeshLab writes it).
    """
    path = reading.path
    rows: dict[str, list[str]] = {"v": [], "vt": [], "vn": []}
    paints: dict[str, Paint] = {}
    unread: set[str] = set()
    group = _Group("")
    groups = [group]
    for number, words in _statements(path):
        kind = words[0]
        if kind in rows:
            rows[kind].append(" ".join(words[1:]))
        elif kind == "f":
            try:
                corners = [_corner(word, rows) for word in words[1:]]
            except ValueError as error:
                raise RefusedError(
                    f"{path}:{number}: face {' '.join(words[1:])!r} is malformed; export it again"
                ) from error
            if len(corners) >= 3:
                group.corners += corners
                group.counts.append(len(corners))
        elif kind == "usemtl":
            group = _Group(" ".join(words[1:]))
            groups.append(group)
        elif kind == "mtllib":
            paints |= _read_library(" ".join(words[1:]), reading)
        elif kind in UNREAD:
            unread.add(kind)
    if unread:
        reading.lose(f"lines, points and curves ({', '.join(sorted(unread))}) are left out")
    v, vt, vn = (_table(rows[kind], kind, path) for kind in ("v", "vt", "vn"))
    for missing in dict.fromkeys(
        g.material for g in groups if g.counts and g.material and g.material not in paints
    ):
        reading.lose(f"material {missing!r} is in none of its libraries; shown without it")
    return [_piece(g, paints.get(g.material), v, vt, vn, path) for g in groups if g.counts]


def _statements(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Number and words of each line that says something; a backslash at its end joins the next."""
    held = ""
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, 1):
            line = held + line
            if line.endswith("\\\n"):
                held = line[:-2] + " "
                continue
            held = ""
            words = line.partition("#")[0].split() if "#" in line else line.split()
            if words:
                yield number, words


def _corner(word: str, rows: dict[str, list[str]]) -> tuple[int, int, int]:
    """`v`, `v/vt`, `v//vn` or `v/vt/vn`; negative ones count back from the newest."""
    parts = word.split("/")
    v = int(parts[0])
    vt = int(parts[1]) if len(parts) > 1 and parts[1] else 0
    vn = int(parts[2]) if len(parts) > 2 and parts[2] else 0
    if v < 0 or vt < 0 or vn < 0:
        v = v if v >= 0 else len(rows["v"]) + 1 + v
        vt = vt if vt >= 0 else len(rows["vt"]) + 1 + vt
        vn = vn if vn >= 0 else len(rows["vn"]) + 1 + vn
    if v < 1:
        raise ValueError("a corner without a vertex")
    return v, vt, vn


def _table(rows: list[str], kind: str, path: Path) -> NDArray:
    """Numbers of all `v`, `vt` or `vn`, one row each."""
    if not rows:
        return np.empty((0, 3))
    width = len(rows[0].split())
    try:
        values = np.array(" ".join(rows).split(), float).reshape(len(rows), width)
    except ValueError as error:
        raise RefusedError(
            f"{path}: its {kind} are not {width} numbers each, as the first one is; export it again"
        ) from error
    if width < (2 if kind == "vt" else 3):
        raise RefusedError(f"{path}: its {kind} have {width} numbers each; export it again")
    return values


def _piece(group: _Group, paint: Paint | None, v: NDArray, vt: NDArray, vn: NDArray, path: Path) -> Piece:
    corners, counts = np.array(group.corners, np.int64) - 1, np.array(group.counts)
    for column, table, name in ((0, v, "vertex"), (1, vt, "texture coordinate"), (2, vn, "normal")):
        if corners[:, column].max() >= len(table):
            raise RefusedError(
                f"{path}: a face names {name} {corners[:, column].max() + 1} of {len(table)}; export it again"
            )
    cuts = counts - 2
    first = np.repeat(np.cumsum(counts) - counts, cuts)
    step = np.arange(cuts.sum()) - np.repeat(np.cumsum(cuts) - cuts, cuts)
    index = corners[np.column_stack([first, first + step + 1, first + step + 2])]
    faces = index[:, :, 0]
    return Piece(
        points=v[:, :3],
        faces=faces,
        paint=paint,
        normals=_picked(vn, index[:, :, 2]),
        uvs=_picked(vt[:, :2], index[:, :, 1]),
        colours=linear_from_srgb(v[faces, 3:6]) if v.shape[1] >= 6 else None,
    )


def _picked(table: NDArray, index: NDArray) -> NDArray | None:
    """Rows of a table; nan at corners that name none (-1), none where all do."""
    if (index < 0).all():
        return None
    return np.where((index < 0)[..., None], np.nan, table[index])


def _read_library(name: str, reading: Reading) -> dict[str, Paint]:
    """Materials of an .mtl by name; none, with a note, where it cannot be read.

    `Kd` is the colour and `d` (or 1 - `Tr`) the opacity; of a surface with `map_Kd` the picture is the
    colour, since exporters write any `Kd` beside one.
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
    for _, words in _statements(library):
        if words[0] == "newmtl":
            table = tables.setdefault(" ".join(words[1:]), {})
        else:
            table[words[0].lower()] = words[1:]
    return {material: _paint(material, table, library.parent, reading) for material, table in tables.items()}


def _paint(name: str, table: dict[str, list[str]], folder: Path, reading: Reading) -> Paint:
    try:
        r, g, b = (
            float(np.clip(float(word), 0, 1)) for word in (table.get("kd") or ["0.5", "0.5", "0.5"])[:3]
        )
        if "d" in table:
            opacity = float(table["d"][-1])
        else:
            opacity = 1 - float(table["tr"][-1]) if "tr" in table else 1.0
    except (ValueError, IndexError):
        reading.note(f"material {name!r} has a malformed colour; taken as grey")
        r, g, b, opacity = 0.5, 0.5, 0.5, 1.0
    if not opacity > 0:
        reading.note(f"material {name!r} would be invisible; taken as opaque")
    opacity = min(opacity, 1.0) if opacity > 0 else 1.0
    image = read_image(_file_of(table["map_kd"]), reading, folder) if table.get("map_kd") else None
    return Paint(name, (r, g, b, opacity) if image is None else (1.0, 1.0, 1.0, opacity), image)


def _file_of(words: list[str]) -> str:
    """The file name after a texture's options; it may hold spaces."""
    at = 0
    while at < len(words) and re.fullmatch(r"-[a-z]+", words[at]):
        numbers = MAP_ARGUMENTS.get(words[at], 1)
        at += 1
        taken = 0
        while (
            taken < numbers and at < len(words) - 1 and (taken == 0 or re.fullmatch(r"[-+.\deE]+", words[at]))
        ):
            at, taken = at + 1, taken + 1
    return " ".join(words[at:])
