"""`magtwin new` and `magtwin scene`."""

import shlex
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from magtwin.cli.app import app
from magtwin.cli.options import Force, Network, pairs
from magtwin.cli.terminal import Done, announce, check_output, progress
from magtwin.errors import InputError


@app.command
def new(out: Path, *, plan: Path | None = None, scale: float | None = None, force: Force = False) -> Done:
    """Write a file to start from: a TOML of a room, or a localizer in Python.

    The room is a small furnished one, or that of a floor plan or an occupancy map.

    Author a room with `magtwin scene room.toml --out room`. Test a localizer with `magtwin localize RUN --map
    lab --method localizer:MyLocalizer`.

    Parameters
    ----------
    out
        File to write: .toml for a room, whose scene gets the file's name; .py for a localizer.
    plan
        Floor plan to make the room from: .svg, .dxf or .geojson, with layers or classes named after doors and
        windows; or .pgm or .yaml, an occupancy map of ROS.
    scale
        Metres per unit of the plan, or per cell of the map. Default: what the file states.
    """
    check_output(out, (".toml", ".py"), "a room or a localizer", force=force)
    if out.suffix.lower() == ".py":
        from magtwin.tasks.localizing import new_localizer

        new_localizer(out, force=force)
        try_it = f"magtwin localize localizer_run/run.parquet --map lab --method {out.stem}:MyLocalizer"
        folder = "" if out.parent == Path() else f"cd {shlex.quote(str(out.parent))}\n       "
        drive = "magtwin run lab --out localizer_run"
        return Done(wrote=out, text=f"Wrote {out}\nNext:  {folder}{drive}\n       {try_it}")
    from magtwin.twin import new_scene

    new_scene(out, plan=plan, scale=scale, report=announce, force=force)
    room = out.with_suffix("")
    stage = shlex.quote(str(room / f"{out.stem}.usda"))
    author = f"magtwin scene {shlex.quote(str(out))} --out {shlex.quote(str(room))}"
    return Done(wrote=out, text=f"Wrote {out}\nNext:  {author}\n       magtwin run {stage}")


@app.command(usage="Usage: magtwin scene [SPEC] --out PATH [OPTIONS]")
def scene(
    spec: str | None = None,
    *,
    out: Path,
    urdf: Path | None = None,
    magnetometer: str | None = None,
    controllers: Path | None = None,
    package: list[str] | None = None,
    arg: list[str] | None = None,
    skip_missing_includes: bool | None = None,
    map: Path | None = None,  # noqa: A002 - the option is called --map
    network: Network = None,
    force: Force = False,
) -> Done:
    """Author a scene from its TOML: the room, its magnetic map and a robot with sensors.

    A scene without a map is surveyed by its own robot, from the Earth's field, furniture and sources.
    `magtwin new room.toml` writes a TOML to start from; docs/scenes.md lists every key.

    Parameters
    ----------
    spec
        TOML file, or the name of a scene that ships with magtwin: lab, aprilab. Default with --urdf: a
        furnished room of the robot's size.
    out
        Folder to make. It holds everything that the stage needs and can be moved.
    urdf
        URDF or xacro of a mobile robot, or an asset of `magtwin robot --settings`. It replaces the robot of
        the TOML, and surveys the room unless --map is given.
    magnetometer
        LINK or LINK:X,Y,Z: link of the URDF that carries the magnetometer, and its position on it [m].
    controllers
        YAML of the URDF's controllers (ros_control, ros2_control): wheels, separation, limits.
    package
        NAME=DIR: folder of a package that the URDF names. May be repeated.
    arg
        NAME=VALUE: argument of the xacro. May be repeated.
    skip_missing_includes
        Skip files and packages that a xacro includes but that are missing, if none of their macros is
        called.
    map
        Map layer that replaces the one of the TOML. Earth, sources and furniture stay. A map that contradicts
        them is refused, and the difference is given in nT.
    """
    from magtwin.author.scene import author_scene
    from magtwin.files.outputs import check_free, not_read
    from magtwin.twin import scene_from_toml, scene_with_robot
    from magtwin.usd.info import info_of_stage
    from magtwin.usd.robot import read_notes

    if spec is not None and not Path(spec).is_file():
        not_read(spec)
    check_free(out, force=force)
    lines: list[str] = []
    with TemporaryDirectory() as workshop:
        with progress("Reading the scene", "headings") as advance:
            choices: dict[str, Any] = {"map_layer": map, "network": network, "workshop": workshop}
            choices |= {"report": lines.append, "progress": advance}
            if urdf is not None:
                announce(f"Converting {urdf}")
                choices |= {"name": out.resolve().name, "controllers": controllers}
                choices |= {"packages": {n: Path(folder) for n, folder in pairs("package", package).items()}}
                choices |= {"skip_missing_includes": bool(skip_missing_includes)}
                arguments = pairs("arg", arg, empty=True)
                read = scene_with_robot(urdf, magnetometer, spec, arguments=arguments, **choices)
            elif spec is None:
                raise InputError("name a scene: a TOML, a scene that ships, or a robot with --urdf")
            else:
                _check_unused(magnetometer=magnetometer, controllers=controllers, package=package, arg=arg)
                announce(f"Reading {spec}")
                read = scene_from_toml(spec, **choices)
        announce("Authoring the stage")
        root = author_scene(read, out, force=force)
        made = [s.robot for s in read.robots if s.robot.asset.is_relative_to(Path(workshop).resolve())]
        notes = {f"notes on {robot.name}": read_notes(robot.asset) for robot in made}
    report, text = info_of_stage(root), "\n".join([*lines, f"Wrote {root}"])
    return Done(replace(report, metadata={**report.metadata, **notes}), root, text=text)


def _check_unused(**options: object) -> None:
    """Refuse options that only matter with --urdf."""
    used = [f"--{name}" for name, value in options.items() if value is not None]
    if used:
        raise InputError(f"{', '.join(used)} goes with --urdf; a TOML names these in [robot]")
