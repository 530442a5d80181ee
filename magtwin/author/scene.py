"""A Scene as layered USD: authored from its spec or its TOML, and read back from the composed stage."""

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from pxr import Kind, Sdf, Usd, UsdGeom, UsdUtils

from magtwin.author.furniture import FURNITURE, define_furniture, read_magnets
from magtwin.author.lab import LAB, PHYSICS_SCENE, define_lab, read_lab
from magtwin.author.robot import RobotSettings, build_robot, description_of, read_robot, robot_of
from magtwin.author.room import (
    FurnitureTable,
    asset_named,
    check_name,
    check_names,
    check_start,
    lab_of,
    no_map,
    obstacles_in,
    placed_furniture,
)
from magtwin.errors import InputError
from magtwin.field.sources.magnets import body_of
from magtwin.files import existing, from_table, output, read_toml, refused_at, sha256
from magtwin.frames import quat_from_yaw, yaw_from_quat
from magtwin.path import resolve_path
from magtwin.placement import Room, path_in
from magtwin.spec.base import ZERO3, Vec3
from magtwin.spec.furniture import FurnitureSpec
from magtwin.spec.lab import LabSpec, SurveySpec
from magtwin.spec.magnetics import EarthFieldSpec, SourceSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import PlacedRobot, RobotSpec
from magtwin.spec.scene import Scene
from magtwin.urdf.convert import THUMBNAILS
from magtwin.usd.attributes import check_prim_name, plain_value, read_pose, target, write_pose
from magtwin.usd.earth import checked, define_earth, read_earth
from magtwin.usd.layers import WORLD, describe_stage, new_stage, open_stage, relative_asset
from magtwin.usd.maps import MAP, load_map, read_map
from magtwin.usd.schema import only_prim_with, place, prims_with, require_api
from magtwin.usd.sensors import (
    MAP_CHECKSUM,
    MAP_RELATIONSHIP,
    define_battery,
    define_drive,
    define_footprint,
    define_imu,
    define_lidar,
    define_magnetometer,
    define_mocap,
    define_platform,
    define_way,
    read_way,
)
from magtwin.usd.sources import LOOKS, SOURCES, define_sources

EARTH = WORLD.AppendChild("Earth")
TAKEN = (LAB.name, PHYSICS_SCENE.name, MAP.name, EARTH.name, SOURCES.name, FURNITURE.name)
"""Children of /World that a robot's name must leave alone."""

PARTS: dict[str, Callable[..., Usd.Prim]] = {
    "magnetometer": define_magnetometer,
    "imu": define_imu,
    "lidar": define_lidar,
    "battery": define_battery,
}
"""What a robot carries as prims of their own."""


def author_scene(
    scene: Scene, folder: str | os.PathLike[str], *, by_reference: bool = False, force: bool = False
) -> Path:
    """Write a scene as a folder of layers.

    `<name>.usda` places each robot and says what differs from its asset; it stands over `room.usda`,
    `furniture.usda` and `magnetics.usda` (the Earth's field and sources), where there are any, and the
    map's layer.

    Args:
        scene: What to author.
        folder: Folder to make.
        by_reference: Whether map, robot and weights stay where they are and are named by relative paths.
            Otherwise they are copied into the folder, which can then be moved anywhere.
        force: Whether a folder that exists is replaced.

    Returns:
        The root layer, `folder/<name>.usda`.

    Raises:
        InputError: The folder exists, a file is missing, is not what it should be or not what its
            checksum says, or a name cannot name a file or a prim.
    """
    _check(scene)
    with output(folder, force=force) as aside:
        aside.mkdir()
        placed = scene if by_reference else _with_copies(scene, aside)
        sublayers = [_write_room(scene, aside), *_write_furniture(scene, aside)]
        sublayers += [*_write_magnetics(scene, aside), placed.map_layer]
        root = Sdf.Layer.CreateNew(str(aside / f"{scene.name}.usda"))
        stage = Usd.Stage.Open(root)
        names = ", ".join(placed.robot.name for placed in scene.robots)
        describe_stage(stage, f"{scene.name}: a lab, its magnetic map and {names}, by magtwin")
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, WORLD).GetPrim())
        Usd.ModelAPI(stage.GetDefaultPrim()).SetKind(Kind.Tokens.assembly)
        root.subLayerPaths = [relative_asset(root, layer) for layer in sublayers]
        for robot in placed.robots:
            _define_robot(stage, robot, scene.map_sha256)
        del stage  # what follows is right only at the layer's later place
        _settle(root, aside, Path(folder).resolve())
        root.Save()
    return Path(folder) / f"{scene.name}.usda"


def read_scene(path: str | os.PathLike[str], *, check_network: bool = True) -> Scene:
    """The scene of a stage.

    Args:
        path: Root layer, as `author_scene` wrote it or as others edited it. A start's yaw comes back
            from a quaternion, so in its last bits it can differ from what was authored.
        check_network: Whether the weights that the magnetometer names must be there.

    Raises:
        InputError: The file or one that it names is missing, it has no lab, robot or map, a figure
            is out of range, or the map is not what its checksum was taken of, or is another than the
            scene was made with; names the prim.
    """
    if Path(path).suffix == ".usdz":
        raise InputError(
            f"{path}: a package, in which no file can be read by itself; unpack it with `magtwin export "
            f"{Path(path).name} --out DIR` and give the layer in DIR"
        )
    stage = open_stage(path)
    _check_axes(stage, path)
    world = stage.GetPseudoRoot()
    lab = read_lab(only_prim_with(world, "lab"))
    prims = prims_with(world, "robot") or [only_prim_with(world, "robot")]  # refuses a stage of none
    prim = prims[0]
    robots = [_placed(prim, check_network) for prim in prims]
    magnetometers = [only_prim_with(prim, "magnetometer") for prim in prims]
    maps = [require_api(target(m, MAP_RELATIONSHIP), "anomalyMap") for m in magnetometers]
    checksums = [plain_value(m.GetAttribute(MAP_CHECKSUM)) for m in magnetometers]
    read_map(maps[0])
    for magnetometer, own_map, checksum in zip(magnetometers, maps, checksums, strict=True):
        if own_map != maps[0] or checksum != checksums[0]:
            raise InputError(
                f"{place(magnetometer)}: reads another map than {magnetometers[0].GetPath()}; the robots of "
                "a scene share one"
            )
    earths = prims_with(world, "earth")
    if len(earths) > 1:
        raise InputError(f"{place(earths[1])}: a second Earth's field; the first is {earths[0].GetPath()}")
    earth = read_earth(earths[0]) if earths else None
    sources, furniture = read_magnets(stage)
    try:
        scene = Scene(
            name=Path(path).stem,
            map_layer=_layer_of(maps[0]),
            map_sha256=checksums[0],
            robot=robots[0].robot,
            lab=lab,
            earth=earth,
            sources=sources,
            furniture=furniture,
            start=robots[0].start,
            path=robots[0].path,
            others=tuple(robots[1:]),
        )
    except InputError as error:
        raise InputError(f"{place(prim)}: {error}") from error
    if scene.map_layer != Path(path).resolve():  # a flattened stage is its own map, and knows no checksum
        _check_map(scene, f"{place(magnetometers[0])}: ")
    return scene


def robots_in(path: str | os.PathLike[str]) -> dict[str, str | Path]:
    """The names of a stage's robots, in its order, and what each drives unless told otherwise.

    Raises:
        InputError: The file is missing or no stage, or has no robot.
    """
    stage = open_stage(path)  # held in a name: a prim does not keep its stage alive
    root = stage.GetPseudoRoot()
    prims = prims_with(root, "robot") or [only_prim_with(root, "robot")]  # refuses a stage of none
    return {prim.GetName(): read_way(prim) for prim in prims}


def open_alone(path: str | os.PathLike[str], robot: str) -> Usd.Stage:
    """A stage opened as if a robot were alone in it: others are inactive, in its session layer.

    Args:
        path: Root layer of a scene.
        robot: Name of the robot that stays; of a stage without one of that name, all stay.

    Raises:
        InputError: The file is missing or no stage.
    """
    stage = open_stage(path)
    prims = prims_with(stage.GetPseudoRoot(), "robot")
    if any(prim.GetName() == robot for prim in prims):
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            for prim in prims:
                prim.SetActive(prim.GetName() == robot)
    return stage


def _placed(prim: Usd.Prim, check_network: bool) -> PlacedRobot:
    """The robot at a prim, where it begins, and what it drives."""
    robot = robot_of(prim)
    network = robot.magnetometer.network
    neural = robot.magnetometer.kind == "neural"
    if check_network and neural and network is not None and not network.exists():
        raise InputError(
            f"{place(only_prim_with(prim, 'magnetometer'))}: magtwin:magnetometer:network names {network}, "
            "which is not there"
        )
    p, q = read_pose(prim)
    start = p[0], p[1], float(yaw_from_quat(q))
    try:
        return PlacedRobot(robot=robot, start=start, path=read_way(prim))
    except InputError as error:
        raise InputError(f"{place(prim)}: {error}") from error


@dataclass(frozen=True, kw_only=True)
class _RobotTable(RobotSettings):
    """The robot: an asset, or a URDF and what a URDF cannot say. For several robots, write [[robot]] each."""

    name: str = ""
    """Name of its prim, required for each of several robots. With urdf, the name that the URDF must give."""

    start: Vec3 | None = None
    """Where it stands at first: x [m], y [m] and yaw [rad]. By default that of the scene or, of several
    robots, where its path begins. Refused inside of furniture; the refusal names the nearest free place."""

    path: str = ""
    """What it drives unless told otherwise: the name of a path, "random", or a CSV file of x,y. Default:
    figure8."""

    asset: Path | None = None
    """Robot that ships, by its name ("turtlebot4"), or USD file made by `magtwin robot`."""

    urdf: Path | None = None
    """URDF or xacro file to convert, in place of an asset."""

    network: Path | None = None
    """Weights that predict the robot's disturbance, for a neural magnetometer."""

    kind: Literal["physical", "neural", "map-only"] | None = None
    """What its magnetometer reads: the exact field, the map and the network's prediction, or the map. By
    default neural with a network, else physical."""


@dataclass(frozen=True, kw_only=True)
class _EarthTable(EarthFieldSpec):
    """The Earth's field, uniform over the room. It follows from place and date by the IGRF-14, to 2030."""

    b_world_nt: Vec3 = ZERO3
    """Field in world axes [nT], where it was measured. Unless measured is true, it must be the model's within
    1 nT."""

    @property
    def spec(self) -> EarthFieldSpec:
        """What it says, its field filled in or checked."""
        return checked(EarthFieldSpec(**vars(self)))


@dataclass(frozen=True, kw_only=True)
class _SourcesTable:
    """Furniture and sources in a file of their own."""

    file: Path
    """TOML with [[furniture]] and [[source]] tables, which are added to those of the scene."""


@dataclass(frozen=True, kw_only=True)
class SceneFile:
    """A scene's TOML; docs/scenes.md is made from it."""

    name: str
    """Name of the scene and of its root layer: any that a file can have on every system."""

    robot: tuple[_RobotTable, ...]

    map: Path | None = None
    """USD layer of the magnetic map. By default the scene is surveyed, see above."""

    start: Vec3 = ZERO3
    """Where the robot stands at first: x [m], y [m] and yaw [rad]. A path begins where it begins."""

    seed: int = 0
    """Seed of the magnetization of furniture that gives none, and of the survey's noise."""

    lab: LabSpec = field(default_factory=LabSpec)
    earth: _EarthTable | None = None
    survey: SurveySpec | None = None
    sources: _SourcesTable | None = None
    source: tuple[SourceSpec, ...] = ()
    furniture: tuple[FurnitureTable, ...] = ()

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError(f"seed must not be below 0, got {self.seed}")


@dataclass(frozen=True, kw_only=True)
class _SourceFile:
    """A TOML of what is magnetised, one [[source]] or [[furniture]] each."""

    source: tuple[SourceSpec, ...] = ()
    furniture: tuple[FurnitureTable, ...] = ()


def scene_from_toml(
    path: str | os.PathLike[str],
    *,
    map_layer: str | os.PathLike[str] | None = None,
    network: str | os.PathLike[str] | None = None,
    workshop: str | os.PathLike[str] | None = None,
    inputs_of: Callable[[Path], tuple[str, ...]] = lambda weights: (),
    survey_of: Callable[[Scene, SurveySpec, int, Obstacles], Path] | None = None,
) -> Scene:
    """The scene that a TOML describes, as scenes/lab.toml does; docs/scenes.md has every key.

    Args:
        path: The TOML; files that it names are taken from its folder.
        map_layer: Map to use in place of the one that it names. The Earth's field, sources and furniture stay
            as the TOML has them; `magtwin.twin.scene_from_toml` refuses a map that contradicts them.
        network: Weights to use in place of those that it names.
        workshop: Folder in which the asset is built of a robot that the TOML names by its URDF; a
            self-contained scene copies it from there.
        inputs_of: Gives the names of the inputs of a weights file, which this room cannot read; see
            `magtwin.twin.scene_from_toml`. Without it the scene leaves them open.
        survey_of: Surveys a scene that names no map, whose `map_layer` is not there yet, and gives the map
            layer; called with the scene, how to survey it, the seed and what stands in the room.

    Raises:
        InputError: A key is misspelt or missing, or a file is not there; with file and line.
    """
    table = read_toml(path)
    alone = isinstance(table.get("robot"), dict)  # [robot], not [[robot]]
    if alone:
        table = table | {"robot": [table["robot"]]}
    given = from_table(SceneFile, table, path)
    if not given.robot:
        raise InputError(f"{path}: has no robot; add a [robot] table")
    try:
        check_name(given.name)
    except InputError as error:
        raise refused_at(path, "name", str(error)) from error
    layer = Path(map_layer).resolve() if map_layer is not None else given.map
    lab = lab_of(given.lab, table, path, None if layer is None else existing(layer, "map layer"))
    pieces = placed_furniture(given.furniture, lab, path, seed=given.seed)
    sources = given.source
    if given.sources:
        listed = read_sources(given.sources.file, seed=given.seed, lab=lab)
        sources, pieces = (*listed[0], *sources), (*listed[1], *pieces)
    if layer is None and (given.earth is None or survey_of is None):
        raise no_map(path, furnished=bool(pieces or sources))
    check_names(pieces, path)
    standing = obstacles_in(lab, pieces)
    robots: list[PlacedRobot] = []
    for number, (one, keys) in enumerate(zip(given.robot, table["robot"], strict=True)):
        where = f"{path}: [robot]" if alone else f"{path}: [[robot]] {one.name!r}"
        robot = _robot(one, keys, where, workshop, named=not alone)
        robot = _with_network(robot, one, network, where, inputs_of)
        way = _way(one.path, Path(path).parent, where)
        start, of_robot = one.start, True
        if start is None:
            of_robot = not (alone or (not robots and "start" in table))
            room = Room(lab.floor_m, robot.footprint_radius_m, standing)
            start = _beginning(way, room) if of_robot else given.start
        robots.append(PlacedRobot(robot=robot, start=start, path=way))
        try:
            check_start(robots[-1], lab, standing)
        except InputError as error:
            section = {"section": "robot", "number": number} if of_robot else {}
            raise refused_at(path, "start", str(error), **section) from error  # type: ignore[arg-type]
    scene = Scene(
        name=given.name,
        map_layer=Path("surveyed") if layer is None else existing(layer, "map layer"),
        map_sha256="" if layer is None else sha256(layer),
        robot=robots[0].robot,
        lab=lab,
        earth=_earth(given.earth, path) if given.earth else None,
        sources=sources,
        furniture=pieces,
        start=robots[0].start,
        path=robots[0].path,
        others=tuple(robots[1:]),
    )
    if layer is None and survey_of is not None:
        _check_things(scene)
        try:
            surveyed = survey_of(scene, given.survey or SurveySpec(), given.seed, standing)
        except InputError as error:
            raise InputError(f"{path}: cannot be surveyed: {error}") from error
        scene = replace(scene, map_layer=surveyed, map_sha256=sha256(surveyed))
    return scene


def _robot(
    table: _RobotTable,
    keys: Mapping[str, Any],
    where: str,
    workshop: str | os.PathLike[str] | None,
    *,
    named: bool,
) -> RobotSpec:
    """The robot of a table of a scene's TOML, built from its URDF where it names one, under its name."""
    if named and not table.name:
        raise InputError(f'{where} needs name = "NAME", that of its prim')
    if table.asset is not None and table.urdf is None:
        known = {"asset", "network", "kind", "start", "path", *(["name"] if named else [])}
        if others := sorted(set(keys) - known):
            raise InputError(f"{where} {others[0]} goes with urdf; the asset says it already")
        robot = read_robot(asset_named(table.asset, keys["asset"], where))
        return replace(robot, name=table.name) if named else robot
    if table.urdf is None or table.asset is not None:
        raise InputError(f'{where} needs asset = "FILE.usda" or urdf = "FILE.urdf", one of the two')
    if workshop is None:
        raise InputError(f"{where} names a URDF; name a workshop, a folder to build the robot in")
    settings = RobotSettings(**{f.name: getattr(table, f.name) for f in fields(RobotSettings)})
    if named:
        settings = replace(settings, name="")  # takes any of the URDF's own
    folder = Path(workshop) / table.name if named else Path(workshop)
    asset = folder / f"{table.urdf.name.split('.')[0]}.usda"
    asset.parent.mkdir(parents=True, exist_ok=True)
    try:
        build_robot(table.urdf, settings, asset)
    except InputError as error:
        raise InputError(f"{where} {error}") from error
    robot = read_robot(asset)
    return replace(robot, name=table.name) if named else robot


def _with_network(
    robot: RobotSpec,
    table: _RobotTable,
    network: str | os.PathLike[str] | None,
    where: str,
    inputs_of: Callable[[Path], tuple[str, ...]],
) -> RobotSpec:
    """A robot with the weights of its table, or those given in their place, and the kind that it says."""
    weights = Path(network).resolve() if network is not None else table.network
    if weights is not None:
        weights = existing(weights, "weights file")
        magnetometer = replace(
            robot.magnetometer,
            kind="neural",
            network=weights,
            network_sha256=sha256(weights),
            inputs=inputs_of(weights),
        )
        robot = replace(robot, magnetometer=magnetometer)
    if table.kind is not None and network is None:
        robot = replace(robot, magnetometer=replace(robot.magnetometer, kind=table.kind))
    if robot.magnetometer.kind == "neural" and robot.magnetometer.network is None:
        raise InputError(f'{where} kind = "neural" needs network = "FILE" beside it')
    return robot


def _way(path: str, folder: Path, where: str) -> str | Path:
    """What a robot is said to drive: a name, or a file from the TOML's folder; refused if it is neither."""
    if path in ("", "random"):
        return path
    file = (folder / path).resolve()
    named = not Path(path).suffix and not file.exists()
    try:
        resolve_path(path if named else file)
    except InputError as error:
        raise InputError(f"{where} path: {error}") from error
    return path if named else file


def _beginning(way: str | Path, room: Room) -> Vec3:
    """Where a path begins and whither it goes, so that robots of one scene do not stand in each other."""
    if way in ("", "random"):
        return ZERO3
    path = path_in(room, way)
    x, y = path.p_xy[0].tolist()
    return x, y, float(path.heading(0.0))


def _earth(table: _EarthTable, path: str | os.PathLike[str]) -> EarthFieldSpec:
    try:
        return table.spec
    except InputError as error:
        raise InputError(f"{path}: [earth] {error}") from error


def read_sources(
    path: str | os.PathLike[str], *, seed: int = 0, lab: LabSpec | None = None
) -> tuple[tuple[SourceSpec, ...], tuple[FurnitureSpec, ...]]:
    """The sources and the furniture of a TOML such as maps/lab/sources.toml.

    Args:
        path: The TOML.
        seed: Seed of the magnetization of furniture that gives none.
        lab: Room whose slab the furniture must stand on; None does not check.

    Raises:
        InputError: A key is misspelt or missing, a figure is out of range, or a piece stands beside the
            slab; with file and line.
    """
    listed = from_table(_SourceFile, read_toml(path), path)
    return listed.source, placed_furniture(listed.furniture, lab, path, seed=seed)


def _check(scene: Scene) -> None:
    """Refuse what would come out broken, before anything is written, by the names that the caller knows."""
    check_name(scene.name)
    for placed in scene.robots:
        if check_prim_name(placed.robot.name, "robot") in TAKEN:
            raise InputError(f"robot {placed.robot.name!r} has the name of a part of the scene; rename it")
    _check_things(scene)
    load_map(scene.map_layer)
    _check_map(scene)
    for placed in scene.robots:
        read_robot(placed.robot.asset)
        if placed.robot.magnetometer.network is not None:
            existing(placed.robot.magnetometer.network, "weights file")
        if isinstance(placed.path, Path):
            existing(placed.path, "path file")


def _check_things(scene: Scene) -> None:
    """Refuse sources and furniture that cannot stand on one stage, or whose field cannot be computed."""
    for what, things in (("sources", scene.sources), ("pieces of furniture", scene.furniture)):
        names = [thing.name for thing in things]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(f"two {what} are called {twice[0]!r}; give each a name of its own")
    if any(source.name == LOOKS for source in scene.sources):
        raise InputError(f"source {LOOKS!r} has the name of the materials beside it; rename it")
    for source in scene.magnets:
        if source.susceptibility and scene.earth is None:
            body_of(source)  # refuses


def _check_map(scene: Scene, where: str = "") -> None:
    """Refuse a map that is another than the scene was made with, and so than its Earth and sources."""
    if scene.map_sha256 and (seen := sha256(scene.map_layer)) != scene.map_sha256.lower():
        raise InputError(
            f"{where}{scene.map_layer}: has SHA-256 {seen}, but scene {scene.name!r} was made with a map of "
            f"{scene.map_sha256}; put that map back, or make the scene anew with this one"
        )


def _check_axes(stage: Usd.Stage, path: str | os.PathLike[str]) -> None:
    metres, up = UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)
    if not (UsdGeom.LinearUnitsAre(metres, UsdGeom.LinearUnits.meters) and up == UsdGeom.Tokens.z):
        raise InputError(
            f"{path}: the stage has {metres:g} m a unit and {up} up; magtwin reads metres with Z up"
        )


def _with_copies(scene: Scene, folder: Path) -> Scene:
    """The scene on copies of its files in `folder`; what several robots share is copied once."""
    copies: dict[Path, Path] = {}

    def once(file: Path, kind: str, name: str, copy: Callable[[Path, Path], Path]) -> Path:
        source = file.resolve()
        if source not in copies:
            # Files of further robots have a folder of their own, as others may have their names.
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
        asset = once(robot.asset, "robot", robot.name, _copied_asset)
        if isinstance(path, Path):
            path = once(path, "paths", robot.name, _copied)
        robot = replace(robot, asset=asset, magnetometer=magnetometer)
        robots.append(PlacedRobot(robot=robot, start=placed.start, path=path))
    return replace(
        scene,
        map_layer=_copied(scene.map_layer, folder / "map"),
        robot=robots[0].robot,
        path=robots[0].path,
        others=tuple(robots[1:]),
    )


def _copied(file: Path, folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return Path(shutil.copyfile(file, folder / file.name))


def _copied_asset(asset: Path, folder: Path) -> Path:
    """A USD file copied with every file that it names, in the same arrangement, its picture and its URDF.

    The URDF is what live robots and bags say of it; the meshes that it names stay behind: the asset has them.
    """
    asset = asset.resolve()
    layers, assets, unresolved = UsdUtils.ComputeAllDependencies(str(asset))
    if unresolved:
        raise InputError(f"{asset}: names {unresolved[0]}, which is not there")
    files = sorted({asset, *(Path(layer.realPath).resolve() for layer in layers), *map(Path, assets)})
    outside = [file for file in files if not file.is_relative_to(asset.parent)]
    if outside:
        raise InputError(f"{asset}: names {outside[0]}, outside its folder; copy it into {asset.parent}")
    common = Path(os.path.commonpath([file.parent for file in files]))
    picture = asset.parent / THUMBNAILS / f"{asset.name}.png"
    for file in (*files, *([picture] if picture.is_file() else [])):
        _copied(file, (folder / file.relative_to(common)).parent)
    if (urdf := description_of(asset)) is not None:
        _copied(urdf, (folder / asset.relative_to(common)).parent)
    return folder / asset.relative_to(common)


def _part(scene: Scene, folder: Path, name: str) -> Path:
    """A layer of a scene, under a name that its root layer does not have."""
    taken = scene.name.casefold() == name
    return folder / (f"{name}_layer.usda" if taken else f"{name}.usda")


def _write_room(scene: Scene, folder: Path) -> Path:
    path = _part(scene, folder, "room")
    with new_stage(path, "The room, its lights and its physics, by magtwin") as stage:
        define_lab(stage, scene.lab)
    return path


def _write_magnetics(scene: Scene, folder: Path) -> list[Path]:
    if scene.earth is None and not scene.sources:
        return []
    path = _part(scene, folder, "magnetics")
    with new_stage(path, "What makes the magnetic field: the Earth and magnetised things") as stage:
        if scene.earth is not None:
            define_earth(stage, EARTH, scene.earth)
        if scene.sources:
            define_sources(stage, scene.sources)
    return [path]


def _write_furniture(scene: Scene, folder: Path) -> list[Path]:
    if not scene.furniture:
        return []
    path = _part(scene, folder, "furniture")
    with new_stage(path, "Furniture and columns, and how they are magnetised") as stage:
        define_furniture(stage, scene.furniture)
    return [path]


def _define_robot(stage: Usd.Stage, placed: PlacedRobot, map_sha256: str) -> None:
    """A robot by reference, where it starts, with overs for what differs from its asset."""
    robot, root = placed.robot, stage.GetRootLayer()
    prim = UsdGeom.Xform.Define(stage, WORLD.AppendChild(robot.name)).GetPrim()
    prim.GetReferences().AddReference(relative_asset(root, robot.asset))
    x, y, yaw = placed.start
    write_pose(prim, (x, y, 0.0), tuple(map(float, quat_from_yaw(yaw))))  # type: ignore[arg-type]
    define_footprint(prim, robot.footprint_radius_m)
    define_way(prim, placed.path)
    define_drive(prim, robot.drive)
    define_platform(prim, robot.platform)
    define_mocap(prim, robot.mocap)
    for part, define in PARTS.items():
        define(stage, only_prim_with(prim, part).GetPath(), getattr(robot, part))
    magnetometer = only_prim_with(prim, "magnetometer")
    map_prim = only_prim_with(stage.GetPrimAtPath(WORLD), "anomalyMap")
    magnetometer.GetRelationship(MAP_RELATIONSHIP).SetTargets([map_prim.GetPath()])
    if map_sha256:
        magnetometer.GetAttribute(MAP_CHECKSUM).Set(map_sha256)


def _settle(layer: Sdf.Layer, aside: Path, final: Path) -> None:
    """Make paths that leave the folder `aside`, where the layer is written, right for `final`, its place."""
    aside = aside.resolve()

    def settled(path: str) -> str:
        absolute = (aside / path).resolve()
        if absolute.is_relative_to(aside):
            return f"./{absolute.relative_to(aside).as_posix()}"
        return Path(os.path.relpath(absolute, final)).as_posix()

    UsdUtils.ModifyAssetPaths(layer, settled)


def _layer_of(field_map: Usd.Prim) -> Path:
    """The layer that holds a map's values."""
    specs = field_map.GetAttribute("magtwin:anomalyMap:values").GetPropertyStack()
    return Path(specs[0].layer.realPath).resolve()
