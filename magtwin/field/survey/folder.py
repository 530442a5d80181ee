"""Survey folders: one CSV per heading, as the APRILab's, read as Readings."""

import json
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.days import check_day
from magtwin.field.grid import Grid
from magtwin.field.survey.readings import TAKEN, TEXTS, Readings
from magtwin.field.units import check_unit, nt_per
from magtwin.files.file import existing, sha256
from magtwin.frames import wrap_angle
from magtwin.tables.table import read_table

Array = NDArray[np.float64]

COLUMNS = ("x", "y", "theta", "scalar_mag")
SUFFIX = "_map.csv"

# Widest angle between headings of a complete survey, if the caller does not give the headings
WIDEST_DEG = 90.0
GRAIN_M = 1e-6  # Coordinates closer than this are equal
QUOTED = 60  # Characters of a file that an error quotes

LARGEST_TURN = 2 * np.pi + 0.01
"""Headings beyond this are no radians, unless they count turns [rad]."""

USUAL_SPAN_M = 50.0
"""Extent above which the report asks for the unit of positions whose columns name none [m]."""

FAR_DEG = 20.0
"""Median difference of recorded headings from those of their nodes at which they contradict each other."""

# Metadata of a map in comment lines that an import restores. Its source becomes the imported files.
KEPT = ("name", "method", "licence", "created", "frame", "datum", "height_m", "parameters")
# Keys: rows of a file that are not field, counted from 0; median standard deviation of its values [nT]
MASKED, ERROR = "masked_rows", "median_error_nt"

_LINE = re.compile(r"#\s*(\w+):\s*(.*?)\s*$")


def read_grid(folder: str | os.PathLike[str], **options: Any) -> Readings:
    """Read a survey folder, such as `0_map.csv`, `90_map.csv`, `180_map.csv`, `270_map.csv`.

    Each file begins with the line `# x,y,theta,scalar_mag` and has one row per node, in any order: x and y in
    world [m], the recorded heading [rad], the total field [nT]. The file's name gives the nominal heading
    [deg], by which recorded headings in degrees are told. Further comment lines, as `write_survey` of
    `magtwin.field.survey.nodes` writes them, supply metadata that the options do not, and the rows that are
    not field.

    Options are `name`, `licence`, `created`, `height_m`, `frame`, `datum`: fields of the result.
    `headings_deg`: the headings of the survey [deg]; by default the files must be evenly spaced on the circle
    and at most 90 deg apart, so that a missing file is noticed. `unit`, or `scale`: factor from the file's
    values to nT. Readings are by heading and row, one run per file, all good except those that the files
    mark.
    """
    return read_layers(folder, **options)[1]


def read_layers(
    folder: str | os.PathLike[str],
    *,
    name: str | None = None,
    headings_deg: tuple[float, ...] | None = None,
    unit: str = "nT",
    scale: float | None = None,
    **about: Any,
) -> "tuple[list[Layer], Readings]":
    """The files of a survey folder by heading, and their readings, as for `read_grid`."""
    folder = existing(folder, "survey folder")
    if not folder.is_dir():
        raise InputError(f"{folder}: not a folder; give the one that holds 0{SUFFIX}, 90{SUFFIX}, ...")
    files: dict[float, Path] = {}
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        heading = _heading(path)
        if heading in files:
            raise InputError(f"{path}: heading {heading:g} has two files, the other is {files[heading].name}")
        files[heading] = path
    _check_headings(folder, sorted(files), headings_deg)
    layers = [_read_layer(files[heading], heading, unit, scale) for heading in sorted(files)]
    layers, notes = _in_radians(layers)
    readings = _readings(layers, folder, name, about)
    if (span := float(np.ptp(readings.p_xy, axis=0).max())) > USUAL_SPAN_M:
        notes.append(f"x and y in metres, over {span:,.0f} m: if these are cm, write them in metres")
    return layers, readings.with_(source="; ".join([readings.source, *(TAKEN + note for note in notes)]))


def degrees(heading_rad: float) -> str:
    """A heading in degrees, as in file names."""
    return np.format_float_positional(round(math.degrees(heading_rad), 9), trim="-")


def heading_doubts(readings: Readings) -> list[str]:
    """The headings of a gridded survey whose recorded headings are far from those of their nodes."""
    if readings.grid is None or readings.node is None:
        return []
    nominal = np.asarray(readings.grid.headings_rad)
    away = np.degrees(np.abs(wrap_angle(readings.yaw - nominal[readings.node[:, 0]])))
    layers = ((h, away[readings.node[:, 0] == h]) for h in range(len(nominal)))
    median = {h: float(np.median(some)) for h, some in layers if len(some)}
    far = [h for h, angle in median.items() if angle > FAR_DEG]
    if not far:
        return []
    worst = max(far, key=lambda h: median[h])
    return [
        f"{len(far)} of {len(median)} headings are recorded otherwise than their files are named: that of "
        f"{degrees(nominal[worst])} deg by {median[worst]:.0f} deg (median); the map takes the names"
    ]


def common(layers: "list[Layer]", key: str) -> Any:
    """Metadata from the files' comment lines, the same in all; "" if there is none."""
    given = [layer for layer in layers if key in layer.metadata]
    for other in given[1:]:
        if other.metadata[key] != given[0].metadata[key]:
            one, two = (repr(str(layer.metadata[key])[:QUOTED]) for layer in (other, given[0]))
            text = f"{key} is {one}, but {two} in {given[0].path.name}; they are of two maps"
            raise InputError(f"{other.path}: {text}")
    return given[0].metadata[key] if given else ""


@dataclass(frozen=True)
class Layer:
    """A file of a survey folder: readings of one heading."""

    path: Path
    heading_deg: float
    lines: NDArray[np.intp]
    x: Array
    y: Array
    theta: Array
    field: Array
    sha256: str
    metadata: dict[str, Any]  # of its comment lines, see `magtwin.field.survey.header`


def _heading(path: Path) -> float:
    text = path.name.removesuffix(SUFFIX)
    try:
        heading = float(text)
    except ValueError:
        heading = math.nan
    if not 0 <= heading < 360:
        raise InputError(f"{path}: named after its heading, 0 to 359 deg, as 90{SUFFIX}; got {text!r}")
    return heading


def _check_headings(folder: Path, found: list[float], expected: tuple[float, ...] | None) -> None:
    if not found:
        others = sorted(p.name for p in folder.iterdir())[:3]
        seen = f"it holds {', '.join(others)}" if others else "it is empty"
        raise InputError(f"{folder}: no survey file in it, such as 0{SUFFIX}; {seen}")

    def without(some: Sequence[float], others: Sequence[float]) -> list[float]:
        return [h for h in some if not any(math.isclose(h, e, abs_tol=1e-9) for e in others)]

    if expected is None:
        least = min(np.diff([*found, found[0] + 360.0]))
        count = round(360 / min(least, WIDEST_DEG))
        expected = tuple(sorted((found[0] + 360 * k / count) % 360 for k in range(count)))
        if without(found, expected):
            text = f"{folder}: headings {_degrees_of(found)} deg are not evenly spaced"
            raise InputError(f"{text}; survey the others, or name these with headings_deg")
    if missing := without(expected, found):
        names = ", ".join(f"{h:g}{SUFFIX}" for h in missing)
        text = f"heading {_degrees_of(missing)} deg missing, found {_degrees_of(found)}"
        raise InputError(f"{folder}: {text}; expected {names}")
    if beyond := without(found, expected):
        raise InputError(f"{folder}: heading {_degrees_of(beyond)} deg is not in {_degrees_of(expected)}")


def _degrees_of(headings: Sequence[float]) -> str:
    return ", ".join(f"{h:g}" for h in headings)


def _read_layer(path: Path, heading_deg: float, unit: str, scale: float | None) -> Layer:
    """The layer of a file, by its columns; every row needs all of them."""
    table = read_table(path, "layer of a survey", f"the line '# {','.join(COLUMNS)}' and a row a node")
    labels = {role: table.find(role) for role in ("x", "y", "heading", "field")}
    if not all(labels.values()):
        seen = ",".join(table.names)[:QUOTED]
        raise InputError(f"{path}: must have the columns {','.join(COLUMNS)}, got {seen!r}")
    values = {
        role: table.numbers(label, "" if role == "field" else role) for role, (label,) in labels.items()
    }
    where = table.columns[0].where
    for role, column in values.items():
        if len(lost := np.flatnonzero(~np.isfinite(column))):
            (label,), row = labels[role], int(lost[0])
            cell = str(table.column(label).cells[row]).strip()
            why = "".join(f"; {note}" for note in table.notes if "cut short" in note)
            raise InputError(f"{where(row)}: {label} is missing, got {cell!r}; every node needs it{why}")
    field = nt_per(unit, scale) * values["field"]
    if len(low := np.flatnonzero(field <= 0)):
        text = f"scalar_mag is a magnitude, above 0 nT, got {field[low[0]]:g}"
        raise InputError(f"{where(int(low[0]))}: {text}")
    metadata = _metadata(path, table.comments)
    beyond = max(metadata.get(MASKED, []), default=0)
    if beyond >= len(field):
        raise InputError(f"{path}: {MASKED} names row {beyond}, and it has {len(field)}, counted from 0")
    lines = np.array(table.columns[0].lines)
    x, y, theta = (values[role] for role in ("x", "y", "heading"))
    check_unit(field, str(path), "scalar_mag", unit, where, scale)
    return Layer(path, heading_deg, lines, x, y, theta, field, sha256(path), metadata)


def _in_radians(layers: list[Layer]) -> tuple[list[Layer], list[str]]:
    """Layers whose recorded headings are in radians, and a note if they were in degrees."""
    theta = np.concatenate([layer.theta for layer in layers])
    nominal = np.concatenate([np.full(len(s.theta), np.radians(s.heading_deg)) for s in layers])
    if np.abs(theta).max() <= LARGEST_TURN or _is_near(theta, nominal):
        return layers, []
    if _is_near(np.radians(theta), nominal):
        note = "theta in deg, by its size and the names of the files"
        return [replace(layer, theta=np.radians(layer.theta)) for layer in layers], [note]
    layer = next(s for s in layers if np.abs(s.theta).max() > LARGEST_TURN)
    row = int(np.argmax(np.abs(layer.theta) > LARGEST_TURN))
    raise InputError(
        f"{layer.path}:{layer.lines[row]}: theta {layer.theta[row]:g} is beyond a full turn in radians, and "
        f"in degrees far from the {layer.heading_deg:g} of the file's name; write it in radians"
    )


def _is_near(theta: Array, nominal: Array) -> bool:
    """Whether recorded headings are those of their files [rad]."""
    return bool(np.degrees(np.median(np.abs(wrap_angle(theta - nominal)))) < FAR_DEG)


def _readings(layers: list[Layer], folder: Path, name: str | None, about: dict[str, Any]) -> Readings:
    axes = [(_axis(s, "x", s.x), _axis(s, "y", s.y)) for s in layers]
    for layer, own in zip(layers, axes, strict=True):
        for label, first, axis in zip("xy", axes[0], own, strict=True):
            if len(first) != len(axis) or np.abs(first - axis).max() > GRAIN_M:
                own_span, span = (f"{a[0]:g}..{a[-1]:g} m in {len(a)} nodes" for a in (axis, first))
                raise InputError(
                    f"{layer.path}: its grid differs from {layers[0].path.name}'s: {label} has {own_span}, "
                    f"there {span}; survey every heading on one grid"
                )
    x, y = axes[0]
    grid = Grid(
        origin_m=(float(x[0]), float(y[0])),
        cell_m=(float((x[-1] - x[0]) / (len(x) - 1)), float((y[-1] - y[0]) / (len(y) - 1))),
        headings_rad=tuple(np.radians([s.heading_deg for s in layers]).tolist()),
        rows=len(y),
        columns=len(x),
    )
    run = np.repeat(np.arange(len(layers)), [len(s.x) for s in layers])
    good = np.concatenate([~np.isin(np.arange(len(s.x)), s.metadata.get(MASKED, [])) for s in layers])
    for key in ("licence", "created", "height_m", "frame", "datum"):
        if about.get(key) in ("", None):
            known = common(layers, key)
            about[key] = None if key == "height_m" and known == "" else known
    return Readings(
        p_xy=np.concatenate([np.column_stack([s.x, s.y]) for s in layers]),
        yaw=np.concatenate([s.theta for s in layers]),
        b_nt=np.concatenate([s.field for s in layers]),
        run=run,
        runs=tuple(s.path.name for s in layers),
        grid=grid,
        node=np.column_stack([run, np.concatenate([_nodes(s, x, y) for s in layers])]),
        good=good,
        name=(common(layers, "name") or folder.resolve().name) if name is None else name,
        source="; ".join(f"{s.path.name} sha256:{s.sha256}" for s in layers),
        **about,
    )


def _axis(layer: Layer, label: str, values: Array) -> Array:
    """The grid's coordinates along x or y, ascending and evenly spaced."""
    axis = np.sort(values)
    axis = axis[np.append(True, np.diff(axis) > GRAIN_M)]
    if len(axis) < 2:
        raise InputError(f"{layer.path}: all rows have {label} = {axis[0]:g}; a map needs two rows at least")
    steps = np.diff(axis)
    usual = float(np.median(steps))
    odd = np.flatnonzero(np.abs(steps - usual) > 2 * GRAIN_M)
    if len(odd):
        k = odd[0]
        text = f"{label} steps by {usual:g} m, but from {axis[k]:g} to {axis[k + 1]:g}"
        raise InputError(f"{layer.path}: {text}; a line of nodes is missing, or one is off the grid")
    return axis


def _nodes(layer: Layer, x: Array, y: Array) -> NDArray[np.intp]:
    """Row and column of each reading's node, shape (N, 2); refuses holes and duplicates."""
    i = np.rint((layer.x - x[0]) / (x[1] - x[0])).astype(int)
    j = np.rint((layer.y - y[0]) / (y[1] - y[0])).astype(int)
    node = j * len(x) + i
    order = np.argsort(node, kind="stable")
    twice = np.flatnonzero(np.diff(node[order]) == 0)
    if len(twice):
        former, latter = order[twice[0]], order[twice[0] + 1]
        raise InputError(
            f"{layer.path}:{layer.lines[latter]}: node ({layer.x[latter]:g}, {layer.y[latter]:g}) has a "
            f"value already, on line {layer.lines[former]}; keep one of the two"
        )
    if len(node) < len(x) * len(y):
        hole = np.setdiff1d(np.arange(len(x) * len(y)), node)
        first_j, first_i = divmod(int(hole[0]), len(x))
        raise InputError(
            f"{layer.path}: {len(hole)} of {len(x) * len(y)} nodes have no row, the first at "
            f"({x[first_i]:g}, {y[first_j]:g}); the grid must be whole"
        )
    return np.column_stack([j, i])


def _metadata(path: Path, lines: Sequence[tuple[int, str]]) -> dict[str, Any]:
    """Read the comment lines (number, text) that an import restores; others are ignored."""
    metadata: dict[str, Any] = {}
    for number, line in lines:
        match = _LINE.match(line.strip())
        if match is None or match[1] not in (*KEPT, MASKED, ERROR):
            continue
        key, text = match.groups()
        if key in metadata:
            raise InputError(f"{path}:{number}: {key} is given a second time; remove one of the two lines")
        try:
            metadata[key] = json.loads(text, parse_constant=_no_number)
        except (ValueError, RecursionError) as error:
            if key not in (*TEXTS, "method"):
                raise InputError(f"{path}:{number}: {key} must be JSON, got {text[:QUOTED]!r}") from error
            metadata[key] = text  # written by hand, without quotes
        if not _fits(key, metadata[key]):
            raise InputError(f"{path}:{number}: {key} cannot be {text[:QUOTED]!r}; correct it")
        if key == "created":
            check_day(metadata[key], f"{path}:{number}: created")
    return metadata


def _fits(key: str, value: Any) -> bool:
    if key in (*TEXTS, "method"):
        return isinstance(value, str)
    if key == "parameters":
        return isinstance(value, dict)
    if key == MASKED:
        whole = isinstance(value, list) and all(isinstance(v, int) and not isinstance(v, bool) for v in value)
        return whole and min(value, default=0) >= 0
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and 0 <= value < math.inf


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is not a JSON number")
