"""`magtwin run` and `magtwin demo`."""

import sys
import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from magtwin.cli import options as opt
from magtwin.cli.app import app
from magtwin.cli.settings import RUN, RunOptions, RunSettings
from magtwin.cli.terminal import Done, named, note, progress, step
from magtwin.errors import InputError, find

if TYPE_CHECKING:
    from magtwin.io.outputs import Driven, Outputs

Outs = Annotated[list[Path] | None, Parameter(consume_multiple=False)]

SHOWN = ("duration", "distance driven", "readings", "b_total_nt", "error")
"""Figures of a run that are printed."""


@app.command
def demo(*, out: opt.Folder = Path("demo"), seed: opt.Seed = 0, force: opt.Force = False) -> Done:
    """Author a lab and a TurtleBot 4, drive a figure of eight and log what the magnetometer reads.

    It writes the stages, run.html (plays the run in a browser), run.rrd (opens in Rerun), run.parquet and
    pictures, in less than a minute.
    """
    from magtwin.author.robot import build_robot
    from magtwin.author.scene import author_scene
    from magtwin.figures.pictures import picture_of_stage
    from magtwin.figures.reporting import report_runs
    from magtwin.files.file import shipped
    from magtwin.files.outputs import output
    from magtwin.io.outputs import Outputs, drive
    from magtwin.twin import scene_from_toml

    out = named(out, force=force)
    with output(out, force=force) as folder:
        step("Authoring the TurtleBot 4 from its URDF")
        source = shipped("robots", "turtlebot4")
        asset = folder / "robot" / "turtlebot4.usda"
        build_robot(source / "turtlebot4.urdf", source / "robot.toml", asset)
        step("Authoring the lab around it, with its magnetic map")
        scene = scene_from_toml(shipped("scenes", "lab.toml"))
        scene = replace(scene, robot=replace(scene.robot, asset=asset))
        scene_file = author_scene(scene, folder / "scene")
        relative = {"scene_file": scene_file.relative_to(folder).as_posix()}
        driven = drive(scene_file, seed=seed, metadata=relative, report=step)
        step("Writing the run and pictures")
        Outputs(folder, picture=save_picture).write(driven)
        report_runs([folder / "run.parquet"], folder / "run.html")
        try:
            picture_of_stage(scene_file, folder / "lab.png")
        except InputError as error:  # OpenGL is missing
            note(f"no picture of the stage: {error}")
    pictures = ", ".join(file.name for file in sorted(out.glob("*.png")))
    text = f"open {out / 'run.html'} in a browser; pictures {pictures}"
    told, view = driven.run.report("figure8 in the lab"), ("magtwin", "view", out / "run.rrd")
    return Done(told, out, SHOWN, text=text, rest=f"magtwin info {out}", next=(view,))


@app.command
def run(
    scene: opt.Scene,
    *,
    path: str | None = None,
    fit: opt.Flag = False,
    lab: opt.Lab = "",
    map_layer: opt.MapLayer = None,
    robot: str | None = None,
    engine: Literal["kinematic", "newton"] = "kinematic",
    network: opt.Network = None,
    magnetometer: opt.Magnetometer = None,
    plant: opt.Plant = None,
    session: opt.Session = None,
    seed: opt.Seed = 0,
    speed: float = 0.2,
    duration_s: float | None = None,
    live: opt.Flag = False,
    scans: opt.Flag = False,
    out: Outs = None,
    settings: RunOptions = RUN,
    force: opt.Force = False,
) -> Done:
    """Drive a scene's robot along a path and write the run.

    Rarer settings, such as rate_hz, lidar and controller, are keys of [run] in magtwin.toml: docs/runs.md.

    Parameters
    ----------
    path
        sine, fast_sine, lawnmower, split_lawnmower, figure8, narrow_figure8, continuous_cycle, loops,
        curvilinear, curvilinear_2; coverage (all of the floor that can be reached); A to E
        (Table 1 of Penumarti et al. 2025); random (like a human driver,
        for one minute by default); a CSV file of x,y [m]; a CSV file of commands t,v,w
        [s, m/s, rad/s], as `magtwin drive` writes; or a run, whose motion is repeated. Named paths are scaled
        to the floor. Default: the path of the scene, else figure8.
    fit
        Move and shrink the path until it fits the floor and its obstacles.
    robot
        In a scene of several robots: the robot that --path applies to. Only its run is written; the other
        robots drive their paths in the scene. Default: write every run, as run.NAME.rrd and so on.
    engine
        What moves the robot: kinematic (motion without forces), or newton (the physics engine Newton).
    speed
        Forward speed on straight parts [m/s].
    duration_s
        Duration of the run [s]. If it is longer than one pass along the path, the robot drives further laps.
        Default: once along the path.
    out
        Folder to make, with run.rrd, run.parquet and run.png, or file to write, in the format of its suffix:
        .rrd, .parquet, .mcap, .csv, .npz, .usd, .usda or .usdc. May be repeated. Default: the folder run.
    scans
        Cast the LiDAR's rays while it spins. Files .rrd and .mcap contain the scans. For .parquet, .csv and
        .npz, the scans go into a second file such as run.scans.parquet.
    live
        Show the run in a Rerun viewer, in step with the clock, once it is written. Ctrl-C ends it.
    """
    from magtwin.files.kinds import scene_file
    from magtwin.io.outputs import Outputs, drive, driven_by
    from magtwin.run.run import Run
    from magtwin.usd.scene import robots_in

    scene = scene_file(scene)
    formats: Any = {"scans": scans, "out_unit": settings.out_unit, "usd_fps": settings.usd_fps}
    outputs = Outputs.of(out or [Path("run")], force=force, picture=save_picture, **formats)
    what = None if path is None else driven_by(path)
    options: dict[str, Any] = {"seed": seed, "session": session, "plant": plant, "speed": speed}
    options |= {"duration_s": duration_s, "network": network, "magnetometer": magnetometer, "fit": fit}
    options |= {name: getattr(settings, name) for name in SIMULATED}
    options |= {"lab": lab, "map_layer": map_layer, "scans": scans}
    _check(what, path or "figure8", settings, options, live=live, engine=engine)
    robots = robots_in(scene, lab=lab)
    if robot is not None:
        find("robot", robot, robots)
    if len(robots) > 1:
        names = ", ".join(robots)
        if live or settings.viewer:
            raise InputError(f"--live and `viewer` show one robot, and {scene} has {names}")
        if engine == "newton":
            raise InputError(f"--engine newton drives one robot by itself, and {scene} has {names}; drop it")
        if robot is None and (path or fit):
            raise InputError(f"which of {names} is to drive {path or 'figure8'}? name it with --robot NAME")
        outputs = outputs.free(() if robot else robots)
        return _run_robots(scene, outputs, what, robot=robot, meet=settings.meet or "refuse", **options)
    outputs = outputs.free()
    if settings.meet is not None:
        raise InputError(f"`meet` is for several robots, and {scene} has one; drop it")
    if what is None:
        what = path = str(next(iter(robots.values())) or "figure8")
    step("Opening the scene")
    how, unit = (" in Newton", "steps") if engine == "newton" else ("", "")
    options["metadata"] = {"replay_file": Path(str(path)).as_posix()} if isinstance(what, Run) else {}
    with outputs.kept() as keep, outputs.aside() as places:
        with progress(f"Driving {path}{how}", unit) as advance:
            options |= {"progress": advance, "each": keep, "report": step, "tell": note}
            driven = drive(scene, what, engine=engine, **options)
        step("Writing the run")
        places.write(driven)
    if live or settings.viewer:
        _show(driven, settings.viewer, settings.pace or 1.0)
    made, told = outputs.targets, driven.run.report(f"{path} in {scene.stem}")
    return Done(told, tuple(made), SHOWN, rest=f"magtwin info {made[0]}", next=look_at(made))


def look_at(written: list[Path]) -> list[tuple[object, ...]]:
    """What to type to see a run: its recording, and its page."""
    from magtwin.io.outputs import IN_FOLDER

    inside = [[out] if out.suffix else [out / name for name in IN_FOLDER] for out in written]
    files = [file for each in inside for file in each]
    recording = next((file for file in files if file.suffix == ".rrd"), None)
    table = next((file for file in files if file.suffix != ".rrd"), files[0])
    shown: list[tuple[object, ...]] = [] if recording is None else [("magtwin", "view", recording)]
    return [*shown, ("magtwin", "report", table)]


SIMULATED = ("model_error", "tracking_error", "lidar", "outside", "rate_hz", "controller")
"""Settings that are parameters of `open_twin` and `simulate`."""


def _check(
    what: Any, path: str, settings: RunSettings, options: dict[str, Any], *, live: bool, engine: str
) -> None:
    """Refuse options that are for another way of driving, and those that would be refused late."""
    from magtwin.run.run import Run
    from magtwin.sim.motion.drive_input import check_path
    from magtwin.sim.runs.simulate import check_asked

    if live and settings.viewer:
        raise InputError("--live opens a viewer and `viewer` names one; give one of them")
    if settings.pace is not None:
        if not (live or settings.viewer):
            raise InputError("`pace` is for a run that is shown; give --live, or drop it")
        opt.check_pace(settings.pace)
    controller, newton = settings.controller, engine == "newton"
    free = what is not None and not isinstance(what, str)  # driven without a path
    no_path = free or what == "random"
    for given, option, fault in (
        (controller != "follower" and no_path, f"`controller={controller}`", "follows a path"),
        (options["speed"] != 0.2 and free, "--speed", "is for a path or a driver"),
        (options["fit"] and no_path, "--fit", "is for a path"),
        (newton and isinstance(what, Run), "--engine newton", "cannot repeat the motion of a run"),
    ):
        if given:
            raise InputError(f"{option} {fault}, and {path} is none; drop one")
    check_asked(options["duration_s"], settings.rate_hz, options["speed"])
    if isinstance(what, str):
        check_path(what)
    if newton:
        from magtwin.sim.engines.newton import check_installed

        check_installed()
    if settings.viewer:
        from magtwin.io.rerun.live import check_listens

        check_listens(settings.viewer)


def save_picture(driven: "Driven", out: Path, force: bool) -> None:
    """Draw run.png: the path over the map, and what the map lacks along it."""
    from magtwin.figures.canvas import save
    from magtwin.figures.maps import FloorPlan
    from magtwin.figures.runs import draw_run

    planned = driven.planned.p_xy if driven.planned else None
    plan = FloorPlan.of(driven.twin.scene, driven.twin.obstacles)
    save(draw_run(driven.run, driven.twin.field, planned, plan), out, force=force)


def _run_robots(
    scene: Path,
    outputs: "Outputs",
    what: Any,
    *,
    robot: str | None,
    meet: Literal["refuse", "flag"],
    scans: bool,
    fit: bool,
    **options: Any,
) -> Done:
    """Drive the robots of a scene of several, and write the run of each, or of the one that is named."""
    from magtwin.io.outputs import OPENING, Driven
    from magtwin.path import Path as Planned
    from magtwin.report.report import Report
    from magtwin.sim.motion.drive_input import drive_input
    from magtwin.twin import led_by, open_twin, room_of, scan, simulate_robots

    twin = open_twin(scene, **{name: options.pop(name) for name in OPENING})
    ways: dict[str, Any] = {spec.robot.name: spec.path or "figure8" for spec in twin.scene.robots}
    if robot is not None and what is not None:
        ways[robot] = what
    ways = {
        name: drive_input(way, room_of(led_by(twin, name)), fit=fit and name == robot)
        for name, way in ways.items()
    }
    names = list(ways) if robot is None else [robot]
    own = {name: outputs if robot else outputs.of_robot(name) for name in names}
    with ExitStack() as stack:
        kept = {name: stack.enter_context(own[name].kept()) for name in names}
        folder = stack.enter_context(replace(outputs, files=(), scans=()).aside()).folder
        places = {}
        for name in names:
            aside = stack.enter_context(replace(own[name], folder=None).aside())
            places[name] = replace(aside, folder=folder)
        with progress(f"Driving {', '.join(ways)}") as advance:
            options |= {"robots": names, "meet": meet, "each": lambda name, block: kept[name](block)}
            runs = simulate_robots(twin, ways, progress=advance, **options)
        step("Writing the runs")
        for name, run in runs.items():
            its = led_by(twin, name)
            planned = ways[name] if isinstance(ways[name], Planned) else None
            seen = scan(its, run, seed=options["seed"]) if scans else None
            places[name].write(Driven(run, its, planned, seen))
    reports = {name: run.report(name) for name, run in runs.items()}
    figures = tuple(replace(f, name=f"{n}: {f.name}") for n, r in reports.items() for f in r.figures)
    metadata = {name: report.metadata for name, report in reports.items()}
    files = dict.fromkeys(target for each in own.values() for target in each.targets)
    report = Report(f"{', '.join(names)} in {scene.stem}", figures, metadata)
    shown = [f"{name}: {figure}" for figure in ("distance driven", "error") for name in names]
    return Done(report, tuple(files), shown, next=look_at([*files]))


def _show(driven: "Driven", address: str | None, pace: float) -> None:
    """Show a run until its end or Ctrl-C, in a viewer at an address or in a window."""
    from magtwin.io.rerun.live import check_listens, play
    from magtwin.io.rerun.viewer import live_viewer

    with suppress(KeyboardInterrupt), ExitStack() as stack:
        try:
            at = address or stack.enter_context(live_viewer())[0]
            with progress("Live", "s") as advance:
                shown: dict[str, Any] = {"planned": driven.planned, "scans": driven.scans}
                play(driven.run, driven.twin, at, pace=pace, progress=advance, **shown)
            if address is None and sys.stdin.isatty():
                note("The run has ended; close the viewer, or press Ctrl-C")
                while True:
                    time.sleep(0.5)
                    check_listens(at)
        except InputError as error:  # no window can be opened, or the viewer was closed
            note(f"no view: {error}")
