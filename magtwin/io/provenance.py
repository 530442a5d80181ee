"""Provenance: reproduce a run from its metadata and compare it with the original."""

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.io.formats import read_run, write_run
from magtwin.path import CASES, PATHS, Path, path_named, read_path_csv
from magtwin.path.room import COVERAGE
from magtwin.report.report import Figure, Report
from magtwin.run.run import COLUMNS, Run
from magtwin.sim.motion.drive_input import path_metadata
from magtwin.twin import in_session_of, lab_and_map, locate, scene_of, simulate, simulate_robots, twin_of

CAUSES: Mapping[str, str] = {
    "magtwin": "another version of magtwin",
    "numpy": "another version of NumPy",
    "scene_sha256": "the scene changed",
    "config_sha256": "the settings of the scene or its robot changed",
    "map_sha256": "the map changed",
    "network_sha256": "the network changed",
    "path_sha256": "the path changed",
    "commands_sha256": "the commands changed",
    "replay_sha256": "the replayed run changed",
}
"""Metadata that determine a run's columns, and the cause if they differ, likeliest first."""


_MORE = 10  # How many times its readings a run may have by its rate and its length


@dataclass(frozen=True)
class Difference:
    """Difference of a column between a run and its reproduction."""

    column: str
    rows: int  # Number of rows that differ
    first: int  # The first of them
    greatest: float  # Largest absolute difference; nan if only one of the values is known


@dataclass(frozen=True)
class Repeat:
    """A reproduced run."""

    original: Run
    again: Run
    causes: tuple[str, ...]  # Differing metadata that determine the columns, with old and new value
    differences: tuple[Difference, ...]  # Columns that are not bit-identical

    @property
    def equal(self) -> bool:
        """Whether all columns of the original are bit-identical."""
        return not self.differences

    def report(self, title: str) -> Report:
        """The differing columns and the verdict; the metadata list what changed."""
        figures = []
        for d in self.differences:
            note = f"{d.rows} of {self.original.rows} rows, from row {d.first + 1} on"
            unit = COLUMNS[d.column].unit if d.column in COLUMNS else ""
            figures.append(Figure(d.column, d.greatest, unit if unit != "bool" else "", None, note))
        count = len(self.original) - len(self.differences)
        figures.append(Figure("equal columns", count, note=f"of {len(self.original)}"))
        figures.append(Figure("equal", "yes, to the bit" if self.equal else "no"))
        made = "The run was made again, and is equal to the bit."
        verdict = made if self.equal else f"DIFFERENT: {len(self.differences)} columns are not the same bits."
        return Report(title, tuple(figures), {"changed": list(self.causes)} if self.causes else {}, verdict)


def repeat_of(file: str | FilePath, scene: str | FilePath | None = None) -> Repeat:
    """Reproduce the run of a file as `repeat`, and compare it at the precision of the file's format."""
    file = FilePath(file)
    run = read_run(file)
    result = repeat(run, scene, near=file)
    if result.equal:
        return result
    with tempfile.TemporaryDirectory() as folder:  # a bag, for example, keeps a battery in single precision
        beside = FilePath(folder) / (f"run{file.suffix}" if file.suffix and not file.is_dir() else "run")
        write_run(result.again, beside)
        return replace(result, differences=differences(run, read_run(beside)))


def repeat(run: Run, scene: str | FilePath | None = None, *, near: str | FilePath | None = None) -> Repeat:
    """Reproduce a run from its metadata and report whether the columns match.

    Args:
        run: A run that `simulate`, `sweep` or a command made.
        scene: The scene file. Default: the one in the metadata.
        near: The run's file; files that its metadata name are also searched for in its folder.

    Raises:
        InputError: The metadata are incomplete, a file is missing, or the run used objects from Python that
            are not in a file.
    """
    again = made_again(run, scene, near=near)
    derived = run.metadata.get("derived")
    causes = [] if derived is None else [f"the run was made from another: {derived}"]
    causes += [
        f"{why}: {key} was {run.metadata.get(key, 'none')}, is {again.metadata.get(key, 'none')}"
        for key, why in CAUSES.items()
        if run.metadata.get(key) != again.metadata.get(key)
    ]
    return Repeat(run, again, tuple(causes), differences(run, again))


def made_again(
    run: Run,
    scene: str | FilePath | None = None,
    *,
    near: str | FilePath | None = None,
    engine: str | None = None,
    seed: int | None = None,
    progress: Callable[[int, int, str], Any] | None = None,
) -> Run:
    """Reproduce a run from its metadata, or drive the same with another engine or seed.

    `run`, `scene`, `near` and errors are those of `repeat`. `engine` is "kinematic" or "newton", `seed` that
    of all noise; by default those of the run. `progress` is as for `magtwin.twin.engine_named`.
    """
    metadata = run.metadata
    if "seed" not in metadata and seed is None:
        raise InputError(
            "the metadata hold no seed, so it cannot be made again; was the run recorded elsewhere?"
        )
    twin = in_session_of(twin_of(run, scene, near=near, check=False), metadata)
    what = _driven(run, near)
    try:
        seed, rate = int(metadata["seed"]) if seed is None else seed, float(metadata["rate_hz"])
        asked = float(metadata["asked_duration_s"]) if "asked_duration_s" in metadata else None
        speed = float(metadata.get("speed_m_s", 0.2))
    except (KeyError, ValueError, OverflowError) as error:
        raise InputError(f"the metadata of the run are incomplete: {error}") from error
    if run.rows > 1 and rate * float(run["t"][-1] - run["t"][0]) > _MORE * run.rows:
        raise InputError(f"rate_hz of the metadata is {rate:g}; the run's {run.rows:,} readings have another")
    moved_by: Any = engine or metadata.get("engine", "kinematic")
    options: dict[str, Any] = {"seed": seed, "speed": speed, "duration_s": asked, "rate_hz": rate}
    options |= {"lidar": metadata.get("lidar", "schedule"), "outside": metadata.get("outside", "nan")}
    if isinstance(what, Path):
        options["controller"] = str(metadata.get("controller", "follower"))
    if engine is None and moved_by not in ("kinematic", "newton", "replay"):
        raise InputError(f"the run used a custom engine, {moved_by!r}, which is not available")
    name = str(metadata.get("robot", ""))
    if engine is None and name and twin.scene.others:  # beside others, which drive their scene's paths
        return simulate_robots(twin, {name: what}, robots=[name], meet="flag", **options)[name]
    moved_by = "kinematic" if moved_by == "replay" else moved_by
    return simulate(twin, what, engine=moved_by, progress=progress, **options)


def map_of(
    run: Run, scene: str | FilePath | None = None, *, near: str | FilePath | None = None
) -> AnomalyMap:
    """The map of a run, if its scene is there and the map unchanged; arguments are those of `repeat`."""
    from magtwin.usd.layers import layer_sha256
    from magtwin.usd.maps.layer import load_map
    from magtwin.usd.scene import read_scene

    where = lab_and_map(run.metadata, near)
    layer = read_scene(scene_of(run, scene, near=near), check_network=False, **where).map_layer
    if "map_sha256" in run.metadata and run.metadata["map_sha256"] != layer_sha256(layer):
        raise InputError(f"{layer}: is not the map of the run")
    return load_map(layer)


def planned_of(run: Run, *, near: str | FilePath | None = None) -> NDArray[np.float64] | None:
    """The planned path of a run [m], shape (M, 2); None if it is not available."""
    try:
        path = _driven(run, near)
    except InputError:
        return None
    if not isinstance(path, Path) or run.metadata.get("path_sha256") != path_metadata(path)["path_sha256"]:
        return None
    return path.p_xy


def differences(run: Run, again: Run) -> tuple[Difference, ...]:
    """Columns that are not bit-identical in another run; nan equals nan."""
    found = []
    for name, a in run.items():
        if (b := again.columns.get(name)) is None:
            found.append(Difference(name, run.rows, 0, np.nan))
            continue
        rows = min(len(a), len(b))
        same = _same(a[:rows], b[:rows])
        count = int(np.count_nonzero(~same)) + max(len(a), len(b)) - rows
        if not count:
            continue
        first = int(np.argmin(same)) if not same.all() else rows
        apart = np.abs(a[:rows].astype(float) - b[:rows].astype(float))
        known = apart[np.isfinite(apart)]
        found.append(Difference(name, count, first, float(known.max()) if known.any() else np.nan))
    return tuple(found)


def _same(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Equal rows, shape (N,)."""
    same = (a == b) | ((a != a) & (b != b))
    if a.dtype.kind == "f" and b.dtype.kind == "f":
        same &= (a != 0) | (np.signbit(a) == np.signbit(b))  # -0 is not 0
    return same if same.ndim == 1 else same.all(axis=1)


def _driven(run: Run, near: str | FilePath | None) -> Any:
    """What was driven: a path, commands, a run, or "random"."""
    from magtwin.sim.motion.commands import read_commands

    metadata = run.metadata
    for kind, read in (("path", read_path_csv), ("commands", read_commands), ("replay", read_run)):
        if f"{kind}_file" in metadata:
            file = str(metadata[f"{kind}_file"])
            if (place := locate(file, near)) is None:
                raise InputError(f"{file}: the file that the run drove is missing; put it back")
            return _placed(read(place), run)
    name = str(metadata.get("path", ""))
    if {"replay_sha256", "commands_sha256"} & metadata.keys():
        raise InputError(f"the run drove {name!r}, which is in no file; it cannot be reproduced")
    if name in ("random", COVERAGE):  # planned for the room
        return name
    if name not in (*PATHS, *CASES):
        raise InputError(f"the run drove the path {name!r}, which is in no file; it cannot be reproduced")
    return _placed(path_named(name), run)


def _placed(driven: Any, run: Run) -> Any:
    """A path scaled and moved as in the run's metadata."""
    placing = str(run.metadata.get("path_placing", ""))
    if not placing or not isinstance(driven, Path):
        return driven
    try:
        return driven.placed(tuple(map(float, placing.split())))  # type: ignore[arg-type]
    except ValueError as error:
        raise InputError(f"metadata path_placing must be four numbers, got {placing!r}") from error
