"""Drawings from DXF in text form: lines, polylines, arcs of doors, and blocks."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from magtwin.author.plan.drawing import Array, Drawing, Line
from magtwin.errors import InputError
from magtwin.files.file import read_bytes

METRES = {1: 0.0254, 2: 0.3048, 4: 1e-3, 5: 1e-2, 6: 1.0, 7: 1e3, 10: 0.9144, 14: 0.1}
"""Metres per unit by $INSUNITS: inches, feet, mm, cm, m, km, yards, dm."""

DEEPEST = 8
"""Most levels of blocks in blocks."""

MOST_LINES = 100_000
"""Most lines of a drawing, with those of its blocks."""

Record = list[tuple[int, str]]
"""An entity: its group codes with their values, the first of code 0."""


def read_dxf(path: Path) -> Drawing:
    """The lines of a DXF: LINE, LWPOLYLINE, POLYLINE and INSERT, and ARC as the swing of a door.

    Layers that are off or frozen are left out, and paper space.

    Raises:
        InputError: It is not a DXF in text form; the text has the line.
    """
    data = read_bytes(path, "floor plan", "OBJ")
    if data.startswith(b"AutoCAD Binary DXF"):
        raise InputError(f"{path}: a binary DXF; save it as ASCII DXF")
    records = list(_records(data.decode("utf-8", "replace").splitlines(), path))
    drawing, section, blocks, name = Drawing(), "", dict[str, list[Record]](), ""
    entities, hidden, unit = list[Record](), set[str](), 0
    for record in records:
        kind = record[0][1]
        if kind == "SECTION":
            section = _text(record, 2)
            variables = [k for k, pair in enumerate(record) if pair == (9, "$INSUNITS")]
            unit = int(float(record[variables[0] + 1][1])) if variables else unit
        elif kind == "LAYER" and (_value(record, 62) < 0 or int(_value(record, 70)) & 1):
            hidden.add(_text(record, 2))
        elif kind == "BLOCK":
            name = _text(record, 2)
            blocks[name] = [record]
        elif section == "BLOCKS" and name:
            blocks[name].append(record)
        elif section == "ENTITIES":
            entities.append(record)
    drawing.metres = METRES.get(unit)
    drawing.stated = f"its $INSUNITS is {unit}" if unit else "it has no $INSUNITS"
    shown = [record for record in entities if _text(record, 8) not in hidden and not _value(record, 67)]
    for line in _lines(shown, blocks, np.eye(3), "", 0):
        drawing.lines.append(line)
        if len(drawing.lines) > MOST_LINES:
            raise InputError(f"{path}: over {MOST_LINES:,} lines; export the walls and doors alone")
    if hidden:
        drawing.notes.append(f"layers that are off or frozen are left out: {', '.join(sorted(hidden))}")
    return drawing


def _records(lines: list[str], path: Path) -> Iterator[Record]:
    """Entities of a text of group codes and values, a line each."""
    record: Record = []
    for k in range(0, len(lines) - 1, 2):
        try:
            code = int(lines[k])
        except ValueError as error:
            raise InputError(
                f"{path}:{k + 1}: not DXF: a group code must be a number, got {lines[k]!r:.40}"
            ) from error
        if code == 0 and record:
            yield record
            record = []
        record.append((code, lines[k + 1].strip()))
    if record:
        yield record


def _text(record: Record, code: int) -> str:
    return next((value for c, value in record if c == code), "")


def _value(record: Record, code: int, default: float = 0.0) -> float:
    try:
        return float(_text(record, code) or default)
    except ValueError:
        return default


def _points(record: Record, x: int = 10, y: int = 20) -> Array:
    """Points of the group codes of x and y, shape (N, 2)."""
    each = [[float(value) for c, value in record if c == code] for code in (x, y)]
    return np.array(list(zip(*each, strict=False)), float).reshape(-1, 2)


def _lines(
    records: list[Record], blocks: dict[str, list[Record]], to_world: Array, layer: str, depth: int
) -> Iterator[Line]:
    """Lines of entities, with those of the blocks that they insert."""

    def line(p: Array, record: Record, *, closed: bool = False, arc: bool = False) -> Line:
        p = np.column_stack([p, np.ones(len(p))]) @ to_world.T
        scale = math.sqrt(abs(np.linalg.det(to_world[:2, :2])))
        return Line(p[:, :2], closed, f"{layer} {_text(record, 8)}".strip(), scale * _value(record, 43), arc)

    vertices, begun = list[Array](), Record()
    for record in records:
        kind = record[0][1]
        if kind == "LINE":
            yield line(np.vstack([_points(record), _points(record, 11, 21)]), record)
        elif kind == "LWPOLYLINE" and len(p := _points(record)) > 1:
            yield line(p, record, closed=bool(int(_value(record, 70)) & 1))
        elif kind == "POLYLINE":
            begun, vertices = record, []
        elif kind == "VERTEX":
            vertices.append(_points(record)[:1])
        elif kind == "SEQEND" and len(vertices) > 1:
            yield line(np.vstack(vertices), begun, closed=bool(int(_value(begun, 70)) & 1))
            vertices = []
        elif kind == "ARC":
            radius, centre = _value(record, 40), _points(record)[:1]
            turns = np.radians([_value(record, 50), _value(record, 51)])
            ends = centre + radius * np.column_stack([np.cos(turns), np.sin(turns)])
            yield line(np.vstack([centre, ends]), record, arc=True)
        elif kind == "INSERT" and depth < DEEPEST and (block := blocks.get(_text(record, 2))):
            c, s = (f(math.radians(_value(record, 50))) for f in (math.cos, math.sin))
            wide, high = _value(record, 41, 1.0), _value(record, 42, 1.0)
            (x, y), base = _points(record)[0], _points(block[0])[0]
            place = np.array([[c * wide, -s * high, x], [s * wide, c * high, y], [0, 0, 1]])
            place = place @ np.array([[1, 0, -base[0]], [0, 1, -base[1]], [0, 0, 1]])
            names = f"{layer} {_text(record, 8)} {_text(record, 2)}".strip()
            yield from _lines(block[1:], blocks, to_world @ place, names, depth + 1)
