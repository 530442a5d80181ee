"""Recordings of a data set: the sources it is built from, their entries in it, and the rows read from it."""

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.learn.data.alignment import usable
from magtwin.report.summary import Summarized
from magtwin.run.run import Run
from magtwin.run.thinning import newest

Array = NDArray[np.float64]

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.+-]{0,199}")
_SHA = re.compile("[0-9a-f]{64}")


@dataclass(frozen=True)
class Source:
    """A recording to put into a data set, or to judge models by."""

    name: str
    """Its name; in a data set of letters, digits and _ . + -, and also that of its shard."""

    read: Callable[[], Run]
    """Returns the run; called once, or twice if an alignment is fitted."""

    session: str = ""
    """Its session. Default: that in the run's metadata, else the name."""

    path: str = ""
    """The driven path. Default: that in the run's metadata, else the name."""

    def session_and_path(self, run: Run) -> tuple[str, str]:
        """Its session and path, given its run."""
        session = self.session or session_name(run.metadata) or self.name
        return session, self.path or str(run.metadata.get("path", "")) or self.name


def session_name(metadata: Mapping[str, object]) -> str:
    """Name of the session of a run; "" if its metadata name none. Robots with different plants differ."""
    if "session" not in metadata:
        return ""
    seed = f"{metadata['session_seed']}-" if "session_seed" in metadata else ""
    plant = _short(str(metadata.get("plant", "")))
    return f"{seed}{metadata['session']}" + (f"-{plant}" if plant else "")


def plant_name(metadata: Mapping[str, object]) -> str:
    """Name of the plant of a run; "" if it is the nominal one or its metadata name none."""
    plant = _short(str(metadata.get("plant", "")))
    return "" if plant.partition(":")[0] == "nominal" else plant


def _short(plant: str) -> str:
    """The text of a plant; of its fields as JSON, a checksum."""
    return hashlib.sha256(plant.encode()).hexdigest()[:8] if plant.startswith("{") else plant


@dataclass(frozen=True)
class Recording:
    """A recording of a data set."""

    name: str
    session: str
    """Its session; its own name if unknown."""

    path: str
    """The driven path; its own name if unknown."""

    rows: int
    """Number of readings."""

    labelled: int
    """Number of readings with a label."""

    duration_s: float
    """From the first reading to the last [s]."""

    sha256: str
    """Checksum of its shard."""

    label_mean_nt: float
    """Mean of its labels [nT]."""

    label_sd_nt: float
    """Standard deviation of its labels [nT]."""

    plant: str = ""
    """The simulated robot's plant; "" if nominal or unknown."""

    def __post_init__(self) -> None:
        for name in ("name", "session", "path", "sha256", "plant"):
            if not isinstance(getattr(self, name), str):
                raise InputError(f"{name} of a recording must be a text, got {getattr(self, name)!r}")
        for name in ("rows", "labelled"):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < 0:
                raise InputError(f"{name} of a recording must be a whole number from 0, got {value!r}")
        if self.labelled > self.rows:
            raise InputError(f"{self.name[:80]!r} has {self.rows} rows and {self.labelled} labels")
        for name in ("duration_s", "label_mean_nt", "label_sd_nt"):
            value = getattr(self, name)
            if not isinstance(value, int | float) or not np.isfinite(value):
                raise InputError(f"{name} of a recording must be a finite number, got {value!r}")
        if not _NAME.fullmatch(self.name) or ".." in self.name:
            raise InputError(f"a recording is named by letters, digits and _ . + -, got {self.name[:80]!r}")
        if not _SHA.fullmatch(self.sha256):
            raise InputError(f"sha256 of recording {self.name!r} is not one: {self.sha256[:80]!r}")


@dataclass(frozen=True, repr=False)
class Rows(Summarized):
    """Inputs and labels to train on, row by row."""

    x: Array
    """Features in the units of `FEATURES`, shape (N, F); none is nan."""

    y: Array
    """Labels [nT], shape (N,)."""

    sd: Array
    """Standard deviation of the map there [nT], shape (N,)."""

    recording: NDArray[np.intp]
    """Index into `names` of each row, shape (N,), ascending."""

    names: tuple[str, ...]
    """Recordings."""

    row: NDArray[np.intp]
    """Number of each row in its recording, shape (N,)."""

    beside: Array
    """Other features of the same rows, shape (N, K); nan if unknown."""

    t: Array
    """Time of each row in its recording [s], shape (N,)."""


def sources_of(recordings: Mapping[str, Run] | Sequence[Source]) -> list[Source]:
    """Sources of runs by name, or the given sources, with their names checked.

    Raises:
        InputError: There is none, a name is not valid, or two have one name.
    """
    if isinstance(recordings, Mapping):
        sources = [Source(name, partial(_same, run)) for name, run in recordings.items()]
    else:
        sources = list(recordings)
    if not sources:
        raise InputError("no recording is named; name one at least")
    seen: set[str] = set()
    for source in sources:
        if not _NAME.fullmatch(source.name) or ".." in source.name:
            raise InputError(
                f"a recording is named by letters, digits and _ . + -, got {source.name[:80]!r}; rename it"
            )
        if source.name.casefold() in seen:
            raise InputError(f"two recordings are called {source.name!r}; rename one")
        seen.add(source.name.casefold())
    return sources


def _same(run: Run) -> Run:
    return run


def read(source: Source) -> Run:
    """Read the run of a source and check that it can be labelled.

    Raises:
        InputError: It has no pose or no field, or its field comes from a network or a map.
    """
    run = source.read()
    posed = {"mocap_p", "mocap_q_xyzw"} <= set(run) or {"p_world_base", "yaw"} <= set(run)
    if not posed or "b_measured_nt" not in run:
        poses = (
            "mocap_p with mocap_q_xyzw, or p_world_base with yaw; --pose-topic names a bag's topic of poses"
        )
        wanted = "b_measured_nt" if posed else poses
        raise InputError(f"{source.name}: nothing to label: it has no column {wanted}")
    if (kind := run.metadata.get("magnetometer")) in ("neural", "map-only"):
        raise InputError(
            f"{source.name}: its readings come from a {kind} magnetometer, and training on them would learn "
            "that model; record a robot, or drive the twin with --magnetometer physical"
        )
    return run


def thinned(run: Run, rate_hz: float | None) -> Run:
    """The newest row with a field and a pose of every k rows, so that the rate is at most `rate_hz`."""
    if rate_hz is None or run.rows < 2:
        return run
    step = float(np.median(np.diff(run["t"])))
    every = max(1, int(np.ceil(min(0.99 / max(step * rate_hz, 1e-300), run.rows))))  # to 1 %, as clocks go
    if every == 1:
        return run
    place = run["mocap_p" if "mocap_p" in run else "p_world_base"]
    good = usable(run) & np.isfinite(run["b_measured_nt"]) & np.isfinite(place).all(axis=1)
    return run.take(newest(np.arange(0, run.rows, every), good)).with_metadata(every=every)
