"""A scene read from its stage, which is opened once."""

import os
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from pxr import Usd, UsdGeom

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.files import sha256
from magtwin.frames import yaw_from_quat
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import PlacedRobot
from magtwin.spec.scene import Scene
from magtwin.usd.attributes import plain_value, read_pose, target
from magtwin.usd.earth import read_earth
from magtwin.usd.furniture import read_magnets
from magtwin.usd.geometry import Link, Shape, read_links, read_shapes
from magtwin.usd.lab import read_lab
from magtwin.usd.layers import open_stage, stage_sha256
from magtwin.usd.maps import read_map
from magtwin.usd.obstacles import read_obstacles
from magtwin.usd.robot import read_robot
from magtwin.usd.schema import only_prim_with, place, prims_with, require_api
from magtwin.usd.sensors import MAP_CHECKSUM, MAP_RELATIONSHIP, read_path


@dataclass(frozen=True, eq=False)
class OpenedScene:
    """A stage that is open, and what has been read from it. Each part is read once, when it is first used."""

    file: Path
    """Root layer, as it was named."""

    stage: Usd.Stage
    scene: Scene
    map: AnomalyMap

    @cached_property
    def obstacles(self) -> Obstacles:
        """Colliders that stand still."""
        return read_obstacles(self.stage)

    @cached_property
    def links(self) -> dict[str, Link]:
        """Links of every robot, by name."""
        return read_links(self.stage)

    @cached_property
    def shapes(self) -> list[Shape]:
        """What a viewer shows: shapes of the lab and of every robot."""
        return read_shapes(self.stage)

    @cached_property
    def sha256(self) -> str:
        """Checksum of the stage and of every file that it names."""
        return stage_sha256(self.file)

    def alone(self, robot: str) -> "OpenedScene":
        """The scene with one robot, and a stage on which the others are inactive. The layers are shared.

        Args:
            robot: Name of the robot that stays.

        Raises:
            UnknownNameError: There is no such robot; the text names the nearest one.
        """
        scene = replace(self.scene.led_by(robot), others=())
        if not self.scene.others:
            return self
        stage = _alone(Usd.Stage.Open(self.stage.GetRootLayer()), robot)
        return OpenedScene(self.file, stage, scene, self.map)


def open_scene(path: str | os.PathLike[str], *, check_network: bool = True) -> OpenedScene:
    """Open the stage of a scene once: its Scene and map, and its obstacles and geometry when asked for.

    Args:
        path: Root layer, as `author_scene` wrote it or as others edited it. A start's yaw is computed from a
            quaternion, so its last bits can differ from what was authored.
        check_network: Whether the weights that the magnetometer names must exist.

    Raises:
        InputError: The file or one that it names is missing; the stage has no lab, robot or map; a value is
            out of range; or the map is not the one that the scene was made with. The text names the prim.
    """
    path = Path(path)
    if path.suffix == ".usdz":
        raise InputError(
            f"{path}: files inside a package cannot be read; unpack it with `magtwin export {path.name} "
            "--out DIR` and give the layer in DIR"
        )
    stage = open_stage(path)
    metres, up = UsdGeom.GetStageMetersPerUnit(stage), UsdGeom.GetStageUpAxis(stage)
    if not (UsdGeom.LinearUnitsAre(metres, UsdGeom.LinearUnits.meters) and up == UsdGeom.Tokens.z):
        raise InputError(
            f"{path}: the stage has {metres:g} m a unit and {up} up; magtwin reads metres with Z up"
        )
    world = stage.GetPseudoRoot()
    lab = read_lab(only_prim_with(world, "lab"))
    prims = _robot_prims(stage)
    robots = [_read_placed(prim, check_network) for prim in prims]
    magnetometers = [only_prim_with(prim, "magnetometer") for prim in prims]
    maps = [require_api(target(m, MAP_RELATIONSHIP), "anomalyMap") for m in magnetometers]
    checksums = [plain_value(m.GetAttribute(MAP_CHECKSUM)) for m in magnetometers]
    anomaly_map = read_map(maps[0])
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
    values = maps[0].GetAttribute("magtwin:anomalyMap:values").GetPropertyStack()
    try:
        scene = Scene(
            name=path.stem,
            map_layer=Path(values[0].layer.realPath).resolve(),
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
        raise InputError(f"{place(prims[0])}: {error}") from error
    if scene.map_layer != path.resolve():  # a flattened stage is its own map, and has no checksum
        check_map(scene, f"{place(magnetometers[0])}: ")
    return OpenedScene(path, stage, scene, anomaly_map)


def read_scene(path: str | os.PathLike[str], *, check_network: bool = True) -> Scene:
    """The scene of a stage; arguments and errors as for `open_scene`."""
    return open_scene(path, check_network=check_network).scene


def robots_in(path: str | os.PathLike[str]) -> dict[str, str | Path]:
    """Default path of each robot of a stage, by the robot's name, in the stage's order.

    Raises:
        InputError: The file is missing or not USD, or has no robot.
    """
    stage = open_stage(path)  # held in a name: a prim does not keep its stage alive
    return {prim.GetName(): read_path(prim) for prim in _robot_prims(stage)}


def open_alone(path: str | os.PathLike[str], robot: str) -> Usd.Stage:
    """A stage on which all robots but one are inactive.

    Args:
        path: Root layer of a scene.
        robot: Name of the robot that stays. If there is no such robot, all stay.

    Raises:
        InputError: The file is missing or not USD.
    """
    return _alone(open_stage(path), robot)


def _alone(stage: Usd.Stage, robot: str) -> Usd.Stage:
    """The stage, with robots other than `robot` made inactive in its session layer."""
    prims = prims_with(stage.GetPseudoRoot(), "robot")
    if any(prim.GetName() == robot for prim in prims):
        with Usd.EditContext(stage, stage.GetSessionLayer()):
            for prim in prims:
                prim.SetActive(prim.GetName() == robot)
    return stage


def check_map(scene: Scene, where: str = "") -> None:
    """Refuse a map layer that is not the one that the scene was made with, by its checksum.

    Args:
        scene: The scene; no checksum accepts any map.
        where: How the text of the error begins.

    Raises:
        InputError: The checksum differs.
    """
    if scene.map_sha256 and (actual := sha256(scene.map_layer)) != scene.map_sha256.lower():
        raise InputError(
            f"{where}{scene.map_layer}: has SHA-256 {actual}, but scene {scene.name!r} was made with a map "
            f"of {scene.map_sha256}; put that map back, or make the scene anew with this one"
        )


def _robot_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Prims of a stage's robots, at least one."""
    root = stage.GetPseudoRoot()
    return prims_with(root, "robot") or [only_prim_with(root, "robot")]  # raises if there is none


def _read_placed(prim: Usd.Prim, check_network: bool) -> PlacedRobot:
    """The robot at a prim, its start and its default path."""
    robot = read_robot(prim)
    network = robot.magnetometer.network
    neural = robot.magnetometer.kind == "neural"
    if check_network and neural and network is not None and not network.exists():
        raise InputError(
            f"{place(only_prim_with(prim, 'magnetometer'))}: magtwin:magnetometer:network names {network}, "
            "which is not there"
        )
    p, q = read_pose(prim)
    try:
        return PlacedRobot(robot=robot, start=(p[0], p[1], float(yaw_from_quat(q))), path=read_path(prim))
    except InputError as error:
        raise InputError(f"{place(prim)}: {error}") from error
