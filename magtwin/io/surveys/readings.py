"""Readings from files: gridded surveys, tables, runs and bags.

What a file is, its name and its first bytes tell (`magtwin.files.kinds`); one reader is called then.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from glob import has_magic
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.field.survey.folder import read_grid
from magtwin.field.survey.onboard import COLUMNS, signals_of
from magtwin.field.survey.readings import TAKEN, Readings
from magtwin.field.survey.saved import load_readings
from magtwin.files.file import existing, sha256
from magtwin.files.kinds import READINGS, RUN, SURVEY, expected, kind_of
from magtwin.frames import rotate
from magtwin.io.formats import is_bag, read_run
from magtwin.io.surveys.axes import levelled
from magtwin.io.surveys.columns import Columns
from magtwin.io.surveys.logs import is_log, table_of_log
from magtwin.io.surveys.tabled import left_out, rows_of_table
from magtwin.run.run import Run, numbers_in
from magtwin.tables.table import PARQUET, read_table

Source = str | os.PathLike[str]

LEVER_M = 0.02  # Level distance of the magnetometer from base_link above which readings are placed at it [m]
POSE, MAGNITUDE = "/robot/enu/pose", "/robot/qtfm/magnitude"  # In `magtwin.io.bags.topics`


def read_readings(
    *sources: Source,
    columns: Columns | None = None,
    headings_deg: tuple[float, ...] | None = None,
    pose_topic: str | None = None,
    field_topic: str | None = None,
    waypoints: Source | None = None,
    step_m: float | None = None,
    **about: Any,
) -> Readings:
    """Read the readings of a survey from any supported source.

    A source is a folder of one CSV per heading (`magtwin.field.survey.folder`); a table of readings, CSV or
    Parquet or a spreadsheet; a log of a phone or vehicle (`magtwin.io.surveys.logs`); several files with
    matching rows, joined by `+` (`1-time.csv+1-loc.csv+1-mag.csv`; the others are beside the first); the
    Parquet of a Run or of Readings; or a rosbag2, as a folder or a storage file. Several sources are several
    runs of one survey, as are the files of a pattern (`drives/*.parquet`) and the Parquet files of a folder,
    in the order of their names.

    Args:
        sources: One or more sources.
        columns: Meaning and units of the columns of a table.
        headings_deg: Headings of a folder of CSVs [deg], if it is incomplete.
        pose_topic: Topic of a bag's poses, if there are several.
        field_topic: Topic of a bag's field, if there are several.
        waypoints: Table of t,x,y, the times at which the sensor was carried past places, for a log without
            positions (`magtwin.io.surveys.walk`); or of x,y in the order of the walk.
        step_m: Length of a step [m], for waypoints without times and a log with accelerations.
        about: Metadata that replace those of the sources, unless None or "": `name`, `licence`, `created`,
            `height_m` [m], `frame` and `datum`, as in `magtwin.io.surveys.columns.About`.

    Returns:
        Readings in the order of the sources. Rows with a cell that is empty or nan are left out; `source` has
        their number.

    Raises:
        InputError: A source is missing, damaged or unknown; no file matches a pattern; a column is missing
            (the message has the nearest name); a cell is not a number (with file and line); or no unit fits.
    """
    columns = columns or Columns()
    if not sources:
        raise InputError("no source of readings given")
    parts, given, twice = [], dict[str, Source](), list[str]()
    topics = {POSE: pose_topic, MAGNITUDE: field_topic}
    for source in _each(sources):
        path = Path(source)
        same = given.setdefault(sha256(path) if path.is_file() else str(path.resolve()), source)
        if same is not source:
            twice.append(f"{source} and {same} as one, since their bytes are equal")
            continue
        named = {k: name for k, name in topics.items() if name}
        parts.append(_part(source, columns, headings_deg, named, waypoints, step_m))
    readings = parts[0] if len(parts) == 1 else _together(parts)
    if twice:
        readings = readings.with_(source="; ".join([readings.source, *(TAKEN + text for text in twice)]))
    return readings.with_(**{key: value for key, value in about.items() if value not in (None, "")})


def readings_of_run(run: Run, *, name: str = "", source: str = "") -> Readings:
    """The readings of a Run: its measured field at the true pose of base_link, or at the sensor's place.

    The run has p_world_base, yaw and b_measured_nt, or b_total_nt. Rows whose field is nan (outside the map)
    are left out; rows with lost lock are not good. Of a robot's recording, rows between whose poses there is
    a gap are left out too, and vectors are read; if its transforms tell where the magnetometer is
    (`tf_sensor_m` in the metadata), more than `LEVER_M` from base_link, positions are those of the sensor.
    """
    field = next((c for c in ("b_measured_nt", "b_total_nt") if c in run and np.isfinite(run[c]).any()), None)
    if field is None:
        text = "b_measured_nt and b_total_nt hold no field, only nan or nothing"
        raise InputError(f"{source or 'run'}: {text}")
    b, p, yaw, t = run[field], run["p_world_base"], run["yaw"], run["t"]
    known = np.isfinite(b) & np.isfinite(p).all(axis=1) & np.isfinite(yaw) & np.isfinite(t)
    lost = run["flag_lost_lock"] if "flag_lost_lock" in run else np.zeros(len(b), bool)
    vector, about = None, ""
    if "bag" in run.metadata:
        known &= ~run["flag_pose_lost"]
        about = _recorded(run)
        lever = np.array(numbers_in(run.metadata, "tf_sensor_m", 3) or (0.0, 0.0, 0.0))
        if np.hypot(*lever[:2]) > LEVER_M:
            p = p + rotate(run["q_world_base_xyzw"], lever)
            at = ", ".join(f"{part:.3g}" for part in lever)
            about += f"; {TAKEN}positions at the magnetometer, at ({at}) m in base_link by /tf_static"
        if "b_vector_measured_nt" in run:
            vector = levelled(run["b_vector_measured_nt"], run["q_world_base_xyzw"], "body")
            known &= np.isfinite(vector).all(axis=1)
    told = {name: run[name][known].astype(float) for name in COLUMNS if name in run}
    signals, names = signals_of(t[known], {name: c for name, c in told.items() if np.isfinite(c).all()})
    return Readings(
        signals=signals,
        signal_names=names,
        p_xy=p[known, :2],
        yaw=yaw[known],
        b_nt=b[known],
        b_body_nt=None if vector is None else vector[known],
        t=t[known],
        good=~lost[known],
        runs=(name,),
        name=name,
        source=source + left_out(known) + about,
    )


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


def _part(
    source: Source,
    columns: Columns,
    headings_deg: tuple[float, ...] | None,
    topics: dict[str, str],
    waypoints: Source | None,
    step_m: float | None,
) -> Readings:
    """The readings of one source, by the kind of its file."""
    first = source if Path(source).exists() else str(source).split("+")[0]
    path = expected(Path(first), "source of readings")
    kind = kind_of(path)
    if kind is None and path.is_dir() and not is_log(path):
        kind = SURVEY  # whose reader tells what is missing
    if path != Path(source) or kind not in (RUN, READINGS, SURVEY):
        paths = [path, *(_beside(path, word) for word in str(source).split("+")[1:] if path != Path(source))]
        marks = None if waypoints is None else existing(waypoints, "table of waypoints")
        table = table_of_log(path, marks, step_m) if len(paths) == 1 else read_table(path)
        for other in paths[1:]:
            table = table.beside(read_table(other))
        return rows_of_table(table, columns, path.stem, "; ".join(map(_sum, paths)))[0]
    if waypoints is not None or step_m is not None:
        text = "its positions are known; leave out --waypoints and --step-m"
        raise InputError(f"{path}: {text}", parameter="waypoints")
    if replace(columns, unit=None, scale=None) != Columns():
        raise InputError(f"{path}: its columns are known; drop the options that name columns")
    if kind is SURVEY:
        return read_grid(path, headings_deg=headings_deg, unit=columns.unit or "nT", scale=columns.scale)
    options: dict[str, Any] = {}
    if is_bag(path):
        options = {"topics": topics, "unit": columns.unit, "scale": columns.scale, "survey": True}
    elif columns.scale is not None:
        raise InputError(f"{path}: its field is in nT already; leave out --scale")
    if kind is READINGS:
        return load_readings(path)
    run = read_run(path, **options)
    return readings_of_run(run, name=path.stem, source=_sum(path))


def _beside(first: Path, word: str) -> Path:
    """A joined file: beside the first one, or at its path."""
    beside = first.parent / word
    return existing(beside if beside.exists() or not Path(word).exists() else Path(word), "file of readings")


def _together(parts: Sequence[Readings]) -> Readings:
    """Several surveys as runs of one."""
    if gridded := [part.name for part in parts if part.grid is not None]:
        text = "is gridded and cannot be one of several sources; read it alone"
        raise InputError(f"survey {gridded[0]!r} {text}")
    first = np.cumsum([0] + [len(part.runs) for part in parts])
    arrays: dict[str, Any] = {"run": np.concatenate([p.run + n for p, n in zip(parts, first, strict=False)])}
    alike = all(part.signal_names == parts[0].signal_names for part in parts)
    parts = parts if alike else [p.with_(signals=None, signal_names=()) for p in parts]
    same: dict[str, Any] = {"signal_names": parts[0].signal_names}
    for key in ("p_xy", "yaw", "b_nt", "b_body_nt", "t", "signals", "good"):
        values = [getattr(part, key) for part in parts]
        arrays[key] = None if any(v is None for v in values) else np.concatenate(values)
    unknown = {"created": "", "frame": "", "datum": "", "height_m": None, "earth_nt": None}
    for key, default in unknown.items():
        values_of = {getattr(part, key) for part in parts}
        same[key] = values_of.pop() if len(values_of) == 1 else default
    same["rounding_nt"] = max(part.rounding_nt for part in parts)
    same["by_hand"] = all(part.by_hand for part in parts)
    same["licence"] = "; ".join(dict.fromkeys(part.licence for part in parts if part.licence))
    runs = tuple(run for part in parts for run in part.runs)
    source = "; ".join(part.source for part in parts)
    return Readings(**arrays, **same, runs=runs, name=parts[0].name, source=source)


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
