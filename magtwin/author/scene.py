"""A Scene authored as a folder of USD layers."""

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from pxr import Kind, Sdf, Usd, UsdGeom, UsdUtils

from magtwin.author.room import check_name
from magtwin.errors import InputError
from magtwin.field.maps.scene_state import made_from
from magtwin.field.sources.magnets import body_of
from magtwin.files.file import existing
from magtwin.files.outputs import output
from magtwin.frames import quat_from_yaw
from magtwin.spec.furniture import FurnitureSpec
from magtwin.spec.magnetics import SourceSpec
from magtwin.spec.robot import PlacedRobot, fields_of
from magtwin.spec.scene import Scene
from magtwin.urdf.convert import THUMBNAILS
from magtwin.usd.attributes import check_prim_name, write_pose
from magtwin.usd.lab.earth import define_earth
from magtwin.usd.lab.furniture import FURNITURE, define_furniture
from magtwin.usd.lab.looks import SHAPES, SHAPES_FILE, VISUALS, define_shapes
from magtwin.usd.lab.room import LAB, PHYSICS_SCENE, define_floor_shape, define_lab, expose_for_kit
from magtwin.usd.lab.sources import LOOKS, SOURCES, define_sources
from magtwin.usd.layers import WORLD, describe_stage, new_stage, relative_asset
from magtwin.usd.maps.attributes import read_made_from, write_made_from
from magtwin.usd.maps.heat_map import MAP
from magtwin.usd.maps.layer import load_map
from magtwin.usd.robot import load_robot, urdf_of
from magtwin.usd.scene import check_map
from magtwin.usd.schema import author, author_targets, only_prim_with
from magtwin.usd.sensors import (
    MAP_CHECKSUM,
    MAP_RELATIONSHIP,
    ON_ROOT,
    define_battery,
    define_drive,
    define_footprint,
    define_imu,
    define_lidar,
    define_magnetometer,
    define_on_root,
    define_path,
)

EARTH = WORLD.AppendChild("Earth")
TAKEN = (LAB.name, PHYSICS_SCENE.name, MAP.name, EARTH.name, SOURCES.name, FURNITURE.name, SHAPES.name)
"""Children of /World that cannot be names of robots."""

PARTS: dict[str, Callable[..., Usd.Prim]] = {
    "magnetometer": define_magnetometer,
    "imu": define_imu,
    "lidar": define_lidar,
    "battery": define_battery,
}
"""Parts of a robot that are separate prims."""


def author_scene(
    scene: Scene, folder: str | os.PathLike[str], *, by_reference: bool = False, force: bool = False
) -> Path:
    """Write a scene as a folder of layers.

    `<name>.usda` places each robot, with what differs from its asset. Its sublayers are `room.usda`,
    `furniture.usda`, `magnetics.usda` (the Earth's field and sources) and the map. Meshes that are
    shown reference the unit shapes of `shapes.usdc`.

    Args:
        scene: What to author.
        folder: Folder to make.
        by_reference: Whether map, robot and weights stay where they are, named by relative paths. By default
            they are copied into the folder, which can then be moved anywhere.
        force: Whether to replace an existing folder.

    Returns:
        The root layer, `folder/<name>.usda`.

    Raises:
        InputError: The folder exists; a file is missing, of another kind, or differs from its checksum; or a
            name is not valid for a file or a prim.
    """
    _check(scene)
    with output(folder, force=force) as aside:
        aside.mkdir()
        placed = scene if by_reference else _with_copies(scene, aside)
        sublayers = [*_write_parts(scene, aside), placed.map_layer]
        root = Sdf.Layer.CreateNew(str(aside / f"{scene.name}.usda"))
        stage = Usd.Stage.Open(root)
        names = ", ".join(placed.robot.name for placed in scene.robots)
        describe_stage(stage, f"{scene.name}: a lab, its magnetic map and {names}, by magtwin")
        expose_for_kit(root)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, WORLD).GetPrim())
        Usd.ModelAPI(stage.GetDefaultPrim()).SetKind(Kind.Tokens.assembly)
        root.subLayerPaths = [relative_asset(root, layer) for layer in sublayers]
        for robot in placed.robots:
            _define_robot(stage, robot, scene.map_sha256)
        map_prim = only_prim_with(stage.GetPrimAtPath(WORLD), "anomalyMap")
        if read_made_from(map_prim) is None:  # from now on, changes of the stage are seen
            write_made_from(map_prim, made_from(scene))
        del stage  # _settle makes paths right for the final folder
        _settle(root, aside, Path(folder).resolve())
        root.Save()
    return Path(folder) / f"{scene.name}.usda"


def _check(scene: Scene) -> None:
    """Refuse a scene that cannot be authored, before anything is written."""
    check_name(scene.name)
    for placed in scene.robots:
        if check_prim_name(placed.robot.name, "robot") in TAKEN:
            raise InputError(f"robot {placed.robot.name!r} has a name that scenes reserve; rename it")
    check_things(scene)
    load_map(scene.map_layer)
    check_map(scene)
    for placed in scene.robots:
        load_robot(placed.robot.asset)
        if placed.robot.magnetometer.network is not None:
            existing(placed.robot.magnetometer.network, "weights file")
        if isinstance(placed.path, Path):
            existing(placed.path, "path file")


def check_things(scene: Scene) -> None:
    """Refuse sources and furniture with equal or reserved names, or whose field cannot be computed.

    Raises:
        InputError: Two have the same name, or a susceptibility needs the Earth's field.
    """
    check_names(scene.sources, scene.furniture)
    for name, what in ((LOOKS, "materials"), (VISUALS, "shown meshes")):
        if any(source.name == name for source in scene.sources):
            raise InputError(f"source {name!r} has the name of the scope of {what}; rename it")
    for source in scene.magnets:
        if source.susceptibility and scene.earth is None:
            body_of(source)  # raises


def check_names(sources: Sequence[SourceSpec], furniture: Sequence[FurnitureSpec]) -> None:
    """Refuse sources and furniture with equal names.

    Raises:
        InputError: Two have the same name.
    """
    for what, things in (("sources", sources), ("pieces of furniture", furniture)):
        names = [thing.name for thing in things]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(f"two {what} are called {twice[0]!r}; give each its own name")


def _with_copies(scene: Scene, folder: Path) -> Scene:
    """The scene with its files copied to `folder`, each file once."""
    copies: dict[Path, Path] = {}

    def once(file: Path, kind: str, name: str, copy: Callable[[Path, Path], Path]) -> Path:
        source = file.resolve()
        if source not in copies:
            # Files of further robots have their own folder, since names can repeat.
            place = folder / kind / name if (folder / kind).exists() else folder / kind
            copies[source] = copy(source, place)
        return copies[source]

    robots = []
    for placed in scene.robots:
        robot, path = placed.robot, placed.path
        magnetometer = robot.magnetometer
        if magnetometer.network is not None:
            weights = once(magnetometer.network, "weights", robot.name, _copied)
            magnetometer = replace(magnetometer, network=weights)
        asset = once(robot.asset, "robots", robot.name, _copied_asset)
        if isinstance(path, Path):
            path = once(path, "paths", robot.name, _copied)
        robot = replace(robot, asset=asset, magnetometer=magnetometer)
        robots.append(PlacedRobot(robot=robot, start=placed.start, path=path))
    return replace(scene, map_layer=_copied(scene.map_layer, folder / "map"), **fields_of(robots))


def _copied(file: Path, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return Path(shutil.copyfile(existing(file, "file of a scene"), folder / file.name))


def _copied_asset(asset: Path, folder: Path) -> Path:
    """A robot's asset copied below `folder`, in a folder of its name, with every file that it names.

    Its thumbnail and its URDF come along. ROS publishes the URDF; its meshes are not copied.
    """
    asset, folder = asset.resolve(), folder / asset.stem
    layers, assets, unresolved = UsdUtils.ComputeAllDependencies(str(asset))
    if unresolved:
        raise InputError(f"{asset}: names {unresolved[0]}, which is not there")
    files = sorted({asset, *(Path(layer.realPath).resolve() for layer in layers), *map(Path, assets)})
    outside = [file for file in files if not file.resolve().is_relative_to(asset.parent)]
    if outside:
        raise InputError(f"{asset}: names {outside[0]}, outside its folder; copy it into {asset.parent}")
    common = Path(os.path.commonpath([file.parent for file in files]))
    picture = asset.parent / THUMBNAILS / f"{asset.name}.png"
    shown = picture.is_file() and picture.resolve().is_relative_to(asset.parent)  # no link out of the folder
    for file in (*files, *([picture] if shown else [])):
        _copied(file, (folder / file.relative_to(common)).parent)
    if (urdf := urdf_of(asset)) is not None:
        _copied(urdf, (folder / asset.relative_to(common)).parent)
    return folder / asset.relative_to(common)


def _write_parts(scene: Scene, folder: Path) -> list[Path]:
    """The layers of room, furniture and field, the strongest first; those without content are left out."""

    def field(stage: Usd.Stage) -> None:
        if scene.earth is not None:
            define_earth(stage, EARTH, scene.earth)
        if scene.sources:
            define_sources(stage, scene.sources)

    def furniture(stage: Usd.Stage) -> None:
        define_furniture(stage, scene.furniture)

    room = "The room, its lights and its physics, by magtwin"
    what = "What makes the magnetic field: the Earth and magnetised things"
    parts: list[tuple[str, object, str, Callable[[Usd.Stage], object]]] = [
        ("room", True, room, lambda stage: define_lab(stage, scene.lab)),
        ("furniture", scene.furniture, "Furniture and columns, and how they are magnetised", furniture),
        ("magnetics", scene.earth or scene.sources, what, field),
    ]
    shapes = folder / SHAPES_FILE
    with new_stage(shapes, "Unit shapes of what is shown, by magtwin") as stage:
        define_shapes(stage)
        define_floor_shape(stage, scene.lab)
    paths = []
    for name, content, about, define in parts:
        if content:  # the root layer may have the name
            taken = scene.name.casefold() == name
            paths.append(folder / (f"{name}_layer.usda" if taken else f"{name}.usda"))
            with new_stage(paths[-1], about) as stage:
                stage.GetRootLayer().subLayerPaths = [str(shapes.resolve())]  # this layer is not in its place
                define(stage)
            layer = Sdf.Layer.FindOrOpen(str(paths[-1]))
            layer.subLayerPaths = [f"./{shapes.name}"]
            layer.Save()
    return paths


def _define_robot(stage: Usd.Stage, placed: PlacedRobot, map_sha256: str) -> None:
    """A robot by reference at its start, with overs for what differs from its asset."""
    robot, root = placed.robot, stage.GetRootLayer()
    prim = UsdGeom.Xform.Define(stage, WORLD.AppendChild(robot.name)).GetPrim()
    prim.GetReferences().AddReference(relative_asset(root, robot.asset))
    x, y, yaw = placed.start
    write_pose(prim, (x, y, 0.0), tuple(map(float, quat_from_yaw(yaw))))  # type: ignore[arg-type]
    define_footprint(prim, robot.footprint_radius_m)
    define_path(prim, placed.path)
    define_drive(prim, robot.drive)
    for noun in ON_ROOT:
        define_on_root(prim, noun, getattr(robot, noun))
    for part, define in PARTS.items():
        define(stage, only_prim_with(prim, part).GetPath(), getattr(robot, part))
    magnetometer = only_prim_with(prim, "magnetometer")
    map_prim = only_prim_with(stage.GetPrimAtPath(WORLD), "anomalyMap")
    author_targets(magnetometer, MAP_RELATIONSHIP, [map_prim.GetPath()])
    if map_sha256:
        author(magnetometer.GetAttribute(MAP_CHECKSUM), map_sha256)


def _settle(layer: Sdf.Layer, aside: Path, final: Path) -> None:
    """Correct paths out of the temporary folder `aside` for the final folder."""
    aside = aside.resolve()

    def settled(path: str) -> str:
        absolute = (aside / path).resolve()
        if absolute.is_relative_to(aside):
            return f"./{absolute.relative_to(aside).as_posix()}"
        return Path(os.path.relpath(absolute, final)).as_posix()

    UsdUtils.ModifyAssetPaths(layer, settled)
