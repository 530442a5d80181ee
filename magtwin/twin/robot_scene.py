"""Robot scene: a mobile robot from its URDF, with a magnetometer, in a room."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path as FilePath
from typing import Any

from magtwin.errors import InputError
from magtwin.files.file import existing, shipped
from magtwin.files.kinds import expected
from magtwin.spec.scene import Scene
from magtwin.twin.authoring import new_workshop, scene_from_toml

ROOM_RADIUS_M, ROOM_TURN_M = 0.3, 0.28
"""Footprint radius and turning radius of robots for which the room has space [m]."""

PATHS = ("figure8", "continuous_cycle", "narrow_figure8", "loops", "lawnmower")
"""Paths that such a scene may have as its default; the first that the robot can drive is taken."""


def scene_with_robot(
    robot: str | FilePath,
    magnetometer: str | None = None,
    spec: str | FilePath | None = None,
    *,
    name: str = "",
    controllers: str | FilePath | None = None,
    packages: Mapping[str, FilePath] | None = None,
    arguments: Mapping[str, str] | None = None,
    skip_missing_includes: bool = False,
    workshop: str | FilePath | None = None,
    **choices: Any,
) -> Scene:
    """A scene with a mobile robot, which surveys the room unless there is a map.

    Args:
        robot: URDF or xacro, converted with the profile diff-drive; or a USD asset with its settings.
        magnetometer: "LINK" or "LINK:x,y,z": link that carries the magnetometer, and its position on it [m].
            Default: the magnetometer of the URDF's tags.
        spec: TOML of a scene, or the name of one that ships, whose robots are replaced. Default: the
            furnished room of `new_scene`, scaled to the robot.
        name: Name of the scene. Default: that of `spec`, or of the robot's file.
        controllers: YAML of the robot's controllers, see `Options.controllers`.
        packages: Folders of packages by name.
        arguments: Arguments of a xacro.
        skip_missing_includes: See `Options`.
        workshop: Folder for the robot and the map. Default: as for `scene_from_toml`.
        **choices: Further arguments of `scene_from_toml`.

    Raises:
        InputError: The robot cannot be converted or has no wheels, the link is unknown, or as for
            `scene_from_toml`.
    """
    from magtwin.author.robot import RobotSettings, build_robot, mounted
    from magtwin.author.scene_file import check_above_floor
    from magtwin.urdf.options import Options
    from magtwin.urdf.report import HUGE_M
    from magtwin.usd.robot import load_robot

    file = expected(FilePath(robot), "robot")
    workshop = workshop or new_workshop()
    asset, stem = file, file.name.lstrip(".").split(".")[0] or "robot"
    if file.suffix.lower() in (".urdf", ".xacro", ".xml"):
        options = Options(
            profile="diff-drive",
            controllers=None if controllers is None else existing(FilePath(controllers), "controllers"),
            packages=dict(packages or {}),
            arguments=dict(arguments or {}),
            skip_missing_includes=skip_missing_includes,
        )
        mount = None if magnetometer is None else mounted(magnetometer)
        settings = RobotSettings(magnetometer=mount, conversion=options)
        asset = FilePath(workshop) / "robot" / f"{stem}.usda"
        asset.parent.mkdir(parents=True, exist_ok=True)
        build_robot(file, settings, asset)
    elif magnetometer or controllers or packages or arguments:
        text = "an asset has its magnetometer and drive already; give its URDF instead"
        raise InputError(f"{file}: {text}", parameter="robot")
    scale, made = 1.0, load_robot(asset)
    if made.footprint_radius_m > HUGE_M / 2:
        raise InputError(
            f"{file}: the robot is {2 * made.footprint_radius_m:.4g} m wide, too large for a room; are its "
            'meshes in mm? then <mesh scale="0.001 0.001 0.001" .../>'
        )
    check_above_floor(made, str(file))
    if spec is None:
        sizes = made.footprint_radius_m / ROOM_RADIUS_M, made.drive.turning_radius_m / ROOM_TURN_M
        scale = max(1.0, *sizes)
        spec, name = shipped("scenes", "starter.toml"), name or stem
    scene = scene_from_toml(spec, robot=asset, name=name, scale=scale, workshop=workshop, **choices)
    return _with_path(scene)


def _with_path(scene: Scene) -> Scene:
    """The scene with a default path that the robot can drive, if it has none."""
    from magtwin.author.room import obstacles_in
    from magtwin.path import check_clear
    from magtwin.path.room import Room, path_in
    from magtwin.sim.motion.plan import plan

    if scene.path:
        return scene
    robot, obstacles = scene.robot, obstacles_in(scene.lab, scene.furniture)
    room = Room(scene.lab, robot.footprint_radius_m, obstacles)
    for path in PATHS:
        with suppress(InputError):
            way = path_in(room, path)
            check_clear(way, obstacles, robot.footprint_radius_m)
            plan(way, robot.drive, speed=min(0.2, robot.drive.v_max))
            return replace(scene, path=path)
    return scene
