"""A scene as a TOML file: its tables, and the Scene made from them."""

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from magtwin.author.furniture import FurnitureTable, placed_furniture
from magtwin.author.robot import RobotSettings, build_robot
from magtwin.author.room import asset_named, check_name, check_start, lab_of, obstacles_in
from magtwin.author.scene import check_names, check_things
from magtwin.author.walls import DoorTable, WallTable, check_not_in_walls, lab_with_walls
from magtwin.errors import InputError, about
from magtwin.files.file import existing_file, sha256
from magtwin.files.kinds import expected
from magtwin.files.settings import from_table, read_toml, refused_at
from magtwin.path.room import Room, path_in
from magtwin.sim.motion.drive_input import check_path
from magtwin.spec.base import ZERO3, Vec3
from magtwin.spec.furniture import FurnitureSpec
from magtwin.spec.lab import LabSpec, SurveySpec
from magtwin.spec.magnetics import EarthFieldSpec, SourceSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import PlacedRobot, RobotSpec, fields_of
from magtwin.spec.scene import Scene
from magtwin.spec.walls import Window
from magtwin.usd.lab.earth import checked
from magtwin.usd.layers import layer_sha256
from magtwin.usd.robot import load_robot

PARTS = ("drive", "battery", "platform", "magnetometer", "imu", "lidar", "mocap")
"""Tables below [robot] whose keys replace those of an asset one by one; [robot.plant] replaces all."""


@dataclass(frozen=True, kw_only=True)
class _RobotTable(RobotSettings):
    """The robot: an asset, or a URDF with further settings. For several robots, write one [[robot]] each."""

    name: str = ""
    """Name of the prim, required if there are several robots. With urdf, it must be the URDF's robot name."""

    start: Vec3 | None = None
    """Start: x [m], y [m] and yaw [rad]. Default: the scene's start; with several robots, the first point of
    its path. A start inside furniture is an error, which names the nearest free place."""

    path: str = ""
    """Path to drive: the name of a path, "random", or a CSV file of x,y. Default: figure8."""

    asset: Path | None = None
    """Name of a robot that ships with magtwin ("turtlebot4"), or USD file made by `magtwin robot`."""

    urdf: Path | None = None
    """URDF or xacro file to convert, instead of an asset."""

    network: Path | None = None
    """Weights that predict the robot's disturbance, for a neural magnetometer."""

    kind: Literal["physical", "neural", "map-only"] | None = None
    """Magnetometer: it reads the exact field, the map plus the network's prediction, or the map. Default:
    neural with a network, else physical."""


@dataclass(frozen=True, kw_only=True)
class EarthTable(EarthFieldSpec):
    """The Earth's field, uniform over the room. By default computed from place and date with the IGRF-14, up
    to 2030.
    """

    b_world_nt: Vec3 = ZERO3
    """Field in world axes [nT], if it was measured. Unless measured is true, it must agree with the model
    within 1 nT."""


@dataclass(frozen=True, kw_only=True)
class _SourcesTable:
    """Furniture and sources in another file."""

    file: Path
    """TOML with [[furniture]] and [[source]] tables to add to those of the scene."""


@dataclass(frozen=True, kw_only=True)
class SceneFile:
    """A scene's TOML; docs/scenes.md is generated from this class."""

    name: str
    """Name of the scene and of its root layer: any file name that is valid on every system."""

    robot: tuple[_RobotTable, ...]

    map: Path | None = None
    """USD layer of the magnetic map. Default: the scene is surveyed, see above."""

    start: Vec3 = ZERO3
    """Start of the robot: x [m], y [m] and yaw [rad]. A path starts at its own first point."""

    seed: int = 0
    """Seed of the default magnetization of furniture, and of the survey's noise."""

    lab: LabSpec = field(default_factory=LabSpec)
    wall: tuple[WallTable, ...] = ()
    door: tuple[DoorTable, ...] = ()
    window: tuple[Window, ...] = ()
    earth: EarthTable | None = None
    survey: SurveySpec | None = None
    sources: _SourcesTable | None = None
    source: tuple[SourceSpec, ...] = ()
    furniture: tuple[FurnitureTable, ...] = ()

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError(f"seed must not be below 0, got {self.seed}")


@dataclass(frozen=True, kw_only=True)
class _SourceFile:
    """A TOML with [[source]] and [[furniture]] tables."""

    source: tuple[SourceSpec, ...] = ()
    furniture: tuple[FurnitureTable, ...] = ()


def scene_from_toml(
    path: str | os.PathLike[str],
    *,
    map_layer: str | os.PathLike[str] | None = None,
    network: str | os.PathLike[str] | None = None,
    workshop: str | os.PathLike[str] | None = None,
    robot: Path | None = None,
    name: str = "",
    scale: float = 1.0,
    table: Mapping[str, Any] | None = None,
    inputs_of: Callable[[Path], tuple[str, ...]] = lambda weights: (),
    survey_of: Callable[[Scene, SurveySpec, int, Obstacles], Path] | None = None,
) -> Scene:
    """Read a scene from a TOML such as scenes/lab.toml; docs/scenes.md lists every key.

    Args:
        path: The TOML. Relative file names in it are relative to its folder.
        map_layer: Map that replaces the TOML's. The Earth's field, sources and furniture do not change;
            `magtwin.twin.scene_from_toml` refuses a map that contradicts them.
        network: Weights that replace the TOML's.
        workshop: Folder for the asset of a robot that the TOML gives as a URDF.
        robot: USD asset of a robot that replaces those of the TOML. Without `map_layer`, the scene is then
            surveyed by this robot, if the TOML has an Earth field.
        name: Name of the scene, in place of the TOML's.
        scale: Factor on the floor and on the places of furniture and sources; their sizes stay.
        table: The tables, if they are not in a file: `path` then stands for them in messages.
        inputs_of: Function from a weights file to the names of its inputs, see
            `magtwin.twin.scene_from_toml`. By default the scene names no inputs.
        survey_of: Function that surveys a scene without a map and returns the map layer. It gets the scene,
            the survey, the seed and the obstacles.

    Raises:
        InputError: A key is unknown or missing, or a file is missing; the text has file and line.
    """
    table = read_toml(path) if table is None else dict(table)
    if name:
        table["name"] = name
    if robot is not None:
        table["robot"] = {"asset": str(Path(robot).resolve())}
        if "earth" in table:
            table.pop("map", None)
    if scale != 1.0:
        table = _scaled(table, scale)
    alone = isinstance(table.get("robot"), dict)  # [robot], not [[robot]]
    if alone:
        table = table | {"robot": [table["robot"]]}
    given = from_table(SceneFile, table, path)
    if not given.robot:
        raise InputError(f"{path}: has no robot; add a [robot] table")
    with _at(path, "name"):
        check_name(given.name)
    layer = Path(map_layer).resolve() if map_layer is not None else given.map
    if layer is not None:
        layer = existing_file(layer, "map layer", "USD")
    lab = lab_of(given.lab, table, path, layer)
    lab = lab_with_walls(lab, given.wall, given.door, given.window, path, seed=given.seed)
    pieces = placed_furniture(given.furniture, lab, path, seed=given.seed)
    sources = given.source
    if given.sources:
        listed = read_sources(given.sources.file, seed=given.seed, lab=lab)
        sources, pieces = (*listed[0], *sources), (*listed[1], *pieces)
    if layer is None and (given.earth is None or survey_of is None):
        more = "" if pieces or sources else " and furniture or sources ([[furniture]], [[source]])"
        raise InputError(
            f'{path}: names no map; add map = "FILE.usdc" to it, or give `map_layer=FILE.usdc`, or add an '
            f"[earth] table (latitude_deg, longitude_deg, height_m, date){more}, from which it is surveyed"
        )
    with about(f"{path}:"):
        check_names(sources, pieces)
    standing = obstacles_in(lab, pieces)
    check_not_in_walls(pieces[len(pieces) - len(given.furniture) :], lab, standing, path)
    robots: list[PlacedRobot] = []
    for number, (robot_table, keys) in enumerate(zip(given.robot, table["robot"], strict=True)):
        where = f"{path}: [robot]" if alone else f"{path}: [[robot]] {robot_table.name!r}"
        made = _robot(robot_table, keys, where, workshop, named=not alone)
        made = _with_network(made, robot_table, network, where, inputs_of)
        if layer is None and (given.survey is None or given.survey.height_m is None):
            check_above_floor(made, where)
        drives = _path(robot_table.path, Path(path).parent, where)
        cut = lab.built  # the origin need not be free
        of_robot = robot_table.start is not None or not (
            (alone and not cut) or (number == 0 and "start" in table)
        )
        start = robot_table.start or (ZERO3 if of_robot else given.start)
        if robot_table.start is None and of_robot and (drives or cut) and drives != "random":
            room = Room(lab, made.footprint_radius_m, standing)
            way = path_in(room, drives or "figure8")  # not in each other
            start = float(way.p_xy[0, 0]), float(way.p_xy[0, 1]), float(way.heading(0.0))
        robots.append(PlacedRobot(robot=made, start=start, path=drives))
        with _at(path, "start", **({"section": "robot", "number": number} if of_robot else {})):
            check_start(robots[-1], lab, standing)
    with about(f"{path}: [earth]"):
        earth = checked(EarthFieldSpec(**vars(given.earth))) if given.earth else None
    scene = Scene(
        name=given.name,
        map_layer=Path("surveyed") if layer is None else layer,
        map_sha256="" if layer is None else layer_sha256(layer),
        lab=lab,
        earth=earth,
        sources=sources,
        furniture=pieces,
        **fields_of(robots),
    )
    with about(f"{path}:"):
        check_things(scene)
    if layer is None and survey_of is not None:
        with about(f"{path}: cannot be surveyed:"):
            surveyed = survey_of(scene, given.survey or SurveySpec(), given.seed, standing)
        scene = replace(scene, map_layer=surveyed, map_sha256=layer_sha256(surveyed))
    return scene


@contextmanager
def _at(path: str | os.PathLike[str], key: str, **table: Any) -> Iterator[None]:
    """Errors inside have the line of a key of the TOML."""
    try:
        yield
    except InputError as error:
        raise refused_at(path, key, str(error), **table) from error


def check_above_floor(robot: RobotSpec, where: str) -> None:
    """Refuse a robot whose magnetometer is below the floor, where it cannot survey.

    Raises:
        InputError: It is; begins with `where`.
    """
    height = robot.base_height_m + robot.p_base_magnetometer[2]
    if height < 0:
        raise InputError(
            f"{where}: the magnetometer of {robot.name!r}, on link {robot.magnetometer.link!r}, is "
            f"{-height:.4g} m below the floor on which the wheels stand; mount it higher (z of "
            "--magnetometer LINK:X,Y,Z, or of p_link_sensor)"
        )


def _scaled(table: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """The table of a scene whose floor is `scale` times as wide, with all things in the same part of it."""
    factors: dict[str, Any] = {**dict.fromkeys(("from", "to", "at_m"), scale), "p_world": (scale, scale, 1.0)}
    lab = dict(table.get("lab", {}))
    if "floor_m" in lab:
        lab["floor_m"] = [round(side * scale, 3) for side in lab["floor_m"]]
    if "floor" in lab:
        lab["floor"] = [[c * scale for c in corner] for corner in lab["floor"]]

    def placed(thing: Mapping[str, Any]) -> dict[str, Any]:
        return {k: np.multiply(v, factors[k]).tolist() if k in factors else v for k, v in thing.items()}

    sections = [key for key in ("furniture", "source", "wall", "door", "window") if key in table]
    return {**table, "lab": lab, **{key: [placed(thing) for thing in table[key]] for key in sections}}


def _robot(
    table: _RobotTable,
    keys: Mapping[str, Any],
    where: str,
    workshop: str | os.PathLike[str] | None,
    *,
    named: bool,
) -> RobotSpec:
    """The robot of a table: its asset, or one built from its URDF."""
    if named and not table.name:
        raise InputError(f'{where} needs name = "NAME", the name of its prim')
    if table.asset is not None and table.urdf is None:
        if others := sorted({"conversion", *(() if named else ("name",))} & set(keys)):
            raise InputError(f"{where} {others[0]} goes with urdf; an asset has it already")
        robot = load_robot(asset_named(table.asset, keys["asset"], where))
        with about(where):
            robot = _changed(robot, table, keys)
    elif table.urdf is None or table.asset is not None:
        raise InputError(f'{where} needs asset = "FILE.usda" or urdf = "FILE.urdf", and not both')
    elif workshop is None:
        raise InputError(f"{where} names a URDF; give `workshop=DIR`, a folder to build the robot in")
    else:
        settings = RobotSettings(**{f.name: getattr(table, f.name) for f in fields(RobotSettings)})
        if named:
            settings = replace(settings, name="")  # accept any name in the URDF
        folder = Path(workshop) / table.name if named else Path(workshop)
        folder.mkdir(parents=True, exist_ok=True)
        asset = folder / f"{table.urdf.name.split('.')[0]}.usda"
        with about(where):
            build_robot(table.urdf, settings, asset)
        robot = load_robot(asset, own=True)
    return replace(robot, name=table.name) if named else robot


def _changed(robot: RobotSpec, table: RobotSettings, keys: Mapping[str, Any]) -> RobotSpec:
    """The robot of an asset with what its table gives: of each part, the keys that are there."""
    for name in PARTS:
        if name in keys:
            given = {key: getattr(getattr(table, name), key) for key in keys[name]}
            robot = robot.with_part(name, replace(getattr(robot, name), **given))
    robot = replace(robot, plant=table.plant.spec) if "plant" in keys else robot
    if table.footprint_radius_m is not None:
        robot = replace(robot, footprint_radius_m=table.footprint_radius_m)
    return robot


def _with_network(
    robot: RobotSpec,
    table: _RobotTable,
    network: str | os.PathLike[str] | None,
    where: str,
    inputs_of: Callable[[Path], tuple[str, ...]],
) -> RobotSpec:
    """The robot with the weights and the kind of its table; `network` replaces the weights."""
    weights = Path(network).resolve() if network is not None else table.network
    changes: dict[str, Any] = {}
    if weights is not None:
        weights = expected(weights, "weights file")
        changes = {"kind": "neural", "network": weights, "network_sha256": sha256(weights)}
        changes["inputs"] = inputs_of(weights)
    if table.kind is not None and network is None:
        changes["kind"] = table.kind
    robot = replace(robot, magnetometer=replace(robot.magnetometer, **changes))
    if robot.magnetometer.kind == "neural" and robot.magnetometer.network is None:
        raise InputError(f'{where} kind = "neural" needs network = "FILE"')
    return robot


def _path(path: str, folder: Path, where: str) -> str | Path:
    """The default path of a robot: a name, or a file in the TOML's folder."""
    if path in ("", "random"):
        return path
    file = (folder / path).resolve()
    named = not Path(path).suffix and not file.exists()
    with about(f"{where} path:"):
        check_path(path if named else file)
    return path if named else file


def read_sources(
    path: str | os.PathLike[str], *, seed: int = 0, lab: LabSpec | None = None
) -> tuple[tuple[SourceSpec, ...], tuple[FurnitureSpec, ...]]:
    """The sources and the furniture of a TOML such as maps/lab/sources.toml.

    Args:
        path: The TOML.
        seed: Seed of the default magnetization of furniture.
        lab: Room whose slab the furniture must stand on. None skips the check.

    Raises:
        InputError: A key is unknown or missing, a value is out of range, or a piece does not stand on the
            slab; the text has file and line.
    """
    tables = from_table(_SourceFile, read_toml(path), path)
    return tables.source, placed_furniture(tables.furniture, lab, path, seed=seed)
