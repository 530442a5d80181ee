"""Suite: which localizers run on which scenarios, from a TOML file."""

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal

from magtwin.errors import InputError, find
from magtwin.files.file import existing
from magtwin.files.kinds import expected, scene_file
from magtwin.files.settings import from_table, read_toml, refused_at
from magtwin.localization.localizers import load_localizer
from magtwin.localization.problem import OdometryModel, SensorModel
from magtwin.sim.motion.drive_input import check_path

HELD_OUT = 1_000_000_000
"""Added to the seed of the suite for the held-out seeds."""

SEEDS = 2**63
"""Seeds are below this, also the held-out ones."""

RUNS = 1_000_000
"""Most runs of all scenarios of a suite together."""

KIDNAPS = 1000
"""Most kidnaps of a run."""

TABLES = 1000
"""Most scenarios, and most localizers, of a suite."""

SUITES = Path(__file__).parent / "suites"
"""Suites that ship with magtwin, NAME.toml."""

SIMULATED = ("twin", "drawn")
"""Sources that need no data."""

Seeds = Literal["public", "held-out"]


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A task, from which runs are drawn by seed. Keys of a `[[scenario]]` table."""

    name: str
    """Name in results: lower-case letters, digits and hyphens."""

    source: Literal["twin", "drawn", "magnetic-data", "ship", "1d"] = "twin"
    """Simulated in a twin, or in places that are drawn (`magtwin.bench.drawn`), or recorded data."""

    data: str = ""
    """Name of a folder in `[data]`: recorded data, or a survey whose harmonic fit is the true field of the
    twin. Default: the map of the scene is."""

    runs: int = 100
    """Number of runs."""

    sessions: int = 50
    """Number of sessions; run k is in session k modulo it."""

    duration_s: float = 90.0
    """Duration of a run [s]."""

    rate_hz: float = 5.0
    """Readings per second [Hz]."""

    prior: Literal["tracking", "heading", "global"] = "tracking"
    """First pose: known to 0.1 m and 5 deg; heading within 10 deg and no position; or nothing."""

    scene: str = "lab"
    """Scene in which the robot drives: the name of a shipped one, or a stage."""

    paths: tuple[str, ...] = ("sine", "lawnmower", "figure8", "continuous_cycle", "random")
    """Paths driven in turn: names, or CSV files relative to the suite's file."""

    places: tuple[str, ...] = ()
    """Places of a drawn scenario, driven in turn: names in `magtwin.bench.drawn.PLACES`. Default: all."""

    lab: str = ""
    """Lab on a stage of several: path of its root prim. Default: the only one."""

    truth: Literal["map", "scene"] = "map"
    """Readings: drawn from the true field with the noise of `sensor`; or those of the scene's physical
    magnetometer, with the robot's own field of the session, motors and LiDAR."""

    belief: Literal["exact", "trilinear", "none"] = "exact"
    """Map that localizers get: the true field, or with `truth` "scene" the scene's map; trilinear
    interpolation of a survey of it; or none (SLAM)."""

    survey_spacing_m: float = 0.5
    """Distance between nodes of the trilinear map [m], unless `data` is a survey, whose nodes are used."""

    map_error_nt: float = 0.0
    """Standard deviation of a random error that is added to the localizer's map [nT]."""

    map_length_m: float = 0.3
    """Its correlation length: exp(-d^2 / (2 length^2)) [m]."""

    sensor: SensorModel = field(default_factory=SensorModel)
    """Noise model that localizers are told, and from which readings are drawn if `truth` is "map"."""

    odometry: Literal["model", "robot"] = "model"
    """Odometry: true motion with the noise of `odometry_model`, or that of the robot's wheels."""

    odometry_model: OdometryModel = field(default_factory=OdometryModel)
    """Noise model that localizers are told."""

    odometry_factor: float = 1.0
    """Factor of all standard deviations of `odometry_model`."""

    kidnaps: int = 0
    """How often the robot is put elsewhere, at equal intervals."""

    kidnap_m: tuple[float, float] = (0.5, 4.0)
    """Least and largest distance of a kidnap [m]."""

    stuck_s: float = 0.0
    """Time for which the sensor repeats one value, from a third of the run on [s]."""

    offset_s: float = 0.0
    """Delay of the magnetometer's readings that nobody is told [s]."""

    lever_error_m: tuple[float, float] = (0.0, 0.0)
    """Error of the sensor's position in base_link that nobody is told [m]."""

    moved_nt: float = 0.0
    """Largest change of the field by an iron object that was moved by 0.6 m since the survey [nT]."""

    calibration_s: float = 0.0
    """Length of the labelled drive at the start of the session [s]."""

    number: int = 1
    """Recording of recorded data."""

    def __post_init__(self) -> None:
        if not self.name or not all(c.islower() or c.isdigit() or c == "-" for c in self.name):
            raise InputError(f"name must have lower-case letters, digits and hyphens only, got {self.name!r}")
        for key in ("runs", "sessions"):
            if getattr(self, key) < 1:
                raise InputError(f"{key} must be at least 1, got {getattr(self, key)}")
        for key in ("duration_s", "rate_hz", "map_length_m", "survey_spacing_m", "odometry_factor"):
            if not 0 < getattr(self, key) < math.inf:
                raise InputError(f"{key} must be above 0, got {getattr(self, key)}")
        for key in ("map_length_m", "survey_spacing_m"):
            if getattr(self, key) < 1e-3:
                raise InputError(f"{key} must be at least 0.001, got {getattr(self, key):g}")
        if not 0 <= self.kidnap_m[0] < self.kidnap_m[1]:
            raise InputError(f"kidnap_m must be two ascending distances, got {self.kidnap_m}")
        if not self.paths:
            raise InputError("paths must name at least one path")
        if self.duration_s * self.rate_hz > 1e6:
            raise InputError(
                f"duration_s {self.duration_s:g} at {self.rate_hz:g} Hz is over a million readings"
            )
        most = min(KIDNAPS, int(self.duration_s * self.rate_hz / 2))
        if not 0 <= self.kidnaps <= most:
            raise InputError(f"kidnaps must be 0 to {most} in a run of that length, got {self.kidnaps}")

    @property
    def told_odometry(self) -> OdometryModel:
        """The odometry model with its factor."""
        return self.odometry_model.scaled(self.odometry_factor)


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A localizer of a suite. Keys of a `[[localizer]]` table."""

    method: str
    """Name of a localizer, or "module:Class"."""

    name: str = ""
    """Name in results. Default: the method."""

    compensator: str = "none"
    """Model of the robot's own field that predicts it from on-board signals: a name, or the weights of a
    trained network, relative to the suite's file."""

    options: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the localizer."""

    scenarios: tuple[str, ...] = ()
    """Scenarios to run. Default: all."""

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", self.method)


@dataclass(frozen=True, kw_only=True)
class Chunk:
    """The unit of work: some runs of one scenario, by some localizers, which share each simulated run."""

    scenario: str
    part: int
    """Number of the chunk in its scenario."""

    first: int
    """Its first run."""

    runs: int
    """Its number of runs."""

    entries: tuple[str, ...]
    """Names of localizers."""


@dataclass(frozen=True, kw_only=True)
class Suite:
    """Scenarios and localizers. Keys of the top of a suite file."""

    name: str
    version: int = 1
    seed: int = 0
    """First seed; run k of a scenario has the seed `seed` + k."""

    chunk: int = 10
    """Runs per chunk of work."""

    time_limit_s: float = 60.0
    """Longest time of a localizer for one run [s]; then its run counts as failed."""

    data: dict[str, str] = field(default_factory=dict)
    """Folders of data by name, relative to `base`."""

    base: str = ""
    """Folder to which scenes and data are relative. Default: that of the suite's file."""

    scenario: tuple[Scenario, ...] = ()
    localizer: tuple[Entry, ...] = ()
    seeds: Seeds = "public"
    salt_sha256: str = ""
    """SHA-256 of the salt of held-out places and seeds, which the next release tells. Default: no salt."""

    salt: str = ""
    """The salt of the runs, in hexadecimal digits; "" for public ones. Not a key of a file."""

    def __post_init__(self) -> None:
        for kind, items in (("scenario", self.scenario), ("localizer", self.localizer)):
            names = [item.name for item in items]
            if not names and kind == "scenario":
                raise InputError("a suite needs at least one [[scenario]]")
            if len(names) > TABLES:
                raise InputError(f"over {TABLES:,} of [[{kind}]]; split the suite")
            if twice := [name for name in names if names.count(name) > 1]:
                raise InputError(f"two of [[{kind}]] are called {twice[0]!r}; give one another name")
        if self.seed < 0 or self.chunk < 1 or not self.time_limit_s > 0:
            raise InputError("seed must not be negative; chunk and time_limit_s must be above 0")
        if (runs := sum(s.runs for s in self.scenario)) > RUNS:
            raise InputError(f"scenario: {runs:,} runs together; at most {RUNS:,}")
        if self.seed + HELD_OUT + runs >= SEEDS:
            raise InputError(f"seed must be at most {SEEDS - HELD_OUT - RUNS:,}, got {self.seed}")
        known = {s.name: s for s in self.scenario}
        for entry in self.localizer:
            for name in entry.scenarios:
                find("scenario", name, known)

    @property
    def scenarios(self) -> Mapping[str, Scenario]:
        """Scenarios by name."""
        return {s.name: s for s in self.scenario}

    @property
    def localizers(self) -> Mapping[str, Entry]:
        """Localizers by name."""
        return {e.name: e for e in self.localizer}

    @property
    def first_seed(self) -> int:
        """Seed of run 0 of every scenario."""
        return self.seed + (HELD_OUT if self.seeds == "held-out" else 0)

    @property
    def sha256(self) -> str:
        """Checksum of all values, without the folders of data."""
        plain = _plain(replace(self, data={}, base=""))
        del plain["salt"]
        for table in (plain, *plain["scenario"]):  # keys that there were not once, if they are not used
            for name in ("salt_sha256", "places"):
                if not table.get(name, True):
                    del table[name]
        return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()

    def entries_of(self, scenario: Scenario) -> tuple[str, ...]:
        """Names of the localizers that run on a scenario."""
        return tuple(e.name for e in self.localizer if not e.scenarios or scenario.name in e.scenarios)

    def chunk_of(self, scenario: Scenario, part: int) -> Chunk:
        """A chunk of a scenario, by its number."""
        first, entries = part * self.chunk, self.entries_of(scenario)
        runs = min(self.chunk, scenario.runs - first)
        return Chunk(scenario=scenario.name, part=part, first=first, runs=runs, entries=entries)

    def chunks(self) -> list[Chunk]:
        """All work, in order."""
        parts = ((s, range(-(-s.runs // self.chunk))) for s in self.scenario if self.entries_of(s))
        return [self.chunk_of(scenario, part) for scenario, numbers in parts for part in numbers]

    def limited(
        self,
        *,
        scenarios: Sequence[str] = (),
        localizers: Sequence[str] = (),
        runs: int | None = None,
        seeds: Seeds = "public",
        data: Mapping[str, str] | None = None,
        salt: str = "",
    ) -> "Suite":
        """A part of the suite.

        Args:
            scenarios: Names to keep. Default: all.
            localizers: Names to keep, or new ones to add by their method's name. Default: all.
            runs: Most runs of each scenario.
            seeds: Which seeds.
            data: Folders by name, which replace those of the file.
            salt: Salt of the held-out seeds, in hexadecimal digits.

        Raises:
            InputError: A scenario is unknown, or the salt is not that of the suite.
        """
        self._check_salt(seeds, salt)
        kept = [find("scenario", name, self.scenarios) for name in scenarios] or list(self.scenario)
        if runs is not None:
            kept = [replace(s, runs=min(s.runs, runs)) for s in kept]
        entries = list(self.localizer)
        if localizers:
            known = self.localizers
            entries = [known[n] if n in known else Entry(method=n) for n in localizers]
        names = {s.name for s in kept}
        entries = [
            replace(e, scenarios=tuple(n for n in e.scenarios if n in names)) if e.scenarios else e
            for e in entries
            if not e.scenarios or names & set(e.scenarios)
        ]
        return replace(
            self,
            scenario=tuple(kept),
            localizer=tuple(entries),
            seeds=seeds,
            salt=bytes.fromhex(salt).hex(),
            data={**self.data, **(data or {})},
        )

    def _check_salt(self, seeds: Seeds, salt: str) -> None:
        """Refuse another salt than the one whose hash the suite has."""
        if not (self.salt_sha256 and seeds == "held-out"):
            if salt:
                raise InputError("a salt is for held-out seeds of a suite with salt_sha256", parameter="salt")
            return
        try:
            known = hashlib.sha256(bytes.fromhex(salt)).hexdigest() == self.salt_sha256
        except ValueError:
            known = False
        if not (salt and known):
            text = (
                "the held-out places are drawn from a salt that the next release tells; give it by `salt` "
                f"(its SHA-256 begins with {self.salt_sha256[:12]})"
            )
            raise InputError(text, parameter="salt")

    def check(
        self,
        file: str | os.PathLike[str] = "",
        make: Callable[[str, Mapping[str, Any]], Any] = load_localizer,
    ) -> None:
        """Make every localizer and compensator once, and look for scenes, paths and data.

        Args:
            file: The suite's file, for error messages. Default: not named.
            make: Makes a localizer by its method and options.

        Raises:
            InputError: There is no localizer; one is unknown or refuses its options; or a scene, a path or
                data are missing.
        """
        if not self.localizer:
            raise InputError(
                "no localizer to run: the suite has no [[localizer]]; give `localizers`",
                parameter="localizers",
            )
        for entry in self.localizer:
            with _named_in(file, "localizer", entry.name, ("options", "compensator", "method")):
                from magtwin.localization.compensators import COMPENSATORS, is_weights

                make(entry.method, entry.options)
                if is_weights(entry.compensator):
                    existing(self.path(entry.compensator), "weights file")
                else:
                    find("compensator", entry.compensator, dict.fromkeys(COMPENSATORS))
        for scenario in self.scenario:
            with _named_in(file, "scenario", scenario.name, ("scene", "paths")):
                if scenario.source == "twin":
                    self.scene(scenario)
                    for path in scenario.paths:
                        check_path(self.path(path))
            if scenario.data or scenario.source not in SIMULATED:
                self.folder(scenario)

    def scene(self, scenario: Scenario) -> Path:
        """Stage of a scenario's scene.

        Raises:
            InputError: There is no such scene.
        """
        beside = Path(self.base) / scenario.scene
        return scene_file(beside if beside.exists() else scenario.scene)

    def path(self, name: str) -> str:
        """A name as it is, or the file of that name beside the suite's file."""
        beside = Path(self.base) / name
        return str(beside) if beside.is_file() else name

    def folder(self, scenario: Scenario) -> Path:
        """Folder of a scenario's data.

        Raises:
            InputError: It is not named or not there.
        """
        if not scenario.data:
            raise InputError(f"scenario {scenario.name!r} has recorded data; name them by its key data")
        if scenario.data not in self.data:
            text = (
                f"scenario {scenario.name!r} needs the data {scenario.data!r}; give their folder with `data`"
            )
            raise InputError(f"{text}, such as {scenario.data}=FOLDER (magtwin fetch)", parameter="data")
        path = Path(self.data[scenario.data])
        if not path.is_dir():
            raise InputError(
                f"{path}: no such folder of data {scenario.data!r} (magtwin fetch)", parameter="data"
            )
        return path


def load_suite(file: str | os.PathLike[str]) -> Suite:
    """The suite of a TOML file, or one that ships with magtwin, by name: standard.

    Raises:
        InputError: There is no such file; a key is unknown or missing; a value has the wrong type or range.
    """
    path = expected(suite_file(file), "suite")
    suite = from_table(Suite, read_toml(path), path)
    base = path.resolve().parent / suite.base
    data = {name: str(base / where) for name, where in suite.data.items()}
    return replace(suite, data=data, base=str(base))


def suite_file(file: str | os.PathLike[str]) -> Path:
    """The file of a suite: `file`, or that of a suite that ships with magtwin, by name."""
    path = Path(file)
    shipped = SUITES / f"{path.name}.toml"
    if path.exists() or path.suffix or path.name != str(file):
        return path
    find("suite", path.name, {suite.stem: suite for suite in SUITES.glob("*.toml")})
    return shipped


@contextmanager
def _named_in(file: str | os.PathLike[str], kind: str, name: str, keys: Sequence[str]) -> Iterator[None]:
    """Refusals with the line in a suite's file: the key in their text, else the last, of a table by name."""
    try:
        yield
    except InputError as error:
        tables = read_toml(file).get(kind, []) if file else []
        names = [table.get("name", table.get("method")) for table in tables]
        if name not in names:  # given by `localizers`
            raise
        number = names.index(name)
        key = next((key for key in keys if key in tables[number] and key.rstrip("s") in str(error)), keys[-1])
        raise refused_at(file, key, str(error), section=kind, number=number) from error


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, tuple | list):
        return [_plain(entry) for entry in value]
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return value
