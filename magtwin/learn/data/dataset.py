"""Dataset: recordings with labels on a map, a folder to train on, read block by block.

    dataset.json         recordings, checksums, map, alignment, statistics of the labels
    runs/<name>.parquet  a recording, a Run: the columns of features, and its labels

The shards are Parquet files like those of every Run. A row group of `BLOCK_ROWS` rows is in memory at a time.
"""

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from magtwin.errors import InputError, find
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import existing_file, read_text, sha256
from magtwin.files.kinds import expected
from magtwin.files.outputs import output
from magtwin.learn.data.alignment import Alignment, fit_alignment
from magtwin.learn.data.features import FEATURES, SETS, columns_of, feature_names
from magtwin.learn.data.features import features as features_of
from magtwin.learn.data.labels import labelled
from magtwin.learn.data.origin import map_metadata, shared_metadata
from magtwin.learn.data.recording import Recording, Rows, Source, plant_name, read, sources_of, thinned
from magtwin.learn.data.split import Part, Split
from magtwin.parallel import run_all
from magtwin.report.report import Figure, Report
from magtwin.report.summary import Summarized, Summary, listed
from magtwin.run.arrow import run_of, table_of
from magtwin.run.run import Metadata, Run
from magtwin.tables.parquet import check_parquet
from magtwin.version import __version__

Array = NDArray[np.float64]
Progress = Callable[[int, int, str], None]

KIND, VERSION = "magtwin data set", 1
MANIFEST, RUNS = "dataset.json", "runs"

BLOCK_ROWS = 65_536  # Rows of a row group, about 20 MB of columns
ALIGNED_AT_HZ = 25.0  # Rate at which recordings are held in memory while an alignment is fitted [Hz]

LARGEST = 1e30
"""Largest size of an input to learn from; squares of larger ones overflow."""

ALIGNED = (
    *("t", "p_world_base", "yaw", "mocap_p", "mocap_q_xyzw", "odom_v", "odom_w"),
    *("battery_a", "lidar_on", "b_measured_nt", "flag_lost_lock", "flag_pose_lost"),
)
"""Columns that the fit of an alignment reads."""

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
"""Columns of a recording that a data set keeps."""


@dataclass(frozen=True, repr=False)
class Dataset(Summarized):
    """Recordings with labels on one map."""

    folder: Path

    recordings: tuple[Recording, ...]

    columns: tuple[str, ...]
    """Columns that every recording has."""

    map_name: str
    """Map of the labels."""

    map_sha256: str
    """Checksum of the map's file, or of its values if it has no file."""

    alignment: Alignment
    """Lever arm and latency of the labels."""

    metadata: Metadata
    """Version of magtwin, the map's method and values, source of the alignment, and the robot if the
    recordings name it; see `magtwin.learn.data.origin`."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the recordings."""
        return tuple(recording.name for recording in self.recordings)

    def recording(self, name: str) -> Recording:
        """The recording of a name.

        Raises:
            InputError: No such recording.
        """
        return find("recording", name, {recording.name: recording for recording in self.recordings})

    def runs(self, names: Iterable[str] | None = None) -> Iterator[tuple[Recording, Run]]:
        """Whole recordings, one at a time.

        Args:
            names: Which of them. Default: all.

        Raises:
            InputError: No such recording, or a shard is missing, damaged or changed.
        """
        for recording in self._named(names):
            with self._opened(recording) as file:
                with _undamaged(self._path(recording)):
                    table = file.read()
                yield recording, run_of(table, self._path(recording))

    def rows(
        self,
        features: str | Sequence[str] = "full",
        names: Iterable[str] | None = None,
        *,
        split: Split | None = None,
        part: Part = "train",
        beside: Sequence[str] = (),
    ) -> Rows:
        """Inputs and labels of recordings, without rows that lack a label or an input.

        Args:
            features: A set of `magtwin.learn.data.features.SETS`, or names of features.
            names: Recordings. Default: all.
            split: Take the recordings (for a split by row, the rows) of a part of it instead of `names`.
            part: Which part.
            beside: Names of other features to read; a row that lacks one of them is kept.

        Raises:
            InputError: No such recording or feature, the recordings lack a column of a feature, or no row is
                left.
        """
        wanted = feature_names(features)
        self._check_features((*wanted, *beside))
        chosen = self._named(names if split is None else split.names(part))
        columns = [*columns_of(wanted), *columns_of(beside), "label_nt", "label_sd_nt"]
        number = {recording.name: i for i, recording in enumerate(chosen)}
        parts: list[tuple[NDArray[Any], ...]] = []
        unlabelled, incomplete = 0, 0
        for recording, first, run in self._blocks(columns, chosen):
            label, x = run["label_nt"], features_of(run, wanted)
            known, complete = np.isfinite(label), np.isfinite(x).all(axis=1)
            if (vast := complete & (np.abs(x) > LARGEST).any(axis=1)).any():
                i = int(np.argmax(vast))
                name = wanted[int(np.argmax(np.abs(x[i])))]
                raise InputError(
                    f"{self.folder}: {recording.name!r}, row {first + i}: input {name!r} is "
                    f"{np.abs(x[i]).max():.3g}; write nan for unknown values, and build it anew"
                )
            mine = np.ones(run.rows, bool)
            if split is not None:
                mine = split.rows(part, recording.name, recording.rows)[first : first + run.rows]
            unlabelled += int(np.count_nonzero(mine & ~known))
            incomplete += int(np.count_nonzero(mine & known & ~complete))
            kept = np.flatnonzero(mine & known & complete)
            others = features_of(run.take(kept), beside) if beside else np.empty((len(kept), 0))
            here = np.full(len(kept), number[recording.name])
            sd, t = run["label_sd_nt"][kept], run["t"][kept]
            parts.append((x[kept], label[kept], sd, here, first + kept, others, t))
        x, y, sd, here, row, others, t = map(np.concatenate, zip(*parts, strict=True))
        if not len(y):
            raise InputError(
                f"{self.folder}: no row to learn from: {unlabelled:,} rows have no label and {incomplete:,} "
                "lack an input; choose others, or other features"
            )
        return Rows(x=x, y=y, sd=sd, recording=here, names=tuple(number), row=row, beside=others, t=t)

    def _blocks(
        self, columns: Sequence[str], chosen: Sequence[Recording]
    ) -> Iterator[tuple[Recording, int, Run]]:
        """Columns of recordings in blocks of rows, with the number of each block's first row."""
        wanted = {name.encode() for name in ("t", *columns)}
        for recording in chosen:
            with self._opened(recording) as file:
                flat = [f.name for f in file.schema_arrow if (f.metadata or {}).get(b"column") in wanted]
                first = 0
                for i in range(file.num_row_groups):
                    with _undamaged(self._path(recording)):
                        table = file.read_row_group(i, columns=flat)
                    block = run_of(table, self._path(recording))
                    yield recording, first, block
                    first += block.rows

    def check(self) -> None:
        """Read every shard and compare its checksum.

        Raises:
            InputError: A shard is missing, damaged or changed.
        """
        for recording in self.recordings:
            self._opened(recording).close()

    def report(self) -> Report:
        """Recordings, sessions, paths, labels, and the feature sets that can be made."""
        rows = sum(recording.labelled for recording in self.recordings)
        weight = np.array([recording.labelled for recording in self.recordings], float) / max(rows, 1)
        means = np.array([recording.label_mean_nt for recording in self.recordings])
        sds = np.array([recording.label_sd_nt for recording in self.recordings])
        mean = float(weight @ means)
        within, between = float(weight @ sds**2), float(weight @ (means - mean) ** 2)
        paths = sorted({recording.path for recording in self.recordings})
        figures = [
            Figure("recordings", len(self.recordings)),
            Figure("sessions", len({recording.session for recording in self.recordings})),
            Figure("paths", len(paths), note=", ".join(paths[:6]) + (", ..." if len(paths) > 6 else "")),
            Figure("driven", sum(recording.duration_s for recording in self.recordings), "s"),
            Figure("readings", sum(recording.rows for recording in self.recordings)),
            Figure("labels", rows),
            Figure("label", mean, "nT", float(np.sqrt(within + between)), "mean; spread over all rows"),
            Figure("label between recordings", float(np.sqrt(between)), "nT", note="spread of their means"),
            *self.alignment.figures(),
        ]
        metadata = {
            "map": self.map_name,
            "map_sha256": self.map_sha256,
            **{name: value for name, value in self.metadata.items() if name != "map_samples_nt"},
            "feature sets": ", ".join(self._sets()),
        }
        return Report(f"Data set {self.folder}", tuple(figures), metadata)

    def _sets(self) -> list[str]:
        return [name for name in SETS if set(columns_of(name)) <= set(self.columns)]

    def _check_features(self, names: Sequence[str]) -> None:
        for name in names:
            for column in FEATURES[name].columns:
                if column not in self.columns:
                    raise InputError(
                        f"{self.folder}: feature {name!r} needs column {column!r}, which not all of its "
                        f"recordings have; sets that can be made: {', '.join(self._sets()) or 'none'}"
                    )

    def _named(self, names: Iterable[str] | None) -> tuple[Recording, ...]:
        if names is None:
            return self.recordings
        return tuple(self.recording(name) for name in dict.fromkeys(names))

    def _opened(self, recording: Recording) -> pq.ParquetFile:
        path = existing_file(self._path(recording), "shard of a data set", "Parquet")
        if sha256(path) != recording.sha256:
            raise InputError(f"{path}: its checksum is not that in {MANIFEST}; build the data set anew")
        with _undamaged(path):
            check_parquet(path)
            return pq.ParquetFile(path)

    def _path(self, recording: Recording) -> Path:
        return self.folder / RUNS / f"{recording.name}.parquet"

    def _summary(self) -> Summary:
        rows, labels = (sum(getattr(each, name) for each in self.recordings) for name in ("rows", "labelled"))
        minutes = sum(recording.duration_s for recording in self.recordings) / 60
        (x, y), latency = self.alignment.lever_arm_m, self.alignment.latency_s
        paths = sorted({recording.path for recording in self.recordings})
        sessions = {recording.session for recording in self.recordings}
        return Summary(
            f"Dataset {self.folder.name}: {len(self.recordings):,} recordings, {rows:,} rows, "
            f"{minutes:.4g} min",
            (
                ("from", f"{len(sessions):,} sessions, {len(paths):,} paths: {listed(paths)}"),
                ("map", f"{self.map_name}; lever arm ({x:.3g}, {y:.3g}) m, latency {latency:.3g} s"),
                ("labels", f"{labels:,} rows"),
                ("columns", f"{len(self.columns)}: {listed(self.columns)}"),
            ),
            ("recording", "session", "path", "rows", "labels"),
            [
                (each.name, each.session, each.path, f"{each.rows:,}", f"{each.labelled:,}")
                for each in self.recordings
            ],
        )


@contextmanager
def _undamaged(path: Path) -> Iterator[None]:
    """Refuse a shard whose bytes pyarrow cannot read."""
    try:
        yield
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = (str(error).splitlines() or [""])[0]
        raise InputError(f"{path}: damaged Parquet ({reason}); build it anew") from error


def build_dataset(
    recordings: Mapping[str, Run] | Sequence[Source],
    field: AnomalyMap,
    folder: str | os.PathLike[str],
    *,
    alignment: Literal["fit"] | Alignment | None = None,
    map_sha256: str = "",
    rate_hz: float | None = None,
    jobs: int | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> Dataset:
    """Label recordings on a map and write them as a data set: `magtwin.build_dataset` for sources.

    `map_sha256` is the checksum of the map's file; default: that of its values.
    """
    sources = sources_of(recordings)
    report = progress or (lambda done, total, what: None)
    if rate_hz is not None and not 0 < rate_hz < np.inf:
        raise InputError(f"rate_hz must be above 0 Hz and finite, got {rate_hz!r}")
    how = "given" if isinstance(alignment, Alignment) else "none"
    total = len(sources) * (2 if alignment == "fit" else 1)

    def each(first: int, what: str = "") -> Callable[[int, int], None]:
        return lambda k, n: report(first + k, total, f"{sources[k].name}{what}") if k < n else None

    if alignment == "fit":
        how = "fitted"
        runs = run_all(_to_align, sources, jobs=jobs, progress=each(0, ": aligning"))
        report(len(sources), total, "lever arm and latency")
        alignment = fit_alignment(runs, field)
        del runs
    elif alignment is not None and not isinstance(alignment, Alignment):
        raise InputError(f'alignment must be "fit", an Alignment or None, got {alignment!r}')
    with output(folder, force=force) as aside:
        (aside / RUNS).mkdir(parents=True)
        shards = run_all(
            partial(_shard, field, alignment, rate_hz, aside / RUNS),
            sources,
            jobs=jobs,
            progress=each(total - len(sources)),
        )
        written, columns, of_runs = zip(*shards, strict=True)
        means = [recording.label_mean_nt for recording in written]
        if max(recording.label_sd_nt for recording in written) < 1e-9 and max(means) - min(means) < 1e-9:
            raise InputError(
                f"every label on the map {field.name!r} is {means[0]:g} nT: there is nothing to learn; were "
                "the runs made by a map-only magnetometer?"
            )
        shared = [column for column in KEPT if all(column in each for each in columns)]
        metadata: dict[str, Any] = {"alignment": how, "magtwin": __version__}
        metadata |= {"map_source": field.source, "map_licence": field.licence, **map_metadata(field)}
        metadata |= {"poses": "mocap" if "mocap_p" in shared else "true", **shared_metadata(of_runs)}
        manifest = {
            "kind": KIND,
            "version": VERSION,
            "facts": {key: text for key, text in metadata.items() if text},
            "map": {"name": field.name, "sha256": map_sha256 or values_sha256(field)},
            "alignment": asdict(alignment or Alignment()),
            "columns": shared,
            "recordings": [asdict(recording) for recording in written],
        }
        (aside / MANIFEST).write_text(
            json.dumps(manifest, indent=1, allow_nan=False) + "\n", encoding="utf-8"
        )
    report(total, total, "")
    return open_dataset(folder)


def open_dataset(folder: str | os.PathLike[str]) -> Dataset:
    """Open the folder of a data set; shards are read and checked when they are needed.

    Raises:
        InputError: It is missing, not a data set, or of another version.
    """
    if Path(folder).name == MANIFEST:
        raise InputError(f"{folder}: a file; a data set is the folder that it is in")
    folder = expected(folder, "data set")
    if not folder.is_dir():
        raise InputError(f"{folder}: a file; a data set is the folder that `magtwin dataset build` makes")
    path = folder / MANIFEST
    if not path.exists():
        raise InputError(
            f"{path}: no such manifest of a data set; make a data set of runs: magtwin dataset build RUN "
            "--map MAP --out SET"
        )
    text = read_text(path, "manifest of a data set", "JSON")
    try:
        data = json.loads(text)
        if not isinstance(data, dict) or data.get("kind") != KIND:
            raise InputError(f"{path}: not the manifest of a data set")
        if data["version"] != VERSION:
            raise InputError(
                f"{path}: of version {data['version']!r}; this magtwin reads {VERSION}: build it anew"
            )
        alignment = data["alignment"]
        (x, y), (x_sd, y_sd) = (map(float, alignment[f"lever_arm{part}_m"]) for part in ("", "_sd"))
        dataset = Dataset(
            folder,
            tuple(Recording(**recording) for recording in data["recordings"]),
            tuple(str(column) for column in data["columns"]),
            str(data["map"]["name"]),
            str(data["map"]["sha256"]),
            Alignment((x, y), float(alignment["latency_s"]), (x_sd, y_sd), float(alignment["latency_sd_s"])),
            {str(key): str(value) for key, value in data["facts"].items()},
        )
    except InputError as error:
        if str(path) in str(error):
            raise
        raise InputError(f"{path}: {error}") from error
    except (
        ValueError,
        OverflowError,
        KeyError,
        TypeError,
        IndexError,
        AttributeError,
        RecursionError,
    ) as error:
        raise InputError(
            f"{path}: not the manifest of a data set ({type(error).__name__}: {error}); build it anew"
        ) from error
    if not dataset.recordings or len(set(dataset.names)) < len(dataset.names):
        raise InputError(f"{path}: has no recording, or two of one name; build it anew")
    return dataset


def _to_align(source: Source) -> Run:
    """What the fit of an alignment reads of a recording."""
    run = read(source)
    return thinned(run.select(*(column for column in ALIGNED if column in run)), ALIGNED_AT_HZ)


def _shard(
    field: AnomalyMap, alignment: Alignment | None, rate_hz: float | None, folder: Path, source: Source
) -> tuple[Recording, set[str], Metadata]:
    """Label a recording and write its shard; gives its entry, its columns and the metadata of its run."""
    run = thinned(read(source), rate_hz)
    try:
        run = labelled(run, field, alignment)
    except InputError as error:
        raise InputError(f"{source.name}: {error}") from error
    run = run.select(*(column for column in KEPT if column in run))
    return _write(run, source, folder / f"{source.name}.parquet"), set(run), dict(run.metadata)


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
    session, path_driven = source.session_and_path(run)
    return Recording(
        name=source.name,
        session=session,
        path=path_driven,
        rows=run.rows,
        labelled=len(label),
        duration_s=run.duration_s,
        sha256=sha256(path),
        label_mean_nt=float(label.mean()),
        label_sd_nt=float(label.std()),
        plant=plant_name(run.metadata),
    )


def values_sha256(field: AnomalyMap) -> str:
    """Checksum of a map's nodes, for maps without a file."""
    digest = hashlib.sha256(json.dumps([field.origin_m, field.cell_m, field.grid.shape]).encode())
    for array in (field.values_nt, field.valid, field.headings_rad):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
