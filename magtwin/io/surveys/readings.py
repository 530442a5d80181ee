"""Readings from files: gridded surveys, tables, runs and bags; and Readings saved as Parquet."""

import json
import os
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, replace
from glob import has_magic
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, hint
from magtwin.field.grid import FARTHEST_M, Grid
from magtwin.field.survey.folder import LARGEST_TURN, USUAL_SPAN_M, read_grid
from magtwin.field.survey.readings import SHAPES, TAKEN, Readings
from magtwin.field.units import check_unit, nt_per, unit_by_size
from magtwin.files.file import existing, sha256
from magtwin.files.kinds import RUN, expected, kind_of
from magtwin.files.outputs import output
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate, yaw_from_quat
from magtwin.io.surveys.columns import (
    ANGLE_UNITS,
    FIELD_UNITS,
    FIELDS,
    HEADINGS,
    NO_HEADING,
    POSITIONS,
    TIME_UNITS,
    TIMES,
    VECTORS,
    Columns,
    named,
)
from magtwin.io.surveys.table import Table, read_csv, read_parquet_table
from magtwin.io.tables import load_parquet, read_npz, read_parquet
from magtwin.io.tables import read_csv as read_csv_run
from magtwin.path.points import ANGLES
from magtwin.run.arrow import FACTS
from magtwin.run.run import Run
from magtwin.tables.delimited import DEGREES, LENGTHS

Array = NDArray[np.float64]
Source = str | os.PathLike[str]

BAGS = (".mcap", ".db3")
"""Suffixes of rosbag2 storage files."""

PARQUET = (".parquet", ".pq")

RUNS = (".csv", ".npz", ".rrd")
"""Suffixes of runs in other formats of magtwin's own."""

LEAST_SPAN_M = 0.01
"""Extent below which the report asks whether positions are in degrees [m]."""

EPOCHS = ((1e17, 1e9, "ns"), (1e14, 1e6, "us"), (1e11, 1e3, "ms"))
"""Least median of times since 1970, ticks per second and unit; below them are seconds."""

APART = 2.0
"""Largest median ratio between vectors and magnitudes of the same table."""

SAME_LENGTH = 0.01
"""Largest median difference of x, y, z from the magnitude by which they are its components."""

TURNED = 0.7
"""Length of the mean unit vector of the headings above which a survey hardly turned."""

ALIGNED = 0.8
"""Ratio of the mean level field to its size above which it keeps one direction."""

CLEARLY = 0.3
"""Difference of these ratios from which headings or vectors are mirrored. Hard iron does not look so."""

_SURVEY = b"magtwin_readings"
_PARTS = {"p_xy": ("x", "y"), "b_body_nt": ("x", "y", "z"), "node": ("heading", "row", "column")}
_UNITS = {"p_xy": "m", "yaw": "rad", "b_nt": "nT", "b_body_nt": "nT", "t": "s", "good": "bool"}
_FRAMES = {"p_xy": "world", "yaw": "world", "b_body_nt": "base_link"}
_TEXTS = ("name", "source", "licence", "created")
_PLACES = ("frame", "datum")


def read_readings(
    *sources: Source,
    columns: Columns | None = None,
    headings_deg: tuple[float, ...] | None = None,
    pose_topic: str | None = None,
    field_topic: str | None = None,
    **about: Any,
) -> Readings:
    """Read the readings of a survey from any supported source.

    A source is a folder of one CSV per heading (`magtwin.field.survey.folder`); a table of readings, CSV or
    Parquet; several files with matching rows, joined by `+` (`1-time.csv+1-loc.csv+1-mag.csv`; the others are
    searched for beside the first); the Parquet of a Run or of Readings; or a rosbag2, as a folder or a
    storage file. Several sources are several runs of one survey, as are the files of a pattern
    (`drives/*.parquet`) and the Parquet files of a folder, in the order of their names.

    Args:
        sources: One or more sources.
        columns: Meaning and units of the columns of a table.
        headings_deg: Headings of a folder of CSVs [deg], if it is incomplete.
        pose_topic: Topic of a bag's poses, if there are several.
        field_topic: Topic of a bag's field, if there are several.
        about: Metadata that replace those of the sources, unless None or "": `name`, `licence`, `created`,
            `height_m` [m], `frame` and `datum`, as in `magtwin.io.surveys.about.About`.

    Returns:
        Readings in the order of the sources. Rows with a cell that is empty or nan are left out; `source` has
        their number.

    Raises:
        InputError: A source is missing, damaged or unknown; no file matches a pattern; a column is missing
            (the message has the nearest name); a cell is not a number (with file and line); or no unit fits.
    """
    columns = Columns() if columns is None else columns
    if not sources:
        raise InputError("no source of readings given")
    parts, given, twice = [], dict[str, Source](), list[str]()
    for source in _each(sources):
        path = _first(source)
        same = given.setdefault(_identity(source), source)
        if same is not source:
            twice.append(f"{source} and {same} as one, since their bytes are equal")
            continue
        if path.is_dir() or path.suffix.lower() in BAGS:
            _only_unit(path, columns)
        if path.suffix.lower() in BAGS or (path.is_dir() and (path / "metadata.yaml").is_file()):
            from magtwin.io.bags import read_bag
            from magtwin.io.bags.topics import MAGNITUDE, POSE

            topics = {POSE.name: pose_topic, MAGNITUDE.name: field_topic}
            named = {ours: theirs for ours, theirs in topics.items() if theirs}
            run = read_bag(path, topics=named, unit=columns.unit, scale=columns.scale, survey=True)
            parts.append(readings_of_run(run, name=path.stem, source=_sum(path)))
        elif path.is_dir():
            unit = columns.unit or "nT"
            parts.append(read_grid(path, headings_deg=headings_deg, unit=unit, scale=columns.scale))
        else:
            parts.append(_of_file(str(source), path, columns))
    readings = parts[0] if len(parts) == 1 else _together(parts)
    if twice:
        readings = readings.with_(source="; ".join([readings.source, *(TAKEN + text for text in twice)]))
    return readings.with_(**{key: value for key, value in about.items() if value not in (None, "")})


def readings_of_run(run: Run, *, name: str = "", source: str = "") -> Readings:
    """The readings of a Run: its measured field at the true pose of base_link.

    Rows whose field is nan (outside the map) are left out; rows with lost lock are not good. Of a robot's
    recording, rows between whose poses there is a gap are left out too, and vectors are read.

    Args:
        run: A run with p_world_base, yaw and b_measured_nt, or b_total_nt.
        name: Name of the readings.
        source: Source of the run.

    Raises:
        InputError: A column is missing, or no row has a field.
    """
    field = next((c for c in ("b_measured_nt", "b_total_nt") if c in run and np.isfinite(run[c]).any()), None)
    if field is None:
        raise InputError(
            f"{source or 'run'}: b_measured_nt and b_total_nt hold no field, only nan or nothing"
        )
    b, p, yaw, t = run[field], run["p_world_base"], run["yaw"], run["t"]
    known = np.isfinite(b) & np.isfinite(p).all(axis=1) & np.isfinite(yaw) & np.isfinite(t)
    lost = run["flag_lost_lock"] if "flag_lost_lock" in run else np.zeros(len(b), bool)
    body, about = None, ""
    if "bag" in run.metadata:
        known &= ~run["flag_pose_lost"]
        about = _recorded(run)
        if "b_vector_measured_nt" in run:
            vector = levelled(run["b_vector_measured_nt"], run["q_world_base_xyzw"], "body")
            known &= np.isfinite(vector).all(axis=1)
            body = vector[known]
    return Readings(
        p_xy=p[known, :2],
        yaw=yaw[known],
        b_nt=b[known],
        b_body_nt=body,
        t=t[known],
        good=~lost[known],
        runs=(name,),
        name=name,
        source=source + _left_out(known) + about,
    )


def save_readings(readings: Readings, path: Source, *, force: bool = False) -> None:
    """Write readings as Parquet; the same readings give the same bytes.

    Arrow fields have unit and frame as metadata. The metadata `magtwin_readings` of the file hold, as JSON,
    the runs, the grid, the height and the source.

    Args:
        readings: The readings.
        path: The file to make.
        force: Replace an existing file.

    Raises:
        InputError: The file exists and `force` is not set.
    """
    fields, arrays = [], []
    for key, (width, _) in SHAPES.items():
        values = getattr(readings, key)
        if values is None:
            continue
        for i, part in enumerate(_PARTS[key] if width else ("",)):
            array = pa.array(np.ascontiguousarray(values[:, i] if width else values))
            texts = {"column": key, "part": part, "unit": _UNITS.get(key, ""), "frame": _FRAMES.get(key, "")}
            texts = {k: text for k, text in texts.items() if text}
            label = f"{key}_{part}" if part else key
            fields.append(pa.field(label, array.type, nullable=False, metadata=texts))
            arrays.append(array)
    about: dict[str, Any] = {key: getattr(readings, key) for key in (*_TEXTS, *_PLACES)}
    about |= {"runs": readings.runs, "height_m": readings.height_m, "earth_nt": readings.earth_nt}
    about["grid"] = None if readings.grid is None else asdict(readings.grid)
    schema = pa.schema(fields, metadata={_SURVEY: json.dumps(about, ensure_ascii=False)})
    split = {f.name: "BYTE_STREAM_SPLIT" for f in fields if pa.types.is_floating(f.type)}
    table = pa.Table.from_arrays(arrays, schema=schema)
    with output(path, force=force) as aside:
        pq.write_table(table, aside, compression="zstd", use_dictionary=False, column_encoding=split)


def load_readings(path: Source) -> Readings:
    """Read readings that `save_readings` wrote, to the last bit.

    Raises:
        InputError: The file is missing, is not Parquet, is truncated, or holds no Readings.
    """
    path = existing(path, "Parquet file")
    table, metadata = read_parquet_table(path), _metadata(path)
    if _SURVEY not in metadata:
        raise InputError(f"{path}: no Readings: metadata {_SURVEY.decode()!r} is missing")
    try:
        about = json.loads(metadata[_SURVEY])
        grid = (
            about["grid"]
            and Grid(**{**about["grid"], "headings_rad": tuple(about["grid"]["headings_rad"])}).in_memory()
        )
        given = {key: about[key] for key in (*_TEXTS, "height_m")} | {"runs": tuple(about["runs"])}
        given |= {key: about.get(key, "") for key in _PLACES} | {"earth_nt": about.get("earth_nt")}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, InputError):
            raise InputError(f"{path}: {error}") from error
        raise InputError(
            f"{path}: metadata {_SURVEY.decode()!r} is damaged ({type(error).__name__}: {error})"
        ) from error
    names = set(table.names)
    arrays: dict[str, ArrayLike] = {}
    for key, (width, kind) in SHAPES.items():
        labels = [f"{key}_{part}" for part in _PARTS[key]] if width else [key]
        if names.isdisjoint(labels) and key in ("b_body_nt", "t", "node"):
            continue
        cells: list[NDArray[Any]] = [table.numbers(label).astype(kind) for label in labels]
        arrays[key] = np.column_stack(cells) if width else cells[0]
    try:
        return Readings(**arrays, grid=grid or None, **given)  # type: ignore[arg-type]
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def is_pattern(source: Source) -> bool:
    """Whether a source is a pattern, and not a file with such a name."""
    return has_magic(str(source)) and not Path(source).exists()


def _each(sources: Sequence[Source]) -> Iterator[Source]:
    """The sources, with patterns and folders of Parquet files replaced by their files."""
    for source in sources:
        path = Path(source)
        if is_pattern(source):
            root = Path(path.anchor)
            files = root.glob(str(path.relative_to(path.anchor)))
            matches = sorted(match for match in files if not match.name.startswith("."))
            if not matches:
                raise InputError(f"no file or folder matches {str(source)!r}; check the pattern")
            yield from matches
        elif path.is_dir() and not (path / "metadata.yaml").is_file():
            yield from sorted(file for file in path.iterdir() if file.suffix.lower() in PARQUET) or [path]
        else:
            yield source


def _first(source: Source) -> Path:
    """The path of a source, or of the first of its joined files."""
    path = Path(source)
    if path.exists() or "+" not in str(source):
        return expected(path, "source of readings")
    return expected(Path(str(source).split("+")[0]), "source of readings")


def _identity(source: Source) -> str:
    """The checksum of a file; the place of a folder, or of joined files."""
    path = Path(source)
    return sha256(path) if path.is_file() else str(path.resolve())


def _only_unit(path: Path, columns: Columns) -> None:
    """Refuse options for columns of a source whose columns are known."""
    if replace(columns, unit=None, scale=None) != Columns():
        raise InputError(f"{path}: its columns are known; drop the options that name columns")


def _of_file(source: str, path: Path, columns: Columns) -> Readings:
    if path.suffix.lower() in (".usd", ".usda", ".usdc"):
        raise InputError(
            f"{path}: a stage or a map, not readings; give the survey of the map, or survey a scene "
            " (magtwin map survey)"
        )
    if path.suffix.lower() in PARQUET and path == Path(source):
        metadata = _metadata(path)
        if _SURVEY in metadata or FACTS in metadata:
            _only_unit(path, columns)
            if columns.scale is not None:
                raise InputError(f"{path}: its field is in nT already; leave out --scale")
            if _SURVEY in metadata:
                return load_readings(path)
            return readings_of_run(read_parquet(path), name=path.stem, source=_sum(path))
    if path == Path(source) and path.suffix.lower() in RUNS and kind_of(path) is RUN:
        _only_unit(path, columns)
        if columns.scale is not None:
            raise InputError(f"{path}: its field is in nT already; leave out --scale")
        return readings_of_run(_run_of(path), name=path.stem, source=_sum(path))
    paths = [path]
    if path != Path(source):
        paths += [_beside(path, word) for word in source.split("+")[1:]]
    table = _read_table(paths[0])
    for other in paths[1:]:
        table = table.beside(_read_table(other))
    return _of_table(table, paths, columns)


def _run_of(path: Path) -> Run:
    """The run in a file of magtwin's own."""
    if path.suffix.lower() != ".rrd":
        return read_csv_run(path) if path.suffix.lower() == ".csv" else read_npz(path)
    from magtwin.io.rerun.file import read_run  # imports rerun

    return read_run(path)


def _beside(first: Path, word: str) -> Path:
    """A joined file: beside the first one, or at its path."""
    beside = first.parent / word
    return existing(beside if beside.exists() or not Path(word).exists() else Path(word), "file of readings")


def _read_table(path: Path) -> Table:
    return read_parquet_table(path) if path.suffix.lower() in PARQUET else read_csv(path)


def _of_table(table: Table, paths: list[Path], columns: Columns) -> Readings:
    """The readings in a table."""
    asked, one_unit = bool(columns.time), columns.unit is not None or columns.scale is not None
    columns, taken = _complete(table, columns)
    p = np.column_stack([_lengths(table, columns.x), _lengths(table, columns.y)])
    turn = _turn(table, columns)
    vector, b = _field(table, columns)
    if turn is None and columns.heading == NO_HEADING and vector is not None and columns.axes != "world":
        vector = None
        taken.append(
            f"the magnitude of {columns.vector}, since a sensor carried by hand has no heading"
            if not columns.field
            else f"{columns.field} without {columns.vector}, since a sensor carried by hand has no heading"
        )
    t = None
    if columns.time:
        try:
            t = _times(table, columns.time, taken)
        except InputError as error:
            if asked:
                raise
            taken.append(f"no times: {error}")
    some = [p, b[:, None]] + [v.reshape(len(p), -1) for v in (turn, vector, t) if v is not None]
    known: NDArray[np.bool_] = np.all(np.isfinite(np.hstack(some)), axis=1)
    if not known.any():
        raise InputError(
            f"{table.path}: no row is complete; all {len(known)} have a cell that is empty or nan"
        )
    away = np.flatnonzero(known & (np.abs(p) > FARTHEST_M).any(axis=1))
    if len(away):
        row = int(away[0])
        where = table.column(columns.x).where(row)
        raise InputError(f"{where}: x and y are metres, within {FARTHEST_M:g} of the origin, got {p[row]}")
    if not any(named(_label(table, name), LENGTHS)[1] for name in (columns.x, columns.y)):
        span = float(np.ptp(p[known], axis=0).max())
        if span > USUAL_SPAN_M:
            taken.append(
                f"x and y in metres, over {span:,.0f} m: if these are cm, write x [cm],y [cm] in the header"
            )
        elif 0 < span < LEAST_SPAN_M and np.abs(p[known]).max() > 1:
            taken.append(
                f"x and y in metres, over {1e3 * span:.3g} mm only: if these are degrees, convert them to "
                "metres"
            )
    if turn is not None and turn.ndim == 2:
        length = np.linalg.norm(turn, axis=1)
        off = np.flatnonzero(known & (np.abs(length - 1) > 0.01))
        if len(off):
            where = table.column(columns.several("quaternion")[0]).where(int(off[0]))
            raise InputError(f"{where}: a quaternion's length is 1, got {length[off[0]]:.4g}")
        turn = turn / length[:, None]
    elif turn is None:
        if columns.heading != NO_HEADING if vector is None else columns.axes != "world":
            none = "if the sensor was carried by hand, give --heading none"
            if vector is not None:
                none += "; vectors in world axes need none (--axes world)"
            raise InputError(
                f"{table.path}: no heading: no column is called {', '.join(HEADINGS)}; name it with "
                f"--heading or --quaternion; {none}"
            )
        turn = np.zeros(len(p))
    yaw = turn if turn.ndim == 1 else yaw_from_quat(turn)
    magnitude = table.column(columns.field or columns.several("vector")[0])
    zero = np.flatnonzero(known & (b <= 0))
    if len(zero):
        raise InputError(f"{magnitude.where(int(zero[0]))}: a magnitude is above 0, got {b[zero[0]]:g} nT")
    warning = check_unit(
        b[known],
        str(table.path),
        magnitude.name or columns.field or columns.vector,
        columns.unit or "nT",
        lambda k: magnitude.where(int(np.flatnonzero(known)[k])),
        columns.scale,
        told=columns.unit is not None or columns.scale is not None,
        p_xy=None if one_unit else p[known],
    )
    taken += [warning] if warning else []
    if vector is not None:
        ratio = float(np.median(np.linalg.norm(vector[known], axis=1) / b[known]))
        if not 1 / APART <= ratio <= APART:
            raise InputError(
                f"{table.path}: {columns.vector} is {ratio:.3g} times as long as {columns.field} (median); "
                "give both in one unit, and the components of the whole field"
            )
        _check_axes(vector[known], turn[known], table, columns)
    run, runs = _runs(table, columns, paths[0].stem, known)
    notes = [f"; {TAKEN}{note.replace('; ', ', ')}" for note in taken]  # "; " separates them
    return Readings(
        p_xy=p[known],
        yaw=yaw[known],
        b_nt=b[known],
        b_body_nt=None if vector is None else levelled(vector, turn, columns.axes or "body")[known],
        t=None if t is None else t[known],
        run=run,
        runs=runs,
        name=paths[0].stem,
        source="; ".join(map(_sum, paths)) + _left_out(known) + "".join(notes),
    )


def _complete(table: Table, columns: Columns) -> tuple[Columns, list[str]]:
    """Columns and unit, with missing ones found by name and size; and what was found so."""
    taken = list(table.notes)
    columns = _placed(table, columns, taken)
    if not (columns.heading or columns.quaternion):
        columns = replace(columns, heading=_found(table, HEADINGS, ANGLE_UNITS))
    if columns.quaternion:
        columns = _in_order(table, columns, taken)
    if not columns.time:
        columns = replace(columns, time=_found(table, TIMES, TIME_UNITS))
    if not columns.field and not columns.vector:
        if label := _found(table, FIELDS, FIELD_UNITS):
            columns = replace(columns, field=label)
        elif three := _components(table):
            columns = replace(columns, vector=",".join(three))
            if columns.axes is None and columns.heading != NO_HEADING:
                taken.append(f"{columns.vector} as the field in the robot's axes, forward, left, up (--axes)")
        else:
            labels = ", ".join(label for label in table.names if not label.isdigit())
            count = len(table.columns)
            seen = f"columns: {labels}" if labels else f"no header: name columns by number, 1 to {count}"
            raise InputError(
                f"{table.path}: no column of the field was found by its name ({seen}); name the magnitude "
                "with --field NAME, or the components with --vector BX,BY,BZ"
            )
    _check_roles(table, columns)
    lengths = {named(_label(table, name), LENGTHS)[1] for name in (columns.x, columns.y)} - {"", "m"}
    if lengths:
        taken.append(f"{columns.x} and {columns.y} by the units in their names")
    has_heading = columns.heading not in ("", NO_HEADING)
    angle = _unit(table, columns.heading, ANGLE_UNITS) if has_heading else ""
    if columns.heading_unit is None and angle in ANGLE_UNITS:
        columns = replace(columns, heading_unit="deg" if angle in DEGREES else "rad")
        taken.append(f"{columns.heading} in {columns.heading_unit}, by its name (--heading-unit)")
    if columns.unit is None and columns.scale is None:
        parts = [columns.field] if columns.field else columns.several("vector")
        known = (FIELD_UNITS.get(_unit(table, part, FIELD_UNITS)) for part in parts)
        units = {unit for unit in known if unit}
        if len(units) > 1:
            raise InputError(f"{table.path}: the units of {columns.vector} differ; give all in one unit")
        if units:
            return replace(columns, unit=units.pop()), taken
        _, b = _field(table, replace(columns, unit="nT"))
        unit = unit_by_size(b)
        if unit not in (None, "nT"):
            columns = replace(columns, unit=unit)
            taken.append(f"{columns.field or columns.vector} in {unit}, by its size (--unit)")
    return columns, taken


def _label(table: Table, name: str) -> str:
    """The header of a column, which may be named by its number."""
    return table.column(name).name or name


def _unit(table: Table, name: str, units: Collection[str]) -> str:
    """The unit in the header of a column, in lower case; "" if there is none."""
    return named(_label(table, name), units)[1]


def _found(table: Table, names: Sequence[str], units: Collection[str]) -> str:
    """The first column with one of the names, whose unit is not of another kind; "" if there is none."""
    others = {*LENGTHS, *ANGLE_UNITS, *FIELD_UNITS, *TIME_UNITS}.difference(units)
    exact, whole, bare = {label: label for label in table.names}, dict[str, str](), dict[str, str]()
    for label in table.names:
        for labels, behind in ((whole, ()), (bare, units)):
            name, unit = named(label, behind)
            if unit not in others:
                labels.setdefault(name, label)
    return next((labels[name] for name in names for labels in (exact, whole, bare) if name in labels), "")


def _components(table: Table) -> list[str]:
    """The columns of a vector, found by name; [] if there are none."""
    for names in VECTORS:
        if all(three := [_found(table, (name,), FIELD_UNITS) for name in names]):
            return three
    plain = [_found(table, (name,), FIELD_UNITS) for name in "xyz"]
    return plain if all(name and _unit(table, name, FIELD_UNITS) in FIELD_UNITS for name in plain) else []


def _placed(table: Table, columns: Columns, taken: list[str]) -> Columns:
    """Columns with those of x and y found by name; refuses latitude and longitude."""
    used = {columns.field, *columns.several("vector")}
    if (columns.x, columns.y) == ("x", "y"):
        for names in POSITIONS:
            x, y = (_found(table, (name,), LENGTHS) for name in names)
            if x and y and not used & {x, y}:
                columns = replace(columns, x=x, y=y)
                if names != POSITIONS[0]:
                    taken.append(f"{x} and {y} as x and y (--x, --y)")
                break
        else:
            on_earth = [label for label in table.names if _is_on_earth(label)]
            if len(on_earth) > 1 and not _found(table, ("x", "y"), LENGTHS):
                raise _no_metres(table, on_earth[:2])
    for axis in ("x", "y"):
        if getattr(columns, axis) == axis:
            columns = replace(columns, **{axis: _found(table, (axis,), LENGTHS) or axis})  # type: ignore[arg-type]
    labels = [_label(table, columns.x), _label(table, columns.y)]
    if any(map(_is_on_earth, labels)):
        raise _no_metres(table, labels)
    return columns


def _is_on_earth(label: str) -> bool:
    """Whether a header is that of a latitude or longitude."""
    name, unit = named(label, ANGLE_UNITS)
    last = name.rpartition("_")[2]
    return name in ANGLES or (last in ANGLES and last != "long") or (name in ("x", "y") and unit in DEGREES)


def _no_metres(table: Table, labels: Sequence[str]) -> InputError:
    shown = " and ".join(repr(label) for label in labels)
    return InputError(
        f"{table.path}: {shown} are latitude and longitude; give x,y in metres in the axes of the lab"
    )


def _in_order(table: Table, columns: Columns, taken: list[str]) -> Columns:
    """Columns whose quaternion is xyzw, if its names end in these letters."""
    given = columns.several("quaternion")
    by_letter = {named(_label(table, name), ())[0][-1:]: name for name in given}
    if set(by_letter) != set("xyzw") or list(by_letter) == list("xyzw"):
        return columns
    ordered = ",".join(by_letter[letter] for letter in "xyzw")
    taken.append(f"{columns.quaternion} as {ordered}, by their names (--quaternion)")
    return replace(columns, quaternion=ordered)


def _check_roles(table: Table, columns: Columns) -> None:
    """Refuse a column of two roles, and x and y that are components of the field."""
    roles = [("position", columns.x), ("position", columns.y)]
    roles += [("time", columns.time)] if table.names.count(columns.time) < 2 else []
    roles += [("heading", columns.heading)] if columns.heading != NO_HEADING else []
    roles += [("orientation", name) for name in columns.several("quaternion")]
    roles += [("field", name) for name in (columns.field, *columns.several("vector"))]
    seen = dict[int, str]()
    for role, name in roles:
        if not name:
            continue
        column = table.column(name)
        if other := seen.get(id(column)):
            both = f"{role} twice" if other == role else f"{other} and {role} at once"
            raise InputError(
                f"{table.path}: column {column.name or name!r} cannot be {both}; name other columns with "
                "--x, --y, --heading, --quaternion, --field, --vector or --time"
            )
        seen[id(column)] = role
    z = _found(table, ("z",), FIELD_UNITS)
    places = [named(_label(table, name), ())[0] for name in (columns.x, columns.y)]
    if not (columns.field and z) or sorted(places) != ["x", "y"]:
        return
    try:
        length = np.linalg.norm([table.numbers(name) for name in (columns.x, columns.y, z)], axis=0)
    except InputError:
        return  # texts
    b = table.numbers(columns.field)
    known = np.isfinite(length) & (b > 0)
    if known.any() and np.median(np.abs(length[known] / b[known] - 1)) < SAME_LENGTH:
        raise InputError(
            f"{table.path}: {columns.x}, {columns.y} and {z} are the components of {columns.field}, no "
            "positions; name those with --x and --y"
        )


def _times(table: Table, name: str, taken: list[str]) -> Array:
    """The times of a column [s]; ones without a unit that are far too large for seconds are of another."""
    t = table.times(name)
    usual = float(np.median(np.abs(t[np.isfinite(t)]))) if np.isfinite(t).any() else 0.0
    if _unit(table, name, TIME_UNITS) not in TIME_UNITS:
        for least, ticks, unit in EPOCHS:
            if usual >= least:
                taken.append(f"{_label(table, name)} in {unit} since 1970, by its size")
                return t / ticks
    return t


def _lengths(table: Table, name: str) -> Array:
    """A column of lengths [m], in the unit of its name."""
    unit = _unit(table, name, LENGTHS) or "m"
    if unit not in LENGTHS:
        raise InputError(f"{table.path}: {name!r} is no length; {hint(unit, LENGTHS)}")
    return LENGTHS[unit] * table.numbers(name)


def _check_axes(vector_nt: Array, turn: Array, table: Table, columns: Columns) -> None:
    """Refuse vectors whose level part keeps one direction in other axes or headings than those given.

    With the level part v as a complex number and the heading h, a field that keeps its direction in world
    axes has a constant v exp(ih) for vectors in body axes, v for vectors in world axes, and v exp(-ih) for
    headings that turn the other way, and for vectors that are forward, right, down.
    """
    yaw = turn if turn.ndim == 1 else yaw_from_quat(turn)
    spin = np.exp(1j * yaw)
    if abs(spin.mean()) > TURNED:
        return  # one heading: nothing tells the axes apart
    body = levelled(vector_nt, turn, "body")[:, :2] @ np.array([1, 1j])
    kept = {"body": kept_direction(body * spin), "mirrored": kept_direction(body / spin)}
    kept["world"] = kept_direction(vector_nt[:, :2] @ np.array([1, 1j]))
    said = columns.axes or "body"
    best = max((axes for axes in kept if axes != said), key=lambda axes: kept[axes])
    least = kept[best] - CLEARLY if best == "mirrored" else ALIGNED / 2
    if kept[best] <= ALIGNED or kept[said] >= least:
        return
    they = f"{table.path}: {columns.vector} are taken to be in {said} axes, but they keep one direction"
    if best != "mirrored":
        raise InputError(
            f"{they} ({100 * kept[best]:.0f} % of them) in {best} axes, as the Earth's field does: give "
            f"--axes {best}, or correct the headings or the order of the components"
        )
    turned = "give --heading-unit compass for headings clockwise from north"
    if columns.quaternion:
        turned = "change the signs of x, y and z of a quaternion that turns world to body"
    elif columns.heading_unit == "compass":
        turned = "give --heading-unit deg for headings counter-clockwise from +x"
    body_axes = "give --axes body, and " if said == "world" else ""
    raise InputError(
        f"{they} ({100 * kept[best]:.0f} % of them) if headings turn the other way, or if they are forward, "
        f"right, down: {body_axes}{turned}, or change the signs of the second and third component in the file"
    )


def kept_direction(level: NDArray[np.complex128]) -> float:
    """Length of the mean of level vectors by the mean of their lengths; 1 if all have one direction."""
    size = float(np.abs(level).mean())
    return float(abs(level.mean())) / size if size > 0 else 1.0


def levelled(vector_nt: Array, turn: Array, axes: str) -> Array:
    """Vectors in the axes of a robot that stands upright: forward, left, up.

    `turn` are headings [rad], shape (N,), or orientations xyzw of the body in world, shape (N, 4); `axes` are
    those of `vector_nt`. The result, shape (N, 3), is in level axes that are turned by the heading alone.
    """
    if turn.ndim == 1:
        return vector_nt if axes == "body" else rotate(quat_conjugate(quat_from_yaw(turn)), vector_nt)
    world = rotate(turn, vector_nt) if axes == "body" else vector_nt
    return rotate(quat_conjugate(quat_from_yaw(yaw_from_quat(turn))), world)


def _turn(table: Table, columns: Columns) -> Array | None:
    """Headings [rad], shape (N,), or quaternions xyzw, shape (N, 4); None if there is no such column."""
    if columns.quaternion:
        return np.column_stack([table.numbers(name) for name in columns.several("quaternion")])
    if not columns.heading or (columns.heading == NO_HEADING and NO_HEADING not in table.names):
        return None
    name, heading = columns.heading, table.numbers(columns.heading)
    if columns.heading_unit == "deg":
        return np.radians(heading)
    if columns.heading_unit == "compass":
        return np.radians(90.0 - heading)
    beyond = np.flatnonzero(np.abs(heading) > LARGEST_TURN)
    if columns.heading_unit is None and len(beyond):
        where = table.column(name).where(int(beyond[0]))
        raise InputError(
            f"{where}: heading {heading[beyond[0]]:g} is beyond a full turn in radians; "
            "give --heading-unit deg (counter-clockwise from +x), compass (clockwise from north) or, if it "
            "counts turns, rad"
        )
    return heading


def _field(table: Table, columns: Columns) -> tuple[Array | None, Array]:
    """Vectors, if there are any, and magnitudes [nT], shapes (N, 3) and (N,)."""
    factor, names = nt_per(columns.unit, columns.scale), columns.several("vector")
    vector = factor * np.column_stack([table.numbers(name) for name in names]) if names else None
    return vector, factor * table.numbers(columns.field) if vector is None or columns.field else (
        np.linalg.norm(vector, axis=1)
    )


def _runs(table: Table, columns: Columns, stem: str, known: NDArray[np.bool_]) -> Any:
    """Run of each known row, and names of the runs."""
    if not columns.run_column:
        return None, (stem,)
    words = [word for word, is_known in zip(table.texts(columns.run_column), known, strict=True) if is_known]
    runs = list(dict.fromkeys(words))
    index = {word: i for i, word in enumerate(runs)}
    return np.array([index[word] for word in words]), tuple(f"{stem} {word}" for word in runs)


def _together(parts: Sequence[Readings]) -> Readings:
    """Several surveys as runs of one."""
    gridded = [part for part in parts if part.grid is not None]
    if gridded:
        raise InputError(
            f"survey {gridded[0].name!r} is gridded and cannot be one of several sources; read it alone"
        )
    first = np.cumsum([0] + [len(part.runs) for part in parts])
    arrays: dict[str, Any] = {"run": np.concatenate([p.run + n for p, n in zip(parts, first, strict=False)])}
    for key in ("p_xy", "yaw", "b_nt", "b_body_nt", "t", "good"):
        values = [getattr(part, key) for part in parts]
        arrays[key] = None if any(v is None for v in values) else np.concatenate(values)
    same: dict[str, Any] = {}
    unknown = {"created": "", "frame": "", "datum": "", "height_m": None, "earth_nt": None}
    for key, default in unknown.items():
        values_of = {getattr(part, key) for part in parts}
        same[key] = values_of.pop() if len(values_of) == 1 else default
    same["licence"] = "; ".join(dict.fromkeys(part.licence for part in parts if part.licence))
    runs = tuple(run for part in parts for run in part.runs)
    source = "; ".join(part.source for part in parts)
    return Readings(**arrays, **same, runs=runs, name=parts[0].name, source=source)


def _metadata(path: Path) -> dict[bytes, bytes]:
    """The metadata of a Parquet file."""
    return dict(load_parquet(path, pq.read_schema).metadata or {})


def _recorded(run: Run) -> str:
    """How a robot's recording was read, for the source of its readings."""
    said = run.metadata
    about = f" (poses of {said['truth']}, field of {said['clock']} in {said['field_unit']}"
    about += f", {said['field_unit_told']}, stamps of {said['stamps']})"
    taken = said.get("taken")
    return about + "".join(f"; {TAKEN}{note}" for note in str(taken).split("; ")) * bool(taken)


def _sum(path: Path) -> str:
    """Names and checksums of a file, or of the files of a folder."""
    files = [path] if path.is_file() else sorted(file for file in path.iterdir() if file.is_file())
    return "; ".join(f"{file.name} sha256:{sha256(file)}" for file in files)


def _left_out(known: NDArray[np.bool_]) -> str:
    """A note on rows without a value."""
    missing = int(np.count_nonzero(~known))
    return f" ({missing} of {len(known)} rows without a value left out)" if missing else ""
