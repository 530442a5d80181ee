"""`magtwin run` and `magtwin demo`: drive a scene's robot and write what happened."""

import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.terminal import (
    Force,
    Json,
    Seed,
    Session,
    announcer,
    check_suffix,
    print_report,
    progress,
    say,
    silence,
    step,
)
from magtwin.errors import InputError, find

if TYPE_CHECKING:
    from threading import Event

    from magtwin.io.recorder import Sink
    from magtwin.path import Path as Planned
    from magtwin.run.run import Run
    from magtwin.sim.sensors.lidar import Scans
    from magtwin.twin import Twin


@app.command
def demo(
    *,
    out: Path = Path("demo"),
    seed: Seed = 0,
    model_error: bool = True,
    force: Force = False,
    json: Json = False,
) -> None:
    """Author a lab and a TurtleBot 4, drive a figure of eight, log what the magnetometer reads.

    Writes the stages, run.rrd (opens in Rerun), run.parquet and pictures. Takes under a minute.

    Parameters
    ----------
    out
        Folder to make.
    seed
        Seed of all noise.
    model_error
        As for `magtwin run`.
    force
        Replace the folder if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.author.robot import build_robot
    from magtwin.author.scene import author_scene
    from magtwin.files import output, shipped
    from magtwin.twin import scene_from_toml

    steps = announcer(quiet=json)
    with output(out, force=force) as folder:
        steps("Authoring the TurtleBot 4 from its URDF")
        source = shipped("robots", "turtlebot4")
        asset = folder / "robot" / "turtlebot4.usda"
        build_robot(source / "turtlebot4.urdf", source / "robot.toml", asset)
        steps("Authoring the lab around it, with its magnetic map")
        scene = scene_from_toml(shipped("scenes", "lab.toml"))
        scene = replace(scene, robot=replace(scene.robot, asset=asset))
        scene_file = author_scene(scene, folder / "scene")
        report = write_run(
            scene_file,
            "figure8",
            folder,
            metadata={"scene_file": scene_file.relative_to(folder).as_posix()},
            steps=steps,
            seed=seed,
            model_error=model_error,
            speed=0.2,
            title=f"Demo in {out}",
        )
        steps("Taking pictures")
        _picture(scene_file, folder / "lab.png")
    print_report(report, json)
    if not json:
        pictures = ", ".join(str(file) for file in sorted(out.glob("*.png")))
        say(f"\nLook at it:  magtwin view {out / 'run.rrd'}\nPictures:    {pictures}")


@app.command
def run(
    scene: Path,
    *,
    path: str | None = None,
    fit: Annotated[bool, Parameter(negative="")] = False,
    commands: Path | None = None,
    robot: str | None = None,
    meet: Literal["refuse", "flag"] | None = None,
    engine: Literal["kinematic", "newton", "replay"] | None = None,
    replay: Path | None = None,
    controller: Literal["follower", "release", "stanley", "pure_pursuit"] = "follower",
    net: Path | None = None,
    magnetometer: Literal["physical", "neural", "map-only"] | None = None,
    model_error: bool = True,
    seed: Seed = 0,
    session: Session = None,
    speed: float = 0.2,
    duration: float | None = None,
    rate_hz: float | None = None,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
    out: Path | None = None,
    rrd: Path | None = None,
    parquet: Path | None = None,
    bag: Path | None = None,
    csv: Path | None = None,
    usd: Path | None = None,
    units: Literal["T", "nT"] | None = None,
    usd_fps: Annotated[float | None, Parameter(name="--usd-fps")] = None,
    scans: bool = False,
    live: Annotated[bool, Parameter(negative="")] = False,
    viewer: str | None = None,
    pace: float | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Drive a scene's robot along a path and write what happened.

    With no output named, writes the folder "run".

    Parameters
    ----------
    scene
        USD stage to drive in.
    path
        sine, fast_sine, lawnmower, split_lawnmower, figure8, narrow_figure8, continuous_cycle,
        curvilinear, curvilinear_2; A to E, the cases of the paper's Table 1; random, a human-like driver
        who goes where the seed takes them, for a minute or --duration; or a CSV file of x,y [m]. Named paths
        are scaled to the floor. Unless given, what the scene says, or else figure8.
    fit
        Move the path and make it smaller if it does not fit the floor or runs into something.
    commands
        CSV file of t,v,w [s, m/s, rad/s] to drive by in place of a path, as magtwin drive leaves it.
    robot
        Robot, in a scene of several, that --path, --commands or --replay are for, and whose run alone is
        written; the others drive what the scene says. Unless given, every run is written, under names such
        as run.NAME.rrd.
    meet
        What becomes of robots that run into each other: refuse, unless given, or flag it as a bump.
    engine
        What moves the robot: kinematic (default), newton for physics in the stage itself, or replay.
    replay
        Run, in any format, to drive once more as it was recorded, with the sensors as they are set now.
    controller
        What drives: magtwin's follower; that of the released package, which drives the real robot; Stanley's;
        or pure pursuit.
    net
        Weights to use in place of the scene's (.safetensors or .pth), for a neural magnetometer; "none" for
        a physical one.
    magnetometer
        What it reads, in place of what the scene says: the exact field (physical), the map and what a
        network predicts (neural), or the map alone (map-only).
    model_error
        Let readings of a neural magnetometer be off what its network predicts, as they were on recordings
        that it never saw. --no-model-error: they are the prediction and the sensor's own noise.
    seed
        Seed of all noise. The same seed gives the same bytes.
    session
        Number of a session to draw from the seed: charge, IMU zero, wheels, odometry and the robot's own
        field differ from session to session. "survey" takes the robot as it was when the map was surveyed.
        Default: 0.
    speed
        Forward speed where the path is straight [m/s].
    duration
        How long to drive [s]; once along the path unless given, longer gives further laps.
    rate_hz
        Magnetometer readings a second [Hz]; the scene's unless given.
    lidar
        Whether the LiDAR follows its schedule, or stays on or off.
    outside
        What the map reads outside its extent: nan, the nearest value inside, or a refusal.
    out
        Folder to make, for run.rrd, run.parquet and run.png.
    rrd
        Rerun recording to write.
    parquet
        Parquet table to write.
    bag
        rosbag2 to write: a .mcap or .db3 file, or a folder.
    csv
        CSV table to write.
    usd
        Layer over the scene to write, in which the run plays: .usd, .usda or .usdc.
    units
        Unit of the field in the bag: T, as ROS has it, unless given; nT, as the released package publishes
        it.
    usd_fps
        Frames a second in USD [Hz]; 30 unless given, 0 for one at every reading.
    scans
        Cast the LiDAR's rays while it spins: into the recording and the bag, and into a table beside the
        run's, such as run.scans.parquet beside run.parquet.
    live
        Show the run in a Rerun viewer as if it went on now, where a window can be opened; recordings, tables
        and bags grow meanwhile, under names with "partial" or "parts" in them. Ctrl-C ends it, and what was
        driven until then is kept.
    viewer
        Address of a Rerun viewer that shows it live, such as rerun+http://127.0.0.1:9876/proxy.
    pace
        Simulated seconds a second, where it is shown live; 1 unless given.
    force
        Replace what exists.
    json
        Print the summary as JSON.
    """
    from magtwin.author.scene import robots_in
    from magtwin.files import existing

    existing(scene, "scene")
    given = {"rrd": rrd, "parquet": parquet, "bag": bag, "csv": csv, "usd": usd}
    files = {kind: file for kind, file in given.items() if file is not None}
    if out is None and not files:
        out = Path("run")
    beside = parquet.with_suffix(".scans.parquet") if scans and parquet is not None else None
    targets = [target for target in (out, *files.values(), beside) if target is not None]
    if len({target.resolve() for target in targets}) < len(targets):
        raise InputError("two outputs have one name; give each its own")
    for kind, file in files.items():
        if kind != "bag" or file.suffix:
            check_suffix(file, _SUFFIXES[kind], f"what --{kind} writes")
    for option, value, needs, there in (
        ("units", units, "a bag; give --bag", bag),
        ("usd-fps", usd_fps, "a layer; give --usd", usd),
        ("pace", pace, "a run that is shown live; give --live", live or viewer),
    ):
        if value is not None and not there:
            raise InputError(f"--{option} is for {needs}, or drop it")
    if live and viewer:
        raise InputError("--live opens a viewer and --viewer names one that is there; give one of them")
    if viewer:
        from magtwin.io.rerun.live import check_listens

        check_listens(viewer)
    if pace is not None and not pace > 0:
        raise InputError(f"--pace must be above 0 simulated seconds a second, got {pace:g}")
    way = _way(path, commands, engine, replay)
    if controller != "follower" and (commands or replay or path == "random"):
        raise InputError(f"--controller {controller} follows a path, and {way} is none; drop one")
    if speed != 0.2 and (commands or replay):
        raise InputError(f"--speed is for a path or a driver, and {way} has speeds of its own; drop one")
    if fit and (commands or replay or path == "random"):
        raise InputError(f"--fit is for a path, and {way} is none; drop it")
    if engine == "newton":
        from magtwin.sim.engines.newton import check_installed

        check_installed()
    options: dict[str, Any] = {
        "commands": commands,
        "replay": replay,
        "engine": "newton" if engine == "newton" else "kinematic",
        "network": net,
        "magnetometer": magnetometer,
        "model_error": model_error,
        "seed": seed,
        "session": session,
        "speed": speed,
        "duration_s": duration,
        "rate_hz": rate_hz,
        "lidar": lidar,
        "outside": outside,
        "controller": controller,
    }
    wanted = _Outputs(out, files, beside, force=force, units=units, usd_fps=usd_fps)
    robots = robots_in(scene)
    if robot is not None:
        find("robot", robot, robots)
    if len(robots) > 1:
        if live or viewer:
            raise InputError(f"--live and --viewer show one robot, and {scene} has {', '.join(robots)}")
        if robot is None and (path or commands or replay):
            raise InputError(f"which of {', '.join(robots)} is to drive {way}? say it with --robot NAME")
        if fit and robot is None:
            raise InputError(f"whose path is to be fitted, of {', '.join(robots)}? say it with --robot NAME")
        _run_together(
            scene, wanted, robot=robot, path=path, fit=fit, meet=meet, scans=scans, quiet=json, **options
        )
        return
    if meet is not None:
        raise InputError(f"--meet is for several robots, and {scene} has one; drop it")
    if not (path or commands or replay):
        way = str(robots[next(iter(robots))] or way)
    shown = _Live(window=live, address=viewer, pace=pace or 1.0) if live or viewer else None
    step("Opening the scene")
    with ExitStack() as stack:
        written = wanted.begun() if shown else stack.enter_context(wanted.aside())
        what = _drive(scene, way, steps=announcer(quiet=json), scans=scans, fit=fit, **options)
        if shown:
            what = _show(what, shown, written, quiet=json)
        written.write(what, steps=announcer(quiet=json), recorded=shown is not None)
    print_report(what.run.report(f"{way} in {scene}"), json)
    if not json:
        say("Wrote " + ", ".join(map(str, targets)))


_SUFFIXES = {
    "rrd": (".rrd",),
    "parquet": (".parquet",),
    "bag": (".mcap", ".db3"),
    "csv": (".csv",),
    "usd": (".usd", ".usda", ".usdc"),
}
"""How the names of files end, by the option that names them; that of a bag may have no ending."""

_RECORDED = ("rrd", "parquet", "bag")
"""What grows while a run is shown live."""


def write_run(
    scene_file: Path, path: str, folder: Path, *, steps: Any, title: str, scans: bool = False, **options: Any
) -> Any:
    """Run a scene and write run.rrd, run.parquet and run.png into a folder; returns the run's report.

    Args:
        scene_file: The scene.
        path: What is driven, in a word: a path, unless `commands` or `replay` are among the options.
        folder: One that is there.
        steps: Told what is being done.
        title: Title of the report.
        scans: Whether the LiDAR's rays are cast.
        options: `commands`, `replay`, `metadata` that say where files will lie as seen from the run's own,
        and
            those of `open_twin` and `simulate`.
    """
    driven = _drive(scene_file, path, steps=steps, scans=scans, **options)
    _Outputs(folder, {}, None).write(driven, steps=steps)
    return driven.run.report(title)


@dataclass(frozen=True)
class _Driven:
    """A run, and what belongs to it."""

    run: "Run"
    twin: "Twin"
    planned: "Planned | None"
    scans: "Scans | None"


def _drive(
    scene_file: Path,
    path: str,
    *,
    steps: Any,
    scans: bool = False,
    commands: Path | None = None,
    replay: Path | None = None,
    network: Path | None = None,
    magnetometer: Literal["physical", "neural", "map-only"] | None = None,
    model_error: bool = True,
    seed: int = 0,
    session: int | Literal["survey"] | None = None,
    fit: bool = False,
    metadata: Mapping[str, str | int] = MappingProxyType({}),
    **options: Any,
) -> _Driven:
    """Run a scene: along `path`, unless commands or a run say otherwise.

    `metadata` say where files will lie as seen from the run's own, for those that move with it.
    """
    from magtwin.io.formats import read_run
    from magtwin.sim.motion.commands import read_commands
    from magtwin.sim.motion.way import way_of
    from magtwin.twin import in_session, open_twin, room_of, scan, simulate

    planned: Any = None
    what: Any = path
    if commands is not None:
        what = read_commands(commands)
    elif replay is not None:
        what = read_run(replay)
    else:
        way_of(path)  # refuses a name or file that is none before the scene is opened
    twin = open_twin(scene_file, network=network, magnetometer=magnetometer, model_error=model_error)
    twin = in_session(twin, session, seed=seed)
    if commands is None and replay is None and path != "random":
        what = planned = way_of(path, room_of(twin), fit=fit)
        _say_placing(planned, steps)
    if commands is not None and what.beyond(twin.scene.robot.drive):
        print(f"  {what.beyond(twin.scene.robot.drive)}", file=sys.stderr)  # noqa: T201
    steps(f"Driving {planned.name if planned else path}")
    if replay is not None:
        metadata = {"replay_file": replay.as_posix(), **metadata}
    slow = options.get("engine") == "newton"
    with progress("Driving in Newton", "steps") if slow else nullcontext() as advance:
        result = simulate(twin, what, seed=seed, progress=advance, **options).with_metadata(**metadata)
    seen = None
    if scans:
        steps("Casting the LiDAR's rays")
        seen = scan(twin, result, seed=seed)
    return _Driven(result, twin, planned, seen)


def _say_placing(path: Any, steps: Any) -> None:
    """Tell how a path was brought onto the floor, where it was."""
    if path.placing:
        scale_x, scale_y, x, y = path.placing
        scale = f"{scale_x:.2g}" if scale_x == scale_y else f"{scale_x:.2g} in x and {scale_y:.2g} in y"
        how = [f"scaled by {scale} from its 6 x 3.5 m floor"] if (scale_x, scale_y) != (1, 1) else []
        how += [f"moved by ({x:.2f}, {y:.2f}) m"] if max(abs(x), abs(y)) >= 0.005 else []
        steps(f"Path {path.name} is {' and '.join(how)} to fit this floor and what stands on it")


def _run_together(
    scene_file: Path,
    outputs: "_Outputs",
    *,
    robot: str | None,
    path: str | None,
    fit: bool,
    meet: Literal["refuse", "flag"] | None,
    scans: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Drive the robots of a scene of several, and write a run of each, or of the one that is named."""
    from magtwin.io.formats import read_run
    from magtwin.path import Path as Planned
    from magtwin.report import Report
    from magtwin.sim.motion.commands import read_commands
    from magtwin.sim.motion.way import way_of
    from magtwin.twin import led_by, open_twin, room_of, scan, simulate_robots

    steps = announcer(quiet=quiet)
    if options.pop("engine") == "newton":
        raise InputError(f"--engine newton drives one robot by itself, and {scene_file} has several; drop it")
    commands, replay = options.pop("commands"), options.pop("replay")
    opening = {name: options.pop(name) for name in ("network", "magnetometer", "model_error")}
    twin = open_twin(scene_file, **opening)
    ways: dict[str, Any] = {one.robot.name: one.path or "figure8" for one in twin.scene.robots}
    if robot is not None and (commands or replay or path):
        ways[robot] = read_commands(commands) if commands else read_run(replay) if replay else path
    ways = {
        name: way_of(way, room_of(led_by(twin, name)), fit=fit and name == robot)
        for name, way in ways.items()
    }
    names = list(ways) if robot is None else [robot]
    with ExitStack() as stack:
        written = {}
        folder = stack.enter_context(replace(outputs, files={}, scans=None).aside()).folder
        for name in names:
            own = outputs if robot else outputs.of_robot(name)
            own = stack.enter_context(replace(own, folder=None).aside())
            written[name] = replace(own, folder=folder)
        steps(f"Driving {', '.join(ways)}")
        runs = simulate_robots(twin, ways, robots=names, meet=meet or "refuse", **options)
        for name, run in runs.items():
            own_twin = led_by(twin, name)
            seen = scan(own_twin, run, seed=options["seed"]) if scans else None
            planned = ways[name] if isinstance(ways[name], Planned) else None
            written[name].write(_Driven(run, own_twin, planned, seen), steps=steps)
    reports = {name: run.report(name) for name, run in runs.items()}
    figures = tuple(replace(f, name=f"{n}: {f.name}") for n, r in reports.items() for f in r.figures)
    print_report(
        Report(f"{', '.join(names)} in {scene_file}", figures, {n: r.metadata for n, r in reports.items()}),
        quiet,
    )
    if not quiet:
        each = [outputs if robot else outputs.of_robot(name) for name in names]
        files = [file for own in each for file in (*own.files.values(), own.scans) if file is not None]
        say("Wrote " + ", ".join(map(str, [*([outputs.folder] if outputs.folder else []), *files])))


@dataclass(frozen=True)
class _Outputs:
    """What is to be written of a run, and where."""

    folder: Path | None
    """For run.rrd, run.parquet and run.png, and the LiDAR's scans where they are cast."""
    files: Mapping[str, Path]
    """Files by the option that names them."""
    scans: Path | None
    force: bool = False
    units: Literal["T", "nT"] | None = None
    usd_fps: float | None = None
    """Frames a second in USD; 0 for one at every reading, none for as many as it has unless told."""
    robot: str = ""
    """Name of one robot of several, that goes into the names of files."""

    def of_robot(self, robot: str) -> "_Outputs":
        """Those of one robot of several: run.NAME.rrd beside run.rrd."""
        files = {kind: _with_name(file, robot) for kind, file in self.files.items()}
        return replace(self, files=files, scans=self.scans and _with_name(self.scans, robot), robot=robot)

    @contextmanager
    def aside(self) -> Iterator["_Outputs"]:
        """The same in places aside, which take those of the outputs at the end: all, or none."""
        from magtwin.files import check_free, output

        with ExitStack() as stack:
            places: dict[Path, Path] = {}
            for target in (self.folder, *self.files.values(), self.scans):
                if target is not None and target != self.files.get("usd"):
                    places[target] = stack.enter_context(output(target, force=self.force))
            if (
                "usd" in self.files
            ):  # it names its scene by a relative path, and is written in its place, last
                places[self.files["usd"]] = check_free(self.files["usd"], force=self.force)
            if self.folder is not None:
                places[self.folder].mkdir()
            try:
                yield replace(
                    self,
                    folder=None if self.folder is None else places[self.folder],
                    files={kind: places[file] for kind, file in self.files.items()},
                    scans=None if self.scans is None else places[self.scans],
                )
            except InputError as error:
                text = str(error)
                for target, place in places.items():
                    text = text.replace(str(place), str(target))
                raise InputError(text) from error

    def begun(self) -> "_Outputs":
        """The same, in place: files grow there, under names that tell so."""
        from magtwin.files import check_free
        from magtwin.io.recorder import partial_of

        unfinished = [partial_of(path) for path in (*self.of("rrd"), *self.of("bag"))]
        for target in (self.folder, *self.files.values(), self.scans, *unfinished):
            if target is not None:
                check_free(target, force=self.force)
        return self

    def of(self, kind: str) -> list[Path]:
        """Where a kind of file goes."""
        inside = self.folder is not None and kind in ("rrd", "parquet")
        first = [_with_name(self.folder / f"run.{kind}", self.robot)] if inside and self.folder else []
        return first + ([self.files[kind]] if kind in self.files else [])

    def sinks(self, driven: _Driven) -> list["Sink"]:
        """What takes the run as it comes."""
        from magtwin.io.bags.rosbag import BagWriter
        from magtwin.io.rerun.live import RrdWriter
        from magtwin.io.tables import ParquetParts

        known: dict[str, Any] = {"expected": driven.run, "planned": driven.planned, "scans": driven.scans}
        tables = [ParquetParts(path, force=self.force) for path in self.of("parquet")[:1]]
        recordings = [RrdWriter(path, driven.twin, **known, force=self.force) for path in self.of("rrd")[:1]]
        options: dict[str, Any] = {"units": self.units or "T", "scans": driven.scans, "force": self.force}
        bags = [BagWriter(path, driven.twin, **options) for path in self.of("bag")]
        return [*recordings, *tables, *bags]

    def write(self, driven: _Driven, *, steps: Any, recorded: bool = False) -> None:
        """Write all, each kind once; what was `recorded` as it went on is there already."""
        import shutil

        from magtwin.io.formats import write_run as write

        if driven.scans is not None:
            from magtwin.io.scans import write_scans

            inside = (
                [] if self.folder is None else [_with_name(self.folder / "run.scans.parquet", self.robot)]
            )
            for target in [*inside, *([] if self.scans is None else [self.scans])]:
                write_scans(driven.scans, target, force=self.force)
        steps("Writing the run")
        for kind in _SUFFIXES:
            options: dict[str, Any] = {}
            if kind == "bag" and self.units is not None:
                options["units"] = self.units
            if kind == "usd" and self.usd_fps is not None:
                options["fps"] = self.usd_fps or None
            for number, target in enumerate(self.of(kind)):
                if number:
                    shutil.copyfile(self.of(kind)[0], target)
                elif not recorded or kind not in _RECORDED:
                    write(
                        driven.run,
                        target,
                        driven.twin,
                        planned=driven.planned,
                        scans=driven.scans,
                        force=self.force,
                        **options,
                    )
        if self.folder:
            from magtwin.figures.plotting import plot_run

            planned = driven.planned
            plot_run(
                driven.run,
                driven.twin.field,
                _with_name(self.folder / "run.png", self.robot),
                planned=planned.p_xy if planned else None,
                force=self.force,
            )


def _with_name(file: Path, robot: str) -> Path:
    """A file of one robot of several: run.NAME.scans.parquet for run.scans.parquet; as it is for ""."""
    if not robot:
        return file
    ending = ".scans.parquet" if file.name.endswith(".scans.parquet") else file.suffix
    return file.with_name(f"{file.name.removesuffix(ending)}.{robot}{ending}")


@dataclass(frozen=True)
class _Live:
    """How a run is shown while it goes on."""

    window: bool
    """Whether in a window of its own."""
    address: str | None
    """Address of a viewer that is there already."""
    pace: float
    """Simulated seconds a second."""


def _show(driven: _Driven, live: _Live, outputs: _Outputs, *, quiet: bool) -> _Driven:
    """Let a run go on in step with the clock, seen and recorded; what came of it until its end, or Ctrl-C."""
    from magtwin.io.recorder import Recorder, in_step
    from magtwin.io.rerun.live import LiveViewer
    from magtwin.io.rerun.viewer import live_viewer

    run, address = driven.run, live.address
    with ExitStack() as stack:
        stop = stack.enter_context(_ctrl_c())
        if live.window:
            try:
                address, _ = stack.enter_context(live_viewer())
            except InputError as error:
                print(f"  no view: {error}", file=sys.stderr)  # noqa: T201
        viewers = []
        if address is not None:
            known: dict[str, Any] = {"expected": run, "planned": driven.planned, "scans": driven.scans}
            viewers.append(LiveViewer(address, driven.twin, **known))
        sinks = outputs.sinks(driven)
        advance = stack.enter_context(progress("Live", "s"))
        with Recorder(sinks, viewers) as recorder:
            for block in in_step(run, live.pace, stop=stop):
                recorder.append(block)
                advance(round(float(block["t"][-1])), round(float(run["t"][-1])), "Ctrl-C ends it")
        if not recorder.rows:
            raise InputError("ended before the first reading; nothing is written")
        if live.window and address is not None and sys.stdin.isatty():
            with silence():
                _wait(address, stop)
    rows, scans = recorder.rows, driven.scans
    if rows < run.rows:
        run = run.take(slice(rows))
        if scans is not None:
            seen = scans.t <= run["t"][-1]
            scans = type(scans)(*(getattr(scans, f.name)[seen] for f in fields(scans)))
    return replace(driven, run=run, scans=scans)


def _wait(address: str, stop: "Event") -> None:
    """Leave a viewer on the screen until it is closed, or Ctrl-C."""
    from magtwin.io.rerun.live import check_listens

    if not stop.is_set():
        print("  The run has ended; close the viewer, or press Ctrl-C", file=sys.stderr)  # noqa: T201
    while not stop.wait(0.5):
        try:
            check_listens(address)
        except InputError:
            return


@contextmanager
def _ctrl_c() -> Iterator["Event"]:
    """What Ctrl-C sets; the second one ends the process as ever."""
    import signal
    from threading import Event, current_thread, main_thread

    stop = Event()
    if current_thread() is not main_thread():
        yield stop
        return
    before = signal.getsignal(signal.SIGINT)

    def end(*_: object) -> None:
        stop.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, end)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


def _way(path: str | None, commands: Path | None, engine: str | None, replay: Path | None) -> str:
    """What is driven, in a word; refused where more than one thing is named."""
    named = [
        f"--{option}"
        for option, value in (("path", path), ("commands", commands), ("replay", replay))
        if value is not None
    ]
    if len(named) > 1:
        raise InputError(f"{' and '.join(named)} each say what to drive; give one of them")
    if engine == "replay" and replay is None:
        raise InputError("the engine replay needs the run that it drives once more: --replay RUN")
    if engine not in (None, "replay") and replay is not None:
        raise InputError(
            f"--replay drives a run as it was recorded, which --engine {engine} cannot; drop one"
        )
    return path or str(commands or replay or "figure8")


def _picture(scene_file: Path, out: Path) -> None:
    """A picture of a stage; where no OpenGL is to be had, says so and goes on."""
    from magtwin.figures.pictures import picture_of_stage

    try:
        picture_of_stage(scene_file, out)
    except InputError as error:
        print(f"  no picture of the stage: {error}", file=sys.stderr)  # noqa: T201
