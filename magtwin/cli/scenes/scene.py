"""`magtwin new` and `magtwin scene`."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from magtwin.cli.app import app
from magtwin.cli.options import Force, Network, pairs
from magtwin.cli.terminal import Done, named, note, progress, step
from magtwin.errors import InputError

FIGURES = ("size", "prims", "rigid bodies", "mass")
"""Figures of a stage that are printed."""


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
    out = named(out, (".toml", ".py"), "a room or a localizer", force=force)
    if out.suffix.lower() == ".py":
        from magtwin.tasks.localizing import new_localizer

        new_localizer(out, force=force)
        drive = ("magtwin", "run", "lab", "--out", "localizer_run")
        method = ("--method", f"{out.stem}:MyLocalizer")
        try_it = ("magtwin", "localize", "localizer_run/run.parquet", "--map", "lab", *method)
        folder = [] if out.parent == Path() else [("cd", out.parent)]
        return Done(wrote=out, next=(*folder, drive, try_it))
    from magtwin.twin import new_scene

    new_scene(out, plan=plan, scale=scale, report=note, force=force)
    room = out.with_suffix("")
    author = ("magtwin", "scene", out, "--out", room)
    return Done(wrote=out, next=(author, ("magtwin", "run", room / f"{out.stem}.usda")))


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
    from magtwin.files.outputs import not_read
    from magtwin.twin import scene_from_toml, scene_with_robot
    from magtwin.usd.info import info_of_stage
    from magtwin.usd.robot import read_notes

    if spec is not None and not Path(spec).is_file():
        not_read(spec)
    out = named(out, force=force)
    lines: list[str] = []
    with TemporaryDirectory() as workshop:
        with progress("Reading the scene", "headings") as advance:
            choices: dict[str, Any] = {"map_layer": map, "network": network, "workshop": workshop}
            choices |= {"report": lines.append, "progress": advance}
            if urdf is not None:
                step(f"Converting {urdf}")
                choices |= {"name": out.resolve().name, "controllers": controllers}
                choices |= {"packages": {n: Path(folder) for n, folder in pairs("package", package).items()}}
                choices |= {"skip_missing_includes": bool(skip_missing_includes)}
                arguments = pairs("arg", arg, empty=True)
                read = scene_with_robot(urdf, magnetometer, spec, arguments=arguments, **choices)
            elif spec is None:
                raise InputError("name a scene: a TOML, a scene that ships, or a robot with --urdf")
            else:
                _check_unused(magnetometer=magnetometer, controllers=controllers, package=package, arg=arg)
                step(f"Reading {spec}")
                with _keys_for_flags():
                    read = scene_from_toml(spec, **choices)
        step("Authoring the stage")
        root = author_scene(read, out, force=force)
        made = [s.robot for s in read.robots if s.robot.asset.is_relative_to(Path(workshop).resolve())]
        notes = {f"notes on {r.name}": told for r in made if (told := read_notes(r.asset))}
    report = info_of_stage(root)
    report = replace(report, metadata={**report.metadata, **notes})
    following = (("magtwin", "run", root), ("magtwin", "view", root))
    return Done(report, root, FIGURES, lines, rest=f"magtwin info {root}", next=following)


@contextmanager
def _keys_for_flags() -> Iterator[None]:
    """Names the keys of a TOML where a refusal of its URDF names flags of `magtwin robot`."""
    try:
        yield
    except InputError as error:
        packages = r'packages = {\1 = "FOLDER"} below [robot.conversion]'
        told = re.sub(r"--package (\S+)=FOLDER", packages, str(error))
        told = re.sub("`skip_missing_includes[^`]*`", "skip_missing_includes = true", told)
        raise InputError(told) from error


def _check_unused(**options: object) -> None:
    """Refuse options that only matter with --urdf."""
    if used := ", ".join(f"--{name}" for name, value in options.items() if value is not None):
        raise InputError(f"{used} goes with --urdf; a TOML has keys for these below [robot.conversion]")
