"""Dataset: recordings with labels on a map, a folder to learn from, read block by block.

    dataset.json         what it holds: recordings, checksums, map, alignment, figures of the labels
    runs/<name>.parquet  a recording, a Run: what features are made of, and its labels

The shards are Parquet in the form that every Run has, so that any program reads them; their row groups of
`BLOCK_ROWS` rows are what is held in memory at a time.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from magtwin.errors import InputError, find
from magtwin.field.maps.map import AnomalyMap
from magtwin.files import existing, output, sha256
from magtwin.learn.data.features import FEATURES, SETS, columns_of, feature_names
from magtwin.learn.data.features import features as features_of
from magtwin.learn.data.labels import Alignment, fit_alignment, labelled
from magtwin.learn.data.origin import map_metadata, shared_metadata
from magtwin.learn.data.recording import Recording, Rows, Source, read, sources_of, thinned
from magtwin.learn.data.split import Part, Split
from magtwin.report import Figure, Report
from magtwin.run.arrow import run_of, table_of
from magtwin.run.run import Metadata, Run
from magtwin.summary import Summarized, Summary, listed, span
from magtwin.version import __version__

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]

KIND, VERSION = "magtwin data set", 1
MANIFEST, RUNS = "dataset.json", "runs"

BLOCK_ROWS = 65_536
"""Rows of a row group: about 20 MB of columns."""

MOST_BYTES = 64 << 20
"""Of a manifest; one of 100,000 recordings has half."""

KEPT = tuple(
    dict.fromkeys(
        (
            *("t", "p_world_base", "yaw", "mocap_p", "mocap_q_xyzw"),
            *(column for feature in FEATURES.values() for column in feature.columns),
            *("b_map_nt", "b_map_gradient_nt_m", "b_measured_nt", "b_truth_nt", "label_nt", "label_sd_nt"),
            *("flag_outside_map", "flag_lost_lock", "flag_pose_lost"),
        )
    )
)
"""Columns of a recording that a data set keeps, of those that it has."""


@dataclass(frozen=True, repr=False)
class Dataset(Summarized):
    """Recordings with labels on one map; see the module."""

    folder: Path
    """Where it lies."""

    recordings: tuple[Recording, ...]
    """In the order that they were given in."""

    columns: tuple[str, ...]
    """Columns that every recording has."""

    map_name: str
    """Map that the labels were made on."""

    map_sha256: str
    """Checksum of its file, or of its values where it came from none."""

    alignment: Alignment
    """Lever arm and latency that they were made with."""

    metadata: Metadata
    """Version of magtwin, the map's method and values, how the alignment came about, and the robot that
    drove, where the recordings tell; see `magtwin.learn.data.origin`."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the recordings."""
        return tuple(one.name for one in self.recordings)

    def recording(self, name: str) -> Recording:
        """A recording by its name.

        Raises:
            InputError: There is none of that name.
        """
        return find("recording", name, {one.name: one for one in self.recordings})

    def runs(self, names: Iterable[str] | None = None) -> Iterator[tuple[Recording, Run]]:
        """Recordings, whole, one at a time; all of them unless named.

        Raises:
            InputError: There is none of a name, or a shard is missing, damaged or was changed.
        """
        for one in self._named(names):
            with self._opened(one) as file:
                yield one, self._run(file.read(), one)

    def blocks(
        self, columns: Sequence[str] | None = None, names: Iterable[str] | None = None
    ) -> Iterator[tuple[Recording, int, Run]]:
        """Recordings in blocks of rows, with the number of each block's first row.

        Args:
            columns: Columns to read beside t; all unless given.
            names: Recordings; all unless given.

        Raises:
            InputError: As for `runs`, or the recordings lack a column.
        """
        wanted = None
        if columns is not None:
            for column in columns:
                find(f"column in the data set {self.folder}", column, dict.fromkeys(self.columns))
            wanted = {"t", *columns}
        for one in self._named(names):
            with self._opened(one) as file:
                flat = None
                if wanted is not None:
                    schema = file.schema_arrow
                    flat = [
                        f.name for f in schema if (f.metadata or {}).get(b"column", b"").decode() in wanted
                    ]
                first = 0
                for i in range(file.num_row_groups):
                    block = self._run(file.read_row_group(i, columns=flat), one)
                    yield one, first, block
                    first += block.rows

    def rows(
        self,
        features: str | Sequence[str] = "full",
        names: Iterable[str] | None = None,
        *,
        split: Split | None = None,
        part: Part = "train",
        beside: Sequence[str] = (),
    ) -> Rows:
        """Inputs and labels of recordings; rows without a label, or with an input that is nan, are left out.

        Args:
            features: A set of `magtwin.learn.data.features.SETS`, or names of features.
            names: Recordings; all unless given.
            split: In place of names: the recordings, and for a split by row the rows, of a part of it.
            part: Which.
            beside: Names of features that are read along; a row is not left out where one of them is nan.

        Raises:
            InputError: No such recording or feature, the recordings lack a column that a feature is made
                of, or no row is left.
        """
        wanted = feature_names(features)
        self._check_features((*wanted, *beside))
        if split is not None:
            names = split.names(part)
        chosen = self._named(names)
        room = sum(one.labelled for one in chosen)
        x, y, sd = np.empty((room, len(wanted))), np.empty(room), np.empty(room)
        recording, row = np.empty(room, np.intp), np.empty(room, np.intp)
        along = np.empty((room, len(beside)))
        number = {one.name: i for i, one in enumerate(chosen)}
        end, unlabelled, unknown = 0, 0, 0
        columns = [*columns_of(wanted), *columns_of(beside), "label_nt", "label_sd_nt"]
        for one, first, run in self.blocks(columns, number):
            label, values = run["label_nt"], features_of(run, wanted)
            known = np.isfinite(label)
            if split is not None and split.by == "row":
                mine = split.rows(part, one.name, one.rows)[first : first + run.rows]
            else:
                mine = np.ones(run.rows, bool)
            whole = np.isfinite(values).all(axis=1)
            kept = mine & known & whole
            unlabelled += int(np.count_nonzero(mine & ~known))
            unknown += int(np.count_nonzero(mine & known & ~whole))
            stop = end + int(np.count_nonzero(kept))
            if stop > room:
                raise InputError(
                    f"{self.folder}: {one.name!r} has more labels than {MANIFEST} says; build it anew"
                )
            x[end:stop], y[end:stop], sd[end:stop] = values[kept], label[kept], run["label_sd_nt"][kept]
            recording[end:stop], row[end:stop] = number[one.name], first + np.flatnonzero(kept)
            if beside:
                along[end:stop] = features_of(run, beside)[kept]
            end = stop
        if not end:
            said = f"{unlabelled:,} rows have no label and {unknown:,} lack an input"
            raise InputError(f"{self.folder}: no row to learn from: {said}; choose others, or other features")
        return Rows(
            x[:end],
            y[:end],
            sd[:end],
            recording[:end],
            tuple(number),
            wanted,
            MappingProxyType({"without a label": unlabelled, "without an input": unknown}),
            row[:end],
            along[:end],
        )

    def check(self) -> None:
        """Read every shard and compare its checksum.

        Raises:
            InputError: One is missing, damaged or was changed.
        """
        for one in self.recordings:
            self._opened(one).close()

    def report(self) -> Report:
        """Recordings, sessions, paths, labels, and which sets of features can be made."""
        rows = sum(one.labelled for one in self.recordings)
        weight = np.array([one.labelled for one in self.recordings], float) / max(rows, 1)
        means = np.array([one.label_mean_nt for one in self.recordings])
        sds = np.array([one.label_sd_nt for one in self.recordings])
        mean = float(weight @ means)
        within, between = float(weight @ sds**2), float(weight @ (means - mean) ** 2)
        sessions, paths = ({getattr(one, key) for one in self.recordings} for key in ("session", "path"))
        figures = [
            Figure("recordings", len(self.recordings)),
            Figure("sessions", len(sessions)),
            Figure("paths", len(paths), note=_some(sorted(paths))),
            Figure("driven", sum(one.duration_s for one in self.recordings), "s"),
            Figure("readings", sum(one.rows for one in self.recordings)),
            Figure("labels", rows),
            Figure("label", mean, "nT", float(np.sqrt(within + between)), "mean; spread over all rows"),
            Figure("label between recordings", float(np.sqrt(between)), "nT", note="spread of their means"),
            *self.alignment.report().figures,
        ]
        sets = [name for name in SETS if set(columns_of(name)) <= set(self.columns)]
        metadata = {
            "map": self.map_name,
            "map_sha256": self.map_sha256,
            **{name: fact for name, fact in self.metadata.items() if name != "map_samples_nt"},
            "feature sets": ", ".join(sets),
        }
        return Report(f"Data set {self.folder}", tuple(figures), metadata)

    def _check_features(self, names: Sequence[str]) -> None:
        for name in names:
            for column in FEATURES[name].columns:
                if column not in self.columns:
                    able = [s for s in SETS if set(columns_of(s)) <= set(self.columns)]
                    raise InputError(
                        f"{self.folder}: feature {name!r} is made of column {column!r}, which its recordings "
                        f"do not all have; sets that can be made: {', '.join(able) or 'none'}"
                    )

    def _named(self, names: Iterable[str] | None) -> tuple[Recording, ...]:
        if names is None:
            return self.recordings
        known = {one.name: one for one in self.recordings}
        return tuple(find("recording", name, known) for name in dict.fromkeys(names))

    def _opened(self, one: Recording) -> pq.ParquetFile:
        path = existing(self.folder / RUNS / f"{one.name}.parquet", "shard of a data set")
        if sha256(path) != one.sha256:
            raise InputError(
                f"{path}: not what {MANIFEST} tells of, by its checksum; build the data set anew"
            )
        try:
            return pq.ParquetFile(path)
        except (pa.ArrowException, OSError) as error:
            raise InputError(
                f"{path}: damaged Parquet ({str(error).splitlines()[0]}); build it anew"
            ) from error

    def _run(self, table: pa.Table, one: Recording) -> Run:
        return run_of(table, self.folder / RUNS / f"{one.name}.parquet")

    def _summary(self) -> Summary:
        """Folder and rows; sessions and paths; map and alignment; spread of the labels."""
        rows, labelled = (sum(getattr(one, name) for one in self.recordings) for name in ("rows", "labelled"))
        seconds = sum(one.duration_s for one in self.recordings)
        (x, y), latency = self.alignment.lever_arm_m, self.alignment.latency_s
        means = [one.label_mean_nt for one in self.recordings if one.labelled]
        sessions, paths = ({getattr(one, name) for one in self.recordings} for name in ("session", "path"))
        return Summary(
            f"Dataset {self.folder.name}: {len(self.recordings):,} recordings, {rows:,} rows, "
            f"{seconds / 60:.4g} min",
            (
                ("from", f"{len(sessions):,} sessions, {len(paths):,} paths: {listed(sorted(paths))}"),
                ("map", f"{self.map_name}; lever arm ({x:.3g}, {y:.3g}) m, latency {latency:.3g} s"),
                (
                    "labels",
                    f"{labelled:,} rows"
                    + (f", means of recordings {span(min(means), max(means), 'nT')}" if means else ""),
                ),
                ("columns", f"{len(self.columns)}: {listed(self.columns)}"),
            ),
            ("recording", "session", "path", "rows", "labels: mean +- sd"),
            [
                (
                    one.name,
                    one.session,
                    one.path,
                    f"{one.rows:,}",
                    f"{one.label_mean_nt:,.0f} +- {one.label_sd_nt:,.0f} nT",
                )
                for one in self.recordings
            ],
        )


def build_dataset(
    recordings: Mapping[str, Run] | Sequence[Source],
    field: AnomalyMap,
    folder: str | os.PathLike[str],
    *,
    alignment: Literal["fit"] | Alignment | None = None,
    map_sha256: str = "",
    rate_hz: float | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Dataset:
    """Label recordings on a map and write them as a data set.

    Args:
        recordings: Runs by name, or sources that are read one at a time.
        field: The map.
        folder: Folder to make.
        alignment: Lever arm and latency; "fit" finds them from all recordings together; None takes pose and
            reading as they stand.
        map_sha256: Checksum of the map's file; that of its values unless given.
        rate_hz: Keep at most so many readings a second [Hz], every second or third, ... of a faster
            magnetometer's; all unless given.
        force: Whether a folder that exists is replaced.
        progress: Is told how many recordings are done, of how many, and which.

    Raises:
        InputError: There is no recording, two have one name, one has no label on the map, lacks a pose
            or a field, all its labels are the same, or the folder exists.
    """
    sources = sources_of(recordings)
    tell = progress or (lambda done, total, what: None)
    if rate_hz is not None and not 0 < rate_hz < np.inf:
        raise InputError(f"rate_hz must be above 0 Hz and finite, got {rate_hz!r}")
    how = "given" if isinstance(alignment, Alignment) else "none"
    total = len(sources) * (2 if alignment == "fit" else 1)
    if alignment == "fit":
        how, runs = "fitted", []
        for i, source in enumerate(sources):
            tell(i, total, f"{source.name}: aligning")
            run = read(source)
            runs.append(thinned(run.select(*(c for c in _ALIGNED if c in run)), 25.0))
        alignment = fit_alignment(
            runs,
            field,
            progress=lambda k, n, what: tell(
                len(sources), total, f"lever arm and latency: {k} of {n} {what}"
            ),
        )
        del runs
    elif alignment is not None and not isinstance(alignment, Alignment):
        raise InputError(f'alignment must be "fit", an Alignment or None, got {alignment!r}')
    done: list[Recording] = []
    columns: list[set[str]] = []
    told: list[Metadata] = []
    with output(folder, force=force) as aside:
        (aside / RUNS).mkdir(parents=True)
        for i, source in enumerate(sources):
            tell(total - len(sources) + i, total, source.name)
            run = thinned(read(source), rate_hz)
            try:
                run = labelled(run, field, alignment)
            except InputError as error:
                raise InputError(f"{source.name}: {error}") from error
            run = run.select(*(column for column in KEPT if column in run))
            done.append(_write(run, source, aside / RUNS / f"{source.name}.parquet"))
            columns.append(set(run))
            told.append(run.metadata)
        _check_labels(done, field)
        shared = [c for c in KEPT if all(c in one for one in columns)]
        metadata: dict[str, Any] = {"alignment": how, "magtwin": __version__}
        metadata |= {"map_source": field.source, "map_licence": field.licence, **map_metadata(field)}
        metadata |= {"poses": "mocap" if "mocap_p" in shared else "true", **shared_metadata(told)}
        manifest = {
            "kind": KIND,
            "version": VERSION,
            "facts": {key: text for key, text in metadata.items() if text},
            "map": {"name": field.name, "sha256": map_sha256 or values_sha256(field)},
            "alignment": asdict(alignment or Alignment()),
            "columns": shared,
            "recordings": [asdict(one) for one in done],
        }
        (aside / MANIFEST).write_text(
            json.dumps(manifest, indent=1, allow_nan=False) + "\n", encoding="utf-8"
        )
    tell(total, total, "")
    return open_dataset(folder)


_ALIGNED = (
    *("t", "p_world_base", "yaw", "mocap_p", "mocap_q_xyzw", "odom_v", "odom_w"),
    *("battery_a", "lidar_on", "b_measured_nt", "flag_lost_lock", "flag_pose_lost"),
)


def open_dataset(folder: str | os.PathLike[str]) -> Dataset:
    """The data set of a folder that `build_dataset` made; shards are read, and checked, when they are needed.

    Raises:
        InputError: It is missing, or no data set, or of another version.
    """
    folder = existing(folder, "data set")
    path = existing(folder / MANIFEST, "manifest of a data set") if folder.is_dir() else folder
    if not folder.is_dir():
        raise InputError(f"{folder}: a file; a data set is the folder that `magtwin dataset build` makes")
    if path.stat().st_size > MOST_BYTES:
        raise InputError(f"{path}: {path.stat().st_size:,} bytes, at most {MOST_BYTES:,} are read")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(data, dict) or data.get("kind") != KIND:
            raise InputError(f"{path}: not the manifest of a data set")
        if data["version"] != VERSION:
            raise InputError(
                f"{path}: of version {data['version']!r}; this magtwin reads {VERSION}: build it anew"
            )
        alignment = data["alignment"]
        found = Dataset(
            folder,
            tuple(Recording(**one) for one in data["recordings"]),
            tuple(str(column) for column in data["columns"]),
            str(data["map"]["name"]),
            str(data["map"]["sha256"]),
            Alignment(
                (float(alignment["lever_arm_m"][0]), float(alignment["lever_arm_m"][1])),
                float(alignment["latency_s"]),
                (float(alignment["lever_arm_sd_m"][0]), float(alignment["lever_arm_sd_m"][1])),
                float(alignment["latency_sd_s"]),
            ),
            {str(key): str(value) for key, value in data["facts"].items()},
        )
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
        raise InputError(
            f"{path}: not the manifest of a data set ({type(error).__name__}: {error}); build it anew"
        ) from error
    if not found.recordings or len(set(found.names)) < len(found.names):
        raise InputError(f"{path}: has no recording, or two of one name; build it anew")
    return found


def _write(run: Run, source: Source, path: Path) -> Recording:
    """Write a shard."""
    table = table_of(run)
    floats = {f.name: "BYTE_STREAM_SPLIT" for f in table.schema if pa.types.is_floating(f.type)}
    pq.write_table(
        table,
        path,
        row_group_size=BLOCK_ROWS,
        compression="zstd",
        use_dictionary=False,
        column_encoding=floats,
    )
    label = run["label_nt"][np.isfinite(run["label_nt"])]
    told = run.metadata
    session = source.session
    if not session and "session" in told:
        seed = f"{told['session_seed']}-" if "session_seed" in told else ""
        session = f"{seed}{told['session']}"
    return Recording(
        source.name,
        session or source.name,
        source.path or str(told.get("path", "")) or source.name,
        run.rows,
        len(label),
        run.duration_s,
        sha256(path),
        float(label.mean()),
        float(label.std()),
    )


def _check_labels(done: Sequence[Recording], field: AnomalyMap) -> None:
    """Refuse labels from which nothing can be learned."""
    means = [one.label_mean_nt for one in done]
    if max(one.label_sd_nt for one in done) < 1e-9 and max(means) - min(means) < 1e-9:
        raise InputError(
            f"every label on the map {field.name!r} is {means[0]:g} nT: there is nothing to learn; were the "
            "runs made by a map-only magnetometer?"
        )


def _some(words: Sequence[str], most: int = 6) -> str:
    return ", ".join(words[:most]) + (", ..." if len(words) > most else "")


def values_sha256(field: AnomalyMap) -> str:
    """Checksum of a map's nodes: what names a map that came from no file of its own."""
    digest = hashlib.sha256(json.dumps([field.origin_m, field.cell_m, field.values_nt.shape]).encode())
    for array in (field.values_nt, field.valid, field.headings_rad):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
