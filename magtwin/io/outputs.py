"""Outputs of a run: drive a scene, and write every file that was asked for, or none."""

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from magtwin.errors import InputError
from magtwin.files.file import existing
from magtwin.files.kinds import COMMANDS, RUN, kind_of
from magtwin.files.outputs import check_free, free, output, transaction
from magtwin.io.formats import FORMATS, format_of, format_to_write, read_run, write_run
from magtwin.path import CASES, PATHS, read_path_csv
from magtwin.path import Path as Planned
from magtwin.path.room import FLOOR_M
from magtwin.run.run import Run
from magtwin.run.summary import swept
from magtwin.sim.motion.commands import Commands, read_commands
from magtwin.sim.motion.drive_input import check_path, drive_input, path_metadata
from magtwin.spec.plant import PlantSpec
from magtwin.twin import Session, Twin, in_session, open_twin, room_of, scan, simulate, with_plant

if TYPE_CHECKING:
    from magtwin.sim.sensors.lidar import Scans

IN_FOLDER = ("run.rrd", "run.parquet")  # Runs in a folder; scans and a picture lie beside them

USD = (".usd", ".usda", ".usdc")

OPENING = ("lab", "map_layer", "network", "magnetometer", "model_error", "tracking_error")  # Of `open_twin`


@dataclass(frozen=True)
class Driven:
    """A run with its twin, the planned path and the LiDAR's scans."""

    run: Run
    twin: Twin
    planned: Planned | None = None
    scans: "Scans | None" = None


def driven_by(path: str) -> "str | Commands | Run":
    """What to drive: the name of a path, or a file of x,y, as it is; commands; or a run.

    A file with a header t,v,w holds commands, as does one that is no path and can be read as commands.
    """
    if path in (*PATHS, *CASES, "random") or not os.path.lexists(path):
        return path
    file = existing(path, "path file")
    kind = kind_of(file)
    if file.is_dir() or file.suffix.lower() in {*FORMATS} - {".csv"} or kind is RUN:
        return read_run(file)
    if kind is COMMANDS:
        return read_commands(file)
    try:
        read_path_csv(file)
    except InputError:
        with suppress(InputError):
            return read_commands(file)
        raise
    return path


def drive(
    scene_file: str | Path,
    path: "str | Commands | Run" = "figure8",
    *,
    seed: int = 0,
    session: Session | None = None,
    plant: PlantSpec | str | None = None,
    fit: bool = False,
    scans: bool = False,
    metadata: Mapping[str, str | int] = MappingProxyType({}),
    report: Callable[[str], Any] = lambda text: None,
    tell: Callable[[str], Any] = lambda text: None,
    **options: Any,
) -> Driven:
    """Drive a scene's robot along a path, by commands, or as in a recorded run.

    `path` is as from `driven_by`, with `fit` moved and shrunk until it fits; seed, session and plant are as
    for `magtwin.simulate`. With `scans` the LiDAR's rays are cast. `metadata` are added to the run's, such as
    names of files that move with it; `report` is called with a line about each step, and `tell` with one
    about what is driven otherwise than it was asked for. `options` are those of `magtwin.open_twin` and
    `magtwin.simulate`.
    """
    check_path(path)
    twin = open_twin(scene_file, **{name: options.pop(name) for name in OPENING if name in options})
    twin = in_session(with_plant(twin, plant), session, seed=seed)
    what = drive_input(path, room_of(twin), fit=fit)
    planned = what if isinstance(what, Planned) else None
    if planned is not None and planned.placing:
        how = _placing(planned.placing, named=path in (*PATHS, *CASES))
        tell(f"Path {planned.name} is {how} to fit this floor and what stands on it")
    if planned is not None and (text := swept(path_metadata(planned))):
        tell(f"Path {planned.name}: {text}")
    if isinstance(what, Commands) and (text := what.beyond(twin.scene.robot.drive)):
        tell(text)
    report(f"Driving {getattr(what, 'name', 'random' if what == 'random' else 'as recorded')}")
    run = simulate(twin, what, seed=seed, **options).with_metadata(**metadata)
    if scans:
        report("Casting the LiDAR's rays")
    return Driven(run, twin, planned, scan(twin, run, seed=seed) if scans else None)  # type: ignore[arg-type]


def _placing(placing: tuple[float, ...], *, named: bool) -> str:
    """How a path was brought onto the floor, in words; a named path is made for a floor of its own."""
    scale_x, scale_y, x, y = placing
    scale = f"{scale_x:.2g}" if scale_x == scale_y else f"{scale_x:.2g} in x and {scale_y:.2g} in y"
    made_for = f" from its {FLOOR_M[0]:g} x {FLOOR_M[1]:g} m floor" if named else ""
    parts = [f"scaled by {scale}{made_for}"] if (scale_x, scale_y) != (1, 1) else []
    parts += [f"moved by ({x:.2f}, {y:.2f}) m"] if max(abs(x), abs(y)) >= 0.005 else []
    return " and ".join(parts)


@dataclass(frozen=True)
class Outputs:
    """Files and a folder to write a run to: all of them, or none.

    A file gets the format of its suffix. A name without a suffix is a folder, with run.rrd, run.parquet, a
    picture and the LiDAR's scans.
    """

    folder: Path | None
    files: tuple[Path, ...] = ()
    scans: tuple[Path, ...] = ()  # Tables of the LiDAR's scans, beside Parquet files
    force: bool = False
    out_unit: Literal["T", "nT"] | None = None  # Unit of the field in bags. None: T.
    usd_fps: float | None = None  # Frames per second in USD, 0 for one per reading. None: 30.
    robot: str = ""  # Robot whose name becomes part of the file names, in a scene of several
    # Draws run.png in the folder: called with the run, the file and `force`
    picture: Callable[[Driven, Path, bool], None] | None = None

    @classmethod
    def of(cls, out: "list[Path] | tuple[Path, ...]", *, scans: bool = False, **options: Any) -> "Outputs":
        """Outputs by their names; refuses unknown formats and two outputs of one name."""
        folders = [path for path in out if not path.suffix]
        files = tuple(path for path in out if path.suffix)
        if len(folders) > 1:
            raise InputError(
                f"{folders[1]}: a second folder; a run fills one folder, and any number of files"
            )
        for file in files:
            format_to_write(file)
        tables = tuple(_scans_of(file) for file in files if scans and file.suffix.lower() == ".parquet")
        made = cls(folders[0] if folders else None, files, tables, **options)
        if len({target.resolve() for target in made.targets}) < len(made.targets):
            raise InputError("two outputs have one name; give each its own")
        for name, value, takes in (("out_unit", made.out_unit, "units"), ("usd_fps", made.usd_fps, "fps")):
            if value is not None and not any(takes in format_of(file).takes for file in files):
                kind = "a bag" if takes == "units" else "a USD layer"
                raise InputError(f"`{name}` is for {kind}; name one as an output, or drop it", parameter=name)
        return made

    def free(self, robots: Iterable[str] = ()) -> "Outputs":
        """The outputs by names that nothing has yet, also for each of several robots by their names."""
        named, kinds = [*([self.folder] if self.folder else []), *self.files], {f.suffix for f in self.files}
        scans = [".scans.parquet"] if self.scans else []
        ends = [*scans, f"{named[0].suffix}.parts"]
        ends += [f".{robot}{end}" for robot in robots for end in (*kinds, *ends)]
        found = free(*named, beside=ends, force=self.force)
        files = tuple(found[len(found) - len(self.files) :])
        tables = tuple(_scans_of(file) for file in files if scans and file.suffix.lower() == ".parquet")
        return replace(self, folder=found[0] if self.folder else None, files=files, scans=tables)

    @property
    def targets(self) -> list[Path]:
        """Everything that is written."""
        return [*([self.folder] if self.folder else []), *self.files, *self.scans]

    def of_robot(self, robot: str) -> "Outputs":
        """Outputs of one robot of several: run.NAME.rrd in place of run.rrd."""
        files = tuple(_with_name(file, robot) for file in self.files)
        tables = tuple(_scans_of(file) for file in files if self.scans and file.suffix.lower() == ".parquet")
        return replace(self, files=files, scans=tables, robot=robot)

    @contextmanager
    def aside(self) -> Iterator["Outputs"]:
        """The same outputs in temporary places, which replace the targets at the end: all, or none."""
        with ExitStack() as stack:
            stack.enter_context(transaction())
            places: dict[Path, Path] = {}
            for target in self.targets:
                if target.suffix.lower() in USD:  # names its scene by a relative path: written in place, last
                    places[target] = check_free(target, force=self.force)
                else:
                    places[target] = stack.enter_context(output(target, force=self.force))
            if self.folder is not None:
                places[self.folder].mkdir()
            try:
                files, scans = (tuple(map(places.__getitem__, some)) for some in (self.files, self.scans))
                yield replace(self, folder=self.folder and places[self.folder], files=files, scans=scans)
            except InputError as error:
                text = str(error)
                for target, place in places.items():
                    text = text.replace(str(place), str(target))
                raise InputError(text, parameter=error.parameter) from error

    @contextmanager
    def kept(self) -> Iterator[Callable[[Run], None]]:
        """A function that keeps the blocks of a long run until all its outputs are written.

        They are in the folder F.parts of the first output F, and remain there if the run is broken off, or
        its process is killed; `read_run` reads them.
        """
        from magtwin.io.tables import ParquetParts

        parts: list[ParquetParts] = []
        first = self.targets[0] if self.folder is None else _with_name(self.folder, self.robot)

        def keep(block: Run) -> None:
            if not parts:
                parts.append(ParquetParts(first, force=self.force))
            parts[0].append(block)

        yield keep
        for one in parts:
            shutil.rmtree(one.folder)

    def write(self, driven: Driven) -> None:
        """Write the run to every target, each format once."""
        written: dict[str, Path] = {}
        names = () if self.folder is None else IN_FOLDER
        inside = [_with_name((self.folder or Path()) / name, self.robot) for name in names]
        for target in sorted([*inside, *self.files], key=lambda file: file.suffix.lower() in USD):
            if target.suffix.lower() in written:
                shutil.copyfile(written[target.suffix.lower()], target)
                continue
            written[target.suffix.lower()] = target
            takes = format_of(target).takes
            options: dict[str, Any] = {"units": self.out_unit, "fps": self.usd_fps}
            options = {
                name: value or None for name, value in options.items() if value is not None and name in takes
            }
            options |= {"planned": driven.planned, "scans": driven.scans, "force": self.force}
            write_run(driven.run, target, driven.twin, **options)
        if driven.scans is not None:
            from magtwin.io.scans import write_scans

            for file in (*map(_scans_of, inside[1:]), *self.scans):
                write_scans(driven.scans, file, force=self.force)
        if self.folder is not None and self.picture is not None:
            self.picture(driven, _with_name(self.folder / "run.png", self.robot), self.force)


def _scans_of(file: Path) -> Path:
    """The table of scans beside a run's table."""
    return file.with_suffix(".scans.parquet")


def _with_name(file: Path, robot: str) -> Path:
    """A file of one robot of several: run.NAME.rrd for run.rrd; unchanged if the name is ""."""
    return file.with_name(f"{file.stem}.{robot}{file.suffix}") if robot else file
