"""Survey folders: one CSV per heading, as the APRILab's, read as Readings and as the map of their nodes."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.grid import Grid
from magtwin.field.maps.curvature import interpolation_error_nt2
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.survey.header import ERROR, MASKED, header_lines, read_header
from magtwin.field.survey.node_errors import node_errors
from magtwin.field.survey.readings import TAKEN, Readings, taken_of
from magtwin.field.units import check_unit, nt_per
from magtwin.files.file import existing, existing_file, sha256
from magtwin.files.outputs import output
from magtwin.frames import wrap_angle
from magtwin.report.report import Figure, Report
from magtwin.tables.delimited import is_cut_short

Array = NDArray[np.float64]

COLUMNS = ("x", "y", "theta", "scalar_mag")
SUFFIX = "_map.csv"

# Widest angle between headings of a complete survey, if the caller does not give the headings
WIDEST_DEG = 90.0
GRAIN_M = 1e-6  # Coordinates closer than this are equal
# Method of a map whose values are readings
METHOD = "survey, one reading a node and heading, the robot at rest"
QUOTED = 60  # Characters of a file that an error quotes

LARGEST_TURN = 2 * np.pi + 0.01
"""Headings beyond this are no radians, unless they count turns [rad]."""

USUAL_SPAN_M = 50.0
"""Extent above which the report asks for the unit of positions whose columns name none [m]."""

FAR_DEG = 20.0
"""Median difference of recorded headings from those of their nodes at which they contradict each other."""


def read_grid(folder: str | os.PathLike[str], **options: Any) -> Readings:
    """Read a survey folder, such as `0_map.csv`, `90_map.csv`, `180_map.csv`, `270_map.csv`.

    Each file begins with the line `# x,y,theta,scalar_mag` and has one row per node, in any order: x and y in
    world [m], the recorded heading [rad], the total field [nT]. The file's name gives the nominal heading
    [deg], by which recorded headings in degrees are told. Further comment lines, as `write_survey` writes
    them, supply metadata that the options do not, and the rows that are not field.

    Args:
        folder: Folder of the files. Other files in it are ignored.
        **options: `name`, `licence`, `created`, `height_m`, `frame`, `datum`: fields of the result.
            `headings_deg`: the headings of the survey [deg]; by default the files must be evenly spaced on
            the circle and at most 90 deg apart, so that a missing file is noticed. `unit`: one of
            `magtwin.field.units.NT_PER`; or `scale`: factor from the file's values to nT.

    Returns:
        Readings by heading and row, one run per file, with `grid` and `node`. All are good except those that
        the files mark; `magtwin.field.survey.stuck` finds others.

    Raises:
        InputError: A file or heading is missing, a row or value is invalid, the grid has a hole or a
            duplicate node, the headings' grids differ, or the unit is wrong; with file and line.
    """
    return _opened(folder, **options)[1]


def _opened(
    folder: str | os.PathLike[str],
    *,
    name: str | None = None,
    headings_deg: tuple[float, ...] | None = None,
    unit: str = "nT",
    scale: float | None = None,
    **about: Any,
) -> "tuple[list[_Layer], Readings]":
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
        f"{_degrees(nominal[worst])} deg by {median[worst]:.0f} deg (median); the map takes the names"
    ]


def node_map(readings: Readings) -> AnomalyMap:
    """The map whose values are the readings themselves, each at its node.

    Args:
        readings: A gridded survey. Several good readings at one node are averaged.

    Returns:
        The map on the survey's grid. Nodes without a good reading are not valid; their value is the mean of
        the others, or nan. The variance is estimated from the survey (`magtwin.field.survey.node_errors`); it
        is None for a survey of one heading.

    Raises:
        InputError: The readings are not gridded.
    """
    if readings.grid is None or readings.node is None:
        raise InputError(
            f"survey {readings.name!r} is not gridded, so that its nodes make no map; "
            "fit a model to it (magtwin.field.fit.fit, `magtwin map fit`)"
        )
    grid = readings.grid
    flat = np.ravel_multi_index(tuple(readings.node.T), grid.shape)
    size = int(np.prod(grid.shape))
    means, counts = [], []
    for rows in (readings.good, ~readings.good):
        count = np.bincount(flat[rows], minlength=size)
        total = np.bincount(flat[rows], weights=readings.b_nt[rows], minlength=size)
        counts.append(np.maximum(count, 1).reshape(grid.shape))
        means.append(np.divide(total, count, out=np.full(size, np.nan), where=count > 0))
    recorded = None
    if len(flat) == size == len(np.unique(flat)):  # every node has exactly one reading
        recorded = readings.yaw[np.argsort(flat)].reshape(grid.shape)
    valid = np.isfinite(means[0])
    values, known = np.where(valid, *means).reshape(grid.shape), valid.reshape(grid.shape)
    errors = node_errors(readings, grid, means[0].reshape(grid.shape), known)
    variance = between = None
    if errors.estimated:
        variance = errors.variance_nt2 / counts[0]
        between = interpolation_error_nt2(values, known, grid.headings_rad, variance)
    return AnomalyMap(
        values_nt=values,
        valid=known,
        variance_nt2=variance,
        between_nt2=between,
        recorded_yaw=recorded,
        origin_m=grid.origin_m,
        cell_m=grid.cell_m,
        headings_rad=np.asarray(grid.headings_rad),
        method=METHOD,
        **readings.about,
    )


def write_survey(field: AnomalyMap, folder: str | os.PathLike[str], *, force: bool = False) -> list[Path]:
    """Write a map as a survey folder, one CSV per heading, for `read_survey`.

    Comment lines hold the metadata, statistics and masked rows. Below them is one row per node, x fastest: x
    and y in world [m], the recorded heading, else the nominal one [rad], and the field [nT], all without
    rounding. So the CSVs of a survey are restored from its map row by row.

    Args:
        field: The map. Of its variance only the median per heading is kept, and no harmonic field.
        folder: Folder to create.
        force: Whether to replace an existing one.

    Returns:
        The files, one per heading.

    Raises:
        InputError: A node has no value, or the folder exists and `force` is not set.
    """
    lost = int(np.count_nonzero(~np.isfinite(field.values_nt)))
    if lost:
        raise InputError(
            f"map {field.name!r} has no value at {lost} of its nodes, and a survey's CSV has one at each; "
            "`magtwin map fit` fills them in"
        )
    names = [f"{_degrees(heading)}{SUFFIX}" for heading in field.headings_rad]
    with output(folder, force=force) as aside:
        aside.mkdir()
        x, y = np.meshgrid(field.x_m, field.y_m)
        for h, name in enumerate(names):
            yaw = np.full(x.shape, field.headings_rad[h])
            if field.recorded_yaw is not None:
                yaw = field.recorded_yaw[h]
            rows = np.stack([x, y, yaw, field.values_nt[h]], axis=-1).reshape(-1, len(COLUMNS)).tolist()
            header = [f"# {','.join(COLUMNS)}", *header_lines(field, h)]
            lines = [*header, *(",".join(map(repr, row)) for row in rows)]
            (aside / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return [Path(folder, name) for name in names]


def _degrees(heading_rad: float) -> str:
    """A heading in degrees, as in file names."""
    return np.format_float_positional(round(math.degrees(heading_rad), 9), trim="-")


def read_survey(
    folder: str | os.PathLike[str], *, keep_stuck: bool = False, **options: Any
) -> tuple[AnomalyMap, Report]:
    """The map of a survey folder's nodes, and its report.

    Args:
        folder: A survey folder. This and the options are those of `read_grid`.
        keep_stuck: Whether readings of a stuck sensor stay valid nodes.
        **options: Metadata, headings and unit.

    Returns:
        The map, in which stuck nodes are not valid (`magtwin.field.survey.stuck`). A fitted map from
        `write_survey` is restored as it was, except that its variance is uniform per heading and its harmonic
        field is lost. And the report: statistics of the map, deviation of recorded from nominal headings,
        repeated readings, and what was found stuck or outlying.

    Raises:
        InputError: As `read_grid`, with file and line; or no reading is field.
    """
    from magtwin.field.survey.stuck import mask_stuck

    layers, readings = _opened(folder, **options)
    parameters = _common(layers, "parameters") or {}
    if (method := _common(layers, "method")) not in ("", METHOD):  # fitted before it was written
        field = node_map(readings)
        sd = np.square([layer.metadata.get(ERROR, math.nan) for layer in layers])
        variance = np.broadcast_to(sd[:, None, None], field.grid.shape) if np.isfinite(sd).all() else None
        about: dict[str, Any] = {"method": method, "parameters": parameters}
        field = replace(field, variance_nt2=variance, between_nt2=None, recorded_yaw=None, **about)
        return field, _report(layers, readings, field, folder, Report(""))
    masked, findings = mask_stuck(readings)
    if not (keep_stuck or masked.good.any()):
        raise InputError(
            f"{folder}: all {len(readings)} readings are those of a sensor that was stuck; "
            "survey it again, or import them as they are with `keep_stuck=True`"
        )
    field = replace(node_map(readings if keep_stuck else masked), parameters=parameters)
    return field, _report(layers, readings, field, folder, findings)


def _common(layers: "list[_Layer]", key: str) -> Any:
    """Metadata from the files' comment lines, the same in all; "" if there is none."""
    given = [layer for layer in layers if key in layer.metadata]
    for other in given[1:]:
        if other.metadata[key] != given[0].metadata[key]:
            raise InputError(
                f"{other.path}: {key} is {str(other.metadata[key])[:QUOTED]!r}, but "
                f"{str(given[0].metadata[key])[:QUOTED]!r} in {given[0].path.name}; they are of two maps"
            )
    return given[0].metadata[key] if given else ""


@dataclass(frozen=True)
class _Layer:
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
        raise InputError(
            f"{path}: a survey file is named after its heading, 0 to 359 deg, as 90{SUFFIX}; got {text!r}"
        )
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
            raise InputError(
                f"{folder}: headings {_degrees_of(found)} deg are not evenly spaced; "
                "survey the missing ones, or name those that there are with headings_deg"
            )
    if missing := without(expected, found):
        raise InputError(
            f"{folder}: heading {_degrees_of(missing)} deg missing, found {_degrees_of(found)}; "
            f"expected {', '.join(f'{h:g}{SUFFIX}' for h in missing)}"
        )
    if beyond := without(found, expected):
        raise InputError(
            f"{folder}: heading {_degrees_of(beyond)} deg is not among the expected {_degrees_of(expected)}"
        )


def _degrees_of(headings: Sequence[float]) -> str:
    return ", ".join(f"{h:g}" for h in headings)


def _read_layer(path: Path, heading_deg: float, unit: str, scale: float | None) -> _Layer:
    try:
        text = existing_file(path, "layer of a survey", "text").read_text(encoding="utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(f"{path}: not a text file ({error}); a survey is CSV in UTF-8") from error
    if not text.strip():
        raise InputError(f"{path}: empty; expected the line '# {','.join(COLUMNS)}' and a row a node")
    first, *rest = text.splitlines()
    if tuple(word.strip() for word in first.lstrip("#").split(",")) != COLUMNS:
        raise InputError(f"{path}:1: must be the header '# {','.join(COLUMNS)}', got {first[:QUOTED]!r}")
    numbered = [(number, line) for number, line in enumerate(rest, 2) if line.strip()]
    metadata = read_header(path, [row for row in numbered if row[1].startswith("#")])
    lines = [row for row in numbered if not row[1].startswith("#")]
    if not lines:
        raise InputError(f"{path}: no rows below the header; expected one a node")
    last = [line.rpartition(",")[2].strip() for _, line in lines]
    if not text.endswith("\n") and is_cut_short(last):
        raise InputError(
            f"{path}:{lines[-1][0]}: cut short: the line has no end, and its {last[-1]} is far below all "
            "other values; copy the file again"
        )
    x, y, theta, field = np.array([_row(path, number, line) for number, line in lines]).T
    field = nt_per(unit, scale) * field
    beyond = max(metadata.get(MASKED, []), default=0)
    if beyond >= len(x):
        raise InputError(f"{path}: {MASKED} names row {beyond}, and it has {len(x)}, counted from 0")
    layer = _Layer(
        path, heading_deg, np.array([n for n, _ in lines]), x, y, theta, field, sha256(path), metadata
    )
    check_unit(field, str(path), "scalar_mag", unit, lambda k: f"{path}:{layer.lines[k]}", scale)
    return layer


def _in_radians(layers: list[_Layer]) -> tuple[list[_Layer], list[str]]:
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


def _row(path: Path, number: int, line: str) -> list[float]:
    words, where = line.split(","), f"{path}:{number}"
    if len(words) != len(COLUMNS):
        columns = f"{len(COLUMNS)} values expected ({', '.join(COLUMNS)})"
        raise InputError(f"{where}: {columns}, got {len(words)}")
    values = []
    for column, word in zip(COLUMNS, words, strict=True):
        try:
            value = float(word)
        except ValueError:
            quoted = word.strip()[:QUOTED]
            raise InputError(f"{where}: {column} must be a number, got {quoted!r}") from None
        if not math.isfinite(value):
            text = "every node needs a finite value, measure it again"
            raise InputError(f"{where}: {column} is {value}; {text}")
        values.append(value)
    if values[3] <= 0:
        raise InputError(f"{where}: scalar_mag is a magnitude, above 0 nT, got {values[3]:g}")
    return values


def _readings(layers: list[_Layer], folder: Path, name: str | None, about: dict[str, Any]) -> Readings:
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
            known = _common(layers, key)
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
        name=(_common(layers, "name") or folder.resolve().name) if name is None else name,
        source="; ".join(f"{s.path.name} sha256:{s.sha256}" for s in layers),
        **about,
    )


def _report(
    layers: list[_Layer],
    readings: Readings,
    field: AnomalyMap,
    folder: str | os.PathLike[str],
    findings: Report,
) -> Report:
    """Statistics of the survey, and how well its headings were kept."""
    deviation = [np.degrees(np.abs(wrap_angle(s.theta - np.radians(s.heading_deg)))) for s in layers]
    worst = max(range(len(layers)), key=lambda k: deviation[k].max())
    row = int(deviation[worst].argmax())
    layer = layers[worst]
    where = f"{layer.path.name}:{layer.lines[row]}, at ({layer.x[row]:g}, {layer.y[row]:g}) m"
    repeated = int(np.count_nonzero(np.diff(field.values_nt, axis=2) == 0))
    every = np.concatenate(deviation)
    figures = (
        *field.report().figures,
        Figure("median heading deviation", round(float(np.median(every)), 3), "deg"),
        Figure("largest heading deviation", round(float(every.max()), 3), "deg", note=where),
        Figure("repeated readings", repeated, note="equal to the one before in the row to the last digit"),
        *findings.figures,
    )
    metadata: dict[str, Any] = {"files": {s.path.name: s.sha256 for s in layers}, **findings.metadata}
    metadata |= {"taken": taken} if (taken := taken_of(readings)) else {}
    metadata |= {"doubts": doubts} if (doubts := heading_doubts(readings)) else {}
    return Report(f"survey {folder}", figures, metadata)


def _axis(layer: _Layer, label: str, values: Array) -> Array:
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
        raise InputError(
            f"{layer.path}: {label} steps by {usual:g} m, but from {axis[k]:g} to {axis[k + 1]:g}; "
            "a line of nodes is missing, or one lies off the grid"
        )
    return axis


def _nodes(layer: _Layer, x: Array, y: Array) -> NDArray[np.intp]:
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
