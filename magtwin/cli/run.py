"""`magtwin run` and `magtwin demo`: drive a scene's robot and write what happened."""

import sys
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

from magtwin.cli.app import app
from magtwin.cli.terminal import Force, Json, Seed, announcer, print_report, say
from magtwin.names import RefusedError


@app.command
def demo(*, out: Path = Path("demo"), seed: Seed = 0, force: Force = False, json: Json = False) -> None:
    """Author a lab and a TurtleBot 4, drive a figure of eight, log what the magnetometer reads.

    Writes the stages, run.rrd (opens in Rerun), run.parquet and pictures. Takes under a minute.

    Parameters
    ----------
    out
        Folder to make.
    seed
        Seed of all noise.
    force
        Replace the folder if it exists.
    json
        Print the summary as JSON.
    """
    from magtwin.files import output, shipped
    from magtwin.twin import scene_from_toml
    from magtwin.usd.robot import build_robot
    from magtwin.usd.scene import author_scene

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
            facts={"scene_file": scene_file.relative_to(folder).as_posix()},
            steps=steps,
            seed=seed,
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
    commands: Path | None = None,
    engine: Literal["kinematic", "newton", "replay"] | None = None,
    replay: Path | None = None,
    controller: Literal["follower", "release", "stanley", "pure_pursuit"] = "follower",
    net: Path | None = None,
    magnetometer: Literal["physical", "neural", "map-only"] | None = None,
    seed: Seed = 0,
    speed: float = 0.2,
    duration: float | None = None,
    rate_hz: float | None = None,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
    out: Path | None = None,
    rrd: Path | None = None,
    parquet: Path | None = None,
    scans: bool = False,
    force: Force = False,
    json: Json = False,
) -> None:
    """Drive a scene's robot along a path and write what happened.

    With none of --out, --rrd and --parquet, writes the folder "run".

    Parameters
    ----------
    scene
        USD stage to drive in.
    path
        sine, fast_sine, lawnmower, split_lawnmower, figure8, narrow_figure8, continuous_cycle,
        curvilinear, curvilinear_2; A to E, the cases of the paper's Table 1; random, a human-like driver
        who goes where the seed takes them, for a minute or --duration; or a CSV file of x,y [m]. figure8
        unless given.
    commands
        CSV file of t,v,w [s, m/s, rad/s] to drive by in place of a path, as magtwin drive leaves it.
    engine
        What moves the robot: kinematic (default), newton for physics in the stage itself, or replay.
    replay
        Parquet file of a run to drive once more as it was recorded, with the sensors as they are set now.
    controller
        What drives: magtwin's follower; that of the released package, which drives the real robot; Stanley's;
        or pure pursuit.
    net
        Weights to use in place of the scene's (.safetensors or .pth), for a neural magnetometer; "none" for
        a physical one.
    magnetometer
        What it reads, in place of what the scene says: the exact field (physical), the map and what a
        network predicts (neural), or the map alone (map-only).
    seed
        Seed of all noise; one seed, one Run.
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
    scans
        Cast the LiDAR's rays while it spins: into the recording, and into a table beside the run's, such as
        run.scans.parquet beside run.parquet.
    force
        Replace what exists.
    json
        Print the summary as JSON.
    """
    from magtwin.files import existing, output

    existing(scene, "scene")
    if out is rrd is parquet is None:
        out = Path("run")
    beside = parquet.with_suffix(".scans.parquet") if scans and parquet is not None else None
    targets = (out, rrd, parquet, beside)
    places = [target.resolve() for target in targets if target is not None]
    if len(set(places)) < len(places):
        raise RefusedError("two outputs have one name; give each its own")
    way = _way(path, commands, engine, replay)
    if controller != "follower" and (commands or replay or path == "random"):
        raise RefusedError(f"--controller {controller} follows a path, and {way} is none; drop one")
    if speed != 0.2 and (commands or replay):
        raise RefusedError(f"--speed is for a path or a driver, and {way} has speeds of its own; drop one")
    if engine == "newton":
        from magtwin.sim.newton import check_installed

        check_installed()
    options: dict[str, Any] = {
        "commands": commands,
        "replay": replay,
        "engine": "newton" if engine == "newton" else "kinematic",
        "steps": announcer(quiet=json),
        "net": net,
        "magnetometer": magnetometer,
        "seed": seed,
        "speed": speed,
        "duration_s": duration,
        "rate_hz": rate_hz,
        "lidar": lidar,
        "outside": outside,
        "controller": controller,
        "title": f"{way} in {scene}",
    }
    with ExitStack() as stack:  # all are written, or none
        asides = [t if t is None else stack.enter_context(output(t, force=force)) for t in targets]
        if asides[0] is not None:
            asides[0].mkdir()
        out_aside, rrd_aside, parquet_aside, scans_aside = asides
        report = write_run(
            scene,
            way,
            out_aside,
            rrd=rrd_aside,
            parquet=parquet_aside,
            scans=scans,
            scans_parquet=scans_aside,
            **options,
        )
    print_report(report, json)
    if not json:
        say("Wrote " + ", ".join(str(target) for target in targets if target is not None))


def write_run(
    scene_file: Path,
    path: str,
    folder: Path | None,
    *,
    steps: Any,
    title: str,
    rrd: Path | None = None,
    parquet: Path | None = None,
    scans: bool = False,
    scans_parquet: Path | None = None,
    commands: Path | None = None,
    replay: Path | None = None,
    net: Path | None = None,
    magnetometer: Literal["physical", "neural", "map-only"] | None = None,
    facts: Mapping[str, str] = MappingProxyType({}),
    **options: Any,
) -> Any:
    """Run a scene and write the outputs asked for; returns the run's report.

    `facts` say where files will lie as seen from the run's own, for those that move with it.
    """
    from magtwin.io.rerun import write_rrd
    from magtwin.io.tables import read_parquet, write_parquet
    from magtwin.path import resolve_path
    from magtwin.sim.commands import read_commands
    from magtwin.twin import open_twin, scan, simulate

    planned = None
    what: Any = path
    if commands is not None:
        what = read_commands(commands)
    elif replay is not None:
        what = read_parquet(replay)
    elif path != "random":
        what = planned = resolve_path(path)
    twin = open_twin(scene_file, net=net, magnetometer=magnetometer)
    if commands is not None and what.beyond(twin.scene.robot.drive):
        print(f"  {what.beyond(twin.scene.robot.drive)}", file=sys.stderr)  # noqa: T201
    steps(f"Driving {planned.name if planned else path}")
    if replay is not None:
        facts = {"replay_file": replay.as_posix(), **facts}
    result = simulate(twin, what, **options).with_facts(**facts)
    seen = None
    if scans:
        from magtwin.io.scans import write_scans

        steps("Casting the LiDAR's rays")
        seen = scan(twin, result, seed=options["seed"])
        for target in (folder / "run.scans.parquet" if folder else None, scans_parquet):
            if target is not None:
                write_scans(seen, target)
    steps("Writing the run")
    for target in (folder / "run.parquet" if folder else None, parquet):
        if target is not None:
            write_parquet(result, target)
    for target in (folder / "run.rrd" if folder else None, rrd):
        if target is not None:
            write_rrd(result, target, twin, planned=planned, scans=seen)
    if folder:
        from magtwin.io.plots import plot_run

        plot_run(result, twin.field, folder / "run.png", planned=planned.p_xy if planned else None)
    return result.report(title)


def _way(path: str | None, commands: Path | None, engine: str | None, replay: Path | None) -> str:
    """What is driven, in a word; refused where more than one thing is named."""
    named = [
        f"--{option}"
        for option, value in (("path", path), ("commands", commands), ("replay", replay))
        if value is not None
    ]
    if len(named) > 1:
        raise RefusedError(f"{' and '.join(named)} each say what to drive; give one of them")
    if engine == "replay" and replay is None:
        raise RefusedError("the engine replay needs the run that it drives once more: --replay RUN.parquet")
    if engine not in (None, "replay") and replay is not None:
        raise RefusedError(
            f"--replay drives a run as it was recorded, which --engine {engine} cannot; drop one"
        )
    return path or str(commands or replay or "figure8")


def _picture(scene_file: Path, out: Path) -> None:
    """A picture of a stage; where no OpenGL is to be had, says so and goes on."""
    from magtwin.io.pictures import picture_of_stage

    try:
        picture_of_stage(scene_file, out)
    except RefusedError as error:
        print(f"  no picture of the stage: {error}", file=sys.stderr)  # noqa: T201
