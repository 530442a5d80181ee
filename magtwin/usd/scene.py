"""A scene read from its stage, which is opened once."""

import math
import os
import re
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError, about
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.scene_state import changes_since
from magtwin.files.outputs import transaction
from magtwin.frames import yaw_from_quat
from magtwin.spec.magnetics import EarthFieldSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import PlacedRobot, fields_of
from magtwin.spec.scene import Scene
from magtwin.usd.attributes import plain_value, read_pose, target
from magtwin.usd.geometry import Link, Shape, read_links, read_shapes
from magtwin.usd.lab.earth import AGREES_NT, read_earth
from magtwin.usd.lab.furniture import read_magnets
from magtwin.usd.lab.obstacles import read_obstacles
from magtwin.usd.lab.room import read_lab
from magtwin.usd.lab.sources import read_transform
from magtwin.usd.layers import layer_sha256, open_stage, relative_asset, save_layer, stage_sha256, translates
from magtwin.usd.maps.attributes import MADE_FROM
from magtwin.usd.maps.layer import check_map_layer, load_map, read_map
from magtwin.usd.placement import (
    AT_ORIGIN,
    SAME,
    UPRIGHT,
    Lab,
    Pose,
    into_lab,
    lab_on,
    labs_on,
    nearest_lab,
    pose_of,
    take_to_origin,
)
from magtwin.usd.robot import read_robot
from magtwin.usd.schema import (
    attribute_name,
    author,
    has_api,
    only_prim_with,
    place,
    prims_with,
    require_api,
)
from magtwin.usd.schema.versions import check_schema
from magtwin.usd.sensors import MAP_CHECKSUM, MAP_RELATIONSHIP, read_path
from magtwin.usd.trial import folders_of
from magtwin.usd.units import check_units

LEVEL_M = 1e-3
"""Height of a robot above the floor that counts as none [m]."""


@dataclass(frozen=True, eq=False)
class OpenedScene:
    """A stage that is open, and what has been read from it. Each part is read once, when it is first used."""

    file: Path
    """Root layer, as it was named."""

    stage: Usd.Stage
    """The stage, with the lab's axes as the world's and without other labs."""

    scene: Scene
    map: AnomalyMap

    lab: str = ""
    """Path of the lab's root; "" if the lab is the only one."""

    pose: Pose | None = None
    """Pose of the lab in its stage; None if it is at the origin."""

    changes: tuple[str, ...] = ()
    """What has changed on the stage since the map was made."""

    notes: tuple[str, ...] = ()
    """What was guessed or left out, one text each."""

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
        stage = _alone(_placed(Usd.Stage.Open(self.stage.GetRootLayer()), self.lab), robot)
        return replace(self, stage=stage, scene=scene)


def saved_as(stage: Usd.Stage) -> Path | None:
    """The file that a stage in memory is equal to; None if it has changes that are not saved."""
    root = stage.GetRootLayer()
    dirty = any(layer.dirty for layer in stage.GetUsedLayers() if layer != stage.GetSessionLayer())
    return None if dirty or not root.realPath else Path(root.realPath)


def _live(stage: Usd.Stage) -> tuple[Path, Usd.Stage]:
    """A stage of one's own with the layers of another, and a name for it."""
    root = stage.GetRootLayer()
    own = Usd.Stage.Open(root, Sdf.Layer.CreateAnonymous())
    check_schema(own, root.identifier)
    stem = Path(root.GetDisplayName()).stem
    return Path(root.realPath or f"{stem if re.match(r'[A-Za-z0-9]', stem) else 'stage'}.usda"), own


@translates
def open_scene(
    path: str | os.PathLike[str] | Usd.Stage,
    *,
    lab: str = "",
    map_layer: str | os.PathLike[str] | None = None,
    check_network: bool = True,
) -> OpenedScene:
    """Open the stage of a scene once: its Scene and map, and its obstacles and geometry when asked for.

    All places are in the axes of the lab, wherever it stands on the stage (`magtwin.usd.placement`).

    Args:
        path: Root layer, or a stage that is open in this process, with its changes that are not saved. A
            start's yaw comes from a quaternion: its last bits may not be those authored.
        lab: Path of the lab's root on a stage of several labs. Default: the only lab.
        map_layer: Map that replaces the stage's.
        check_network: Whether the weights that the magnetometer names must exist.

    Raises:
        InputError: A file is missing; the stage has no lab, robot or map, or a lab that is tilted or scaled;
            a value is out of range; or the map is not that of the scene. The text names the prim.
    """
    live = isinstance(path, Usd.Stage)
    if isinstance(path, Usd.Stage):
        path, stage = _live(path)
    else:
        path = Path(path)
        if path.suffix.lower() == ".usdz":
            way = f"unpack it with `magtwin export {quote(str(path))} --out DIR` and give the layer in DIR"
            raise InputError(f"{path}: files inside a package cannot be read; {way}")
        stage = open_stage(path)
    where = lab_on(stage, lab)
    several, pose = len(labs_on(stage)) > 1, pose_of(where)
    check_units(stage)
    earth, notes = earth_in(stage, where)
    take_to_origin(stage, where)
    prims = _robot_prims(stage)
    robots = [_read_placed(prim, check_network, notes) for prim in prims]
    magnetometers = [only_prim_with(prim, "magnetometer") for prim in prims]
    maps = [map_of(magnetometer) for magnetometer in magnetometers]
    checksums = [plain_value(m.GetAttribute(MAP_CHECKSUM)) for m in magnetometers]
    if map_layer is not None:
        check_map_layer(map_layer)
        anomaly_map, layer, checksum = load_map(map_layer), Path(map_layer), layer_sha256(map_layer)
    else:
        values = maps[0].GetAttribute(attribute_name("anomalyMap", "values")).GetPropertyStack()
        anomaly_map, layer, checksum = read_map(maps[0]), Path(values[0].layer.realPath), checksums[0]
    for magnetometer, own_map, own_checksum in zip(magnetometers, maps, checksums, strict=True):
        if own_map != maps[0] or own_checksum not in ("", checksums[0]):
            raise InputError(
                f"{place(magnetometer)}: reads another map than {magnetometers[0].GetPath()}; the robots of "
                "a scene share one"
            )
    sources, furniture = read_magnets(stage)
    with about(f"{place(prims[0])}:"):
        scene = Scene(
            name=path.stem,
            map_layer=layer.resolve(),
            map_sha256=checksum,
            lab=read_lab(only_prim_with(stage.GetPseudoRoot(), "lab")),
            earth=earth,
            sources=sources,
            furniture=furniture,
            **fields_of(robots),
        )
    if scene.map_layer != path.resolve():  # a flattened stage is its own map, and has no checksum
        check_map(scene, f"{place(magnetometers[0])}: ")
    made = anomaly_map.made_from
    opened = OpenedScene(
        path,
        stage,
        scene,
        anomaly_map,
        lab=where.path if several else "",
        pose=None if pose == AT_ORIGIN else pose,
        changes=() if made is None else tuple(changes_since(made, scene)),
        notes=tuple(notes),
    )
    if live:  # the file, if there is one, has other content
        texts = sorted(layer.ExportToString() for layer in stage.GetUsedLayers() if not layer.anonymous)
        texts.append(stage.GetRootLayer().ExportToString())
        opened.__dict__["sha256"] = sha256("\n".join(texts).encode()).hexdigest()
    return opened


def read_scene(path: str | os.PathLike[str] | Usd.Stage, **options: Any) -> Scene:
    """The scene of a stage: of its file, or of a `pxr.Usd.Stage` with its changes that are not saved.

    Arguments and errors are those of `open_scene`.
    """
    return open_scene(path, **options).scene


@translates
def robots_in(path: str | os.PathLike[str], *, lab: str = "") -> dict[str, str | Path]:
    """Default path of each robot of a lab, by the robot's name, in the stage's order.

    Raises:
        InputError: The file is missing or not USD, or has no robot; or as for `open_scene`, for `lab`.
    """
    stage = _placed(open_stage(path), lab)  # held in a name: a prim does not keep its stage alive
    return {prim.GetName(): read_path(prim) for prim in _robot_prims(stage)}


@translates
def open_alone(path: str | os.PathLike[str], robot: str, *, lab: str = "") -> Usd.Stage:
    """A stage in the axes of a lab, on which other labs and all robots but one are inactive.

    Args:
        path: Root layer of a scene.
        robot: Name of the robot that stays. If there is no such robot, all stay.
        lab: As for `open_scene`. A stage without a lab stays where it is.

    Raises:
        InputError: The file is missing or not USD, or as for `open_scene`, for `lab`.
    """
    return _alone(_placed(open_stage(path), lab), robot)


def as_layer(stage: Usd.Stage) -> str:
    """Text of a layer that other programs open as `open_alone` has it: its edits over the stage's file."""
    layer, root = Sdf.Layer.CreateAnonymous(".usda"), stage.GetRootLayer()
    layer.TransferContent(stage.GetSessionLayer())
    layer.subLayerPaths = [Path(root.realPath).as_posix()]
    layer.defaultPrim = root.defaultPrim
    placed = Usd.Stage.Open(layer)
    UsdGeom.SetStageMetersPerUnit(placed, UsdGeom.GetStageMetersPerUnit(stage))
    UsdGeom.SetStageUpAxis(placed, UsdGeom.GetStageUpAxis(stage))
    UsdPhysics.SetStageKilogramsPerUnit(placed, UsdPhysics.GetStageKilogramsPerUnit(stage))
    return str(layer.ExportToString())


def _placed(stage: Usd.Stage, lab: str) -> Usd.Stage:
    """The stage in the axes of a lab, if it has one."""
    if labs_on(stage):
        take_to_origin(stage, lab_on(stage, lab))
    return stage


def earth_in(stage: Usd.Stage, lab: Lab) -> tuple[EarthFieldSpec | None, list[str]]:
    """The Earth's field in the lab's axes, and a text for each other field on the stage that contradicts it.

    The lab's own field turns with the lab: the map was measured with it. Without one, the field of the stage
    is turned into the lab's axes.
    """
    prims = [prim for prim in stage.Traverse(Usd.TraverseInstanceProxies()) if has_api(prim, "earth")]
    found = [(prim, _turned(read_earth(prim), into_lab(lab, prim))) for prim in prims]
    own = [(p, e) for p, e in found if nearest_lab(p, labs_on(stage)) == lab]
    free = [(p, e) for p, e in found if nearest_lab(p, labs_on(stage)) is None]
    for those in (own, [] if own else free):
        if len(those) > 1:
            first = those[0][0].GetPath()
            raise InputError(f"{place(those[1][0])}: a second Earth's field; the first is {first}")
    if not (own or free):
        return None, []
    chosen, earth = (own or free)[0]
    notes = []
    for prim, other in found:
        off = math.dist(other.b_world_nt, earth.b_world_nt)
        if prim != chosen and off > AGREES_NT:
            notes.append(
                f"{place(prim)}: its Earth's field differs by {off:,.0f} nT from that of {chosen.GetPath()}, "
                f"in the axes of {lab.path}; the lab is turned against it, or surveyed elsewhere"
            )
    return earth, notes


def _turned(earth: EarthFieldSpec, matrix: Gf.Matrix4d) -> EarthFieldSpec:
    """An Earth's field in the axes that a transform leads to, such as those of a lab turned about z."""
    if matrix == Gf.Matrix4d(1):
        return earth
    turn = matrix.RemoveScaleShear()
    x, y, z = turn.TransformDir(Gf.Vec3d(*earth.b_world_nt))
    north = turn.TransformDir(Gf.Vec3d(0, 1, 0))
    yaw = math.degrees(math.atan2(-north[0], north[1]))
    return replace(earth, b_world_nt=(x, y, z), north_deg=math.remainder(earth.north_deg + yaw, 360))


def map_of(magnetometer: Usd.Prim) -> Usd.Prim:
    """The map that a magnetometer reads.

    Raises:
        InputError: It names none, another kind of prim, or several; the text names the maps of the stage.
    """
    try:
        return require_api(target(magnetometer, MAP_RELATIONSHIP), "anomalyMap")
    except InputError as error:
        maps = prims_with(magnetometer.GetStage().GetPseudoRoot(), "anomalyMap")
        known = ", ".join(str(prim.GetPath()) for prim in maps) or "none"
        raise InputError(f"{error}; maps of the lab: {known}") from error


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
    if scene.map_sha256 and (actual := layer_sha256(scene.map_layer)) != scene.map_sha256.lower():
        raise InputError(
            f"{where}{scene.map_layer}: has SHA-256 {actual}, but scene {scene.name!r} was made with a map "
            f"of {scene.map_sha256}; put that map back, or make the scene anew with this one"
        )


def use_map(
    opened: OpenedScene,
    map_layer: str | os.PathLike[str],
    *,
    written: Path | None = None,
    dry: bool = False,
) -> None:
    """Let the stage of a scene read another map, in place of the old one among its sublayers.

    Args:
        opened: The scene.
        map_layer: Layer of the new map, whose prim has the path of the old one.
        written: Where the new layer is until the end of a transaction. Default: in its place.
        dry: Whether to check only; the new layer need not exist then.

    Raises:
        InputError: The old map is no sublayer of this stage: it comes from another stage by reference, or is
            part of the root layer. Or the new map is outside the stage's folder.
    """
    stage, map_layer = opened.stage, Path(map_layer)
    old = opened.scene.map_layer
    held = [
        (layer, name)
        for layer in stage.GetLayerStack(includeSessionLayers=False)
        for name in layer.subLayerPaths
        if Path(layer.ComputeAbsolutePath(name)).resolve() == old
    ]
    if not held:
        text = f"the map {old} is no sublayer of this stage, so it cannot be replaced here"
        way = "survey the stage that has it as a sublayer"
        raise InputError(f"{opened.file}: {text}; {way}", parameter="adopt")
    if not any(map_layer.resolve().is_relative_to(folder) for folder in folders_of(opened.file)):
        text = f"is not in the folder of {opened.file}, so the stage may not name it"
        way = f"write the map into {opened.file.resolve().parent}"
        raise InputError(f"{map_layer}: {text}; {way}", parameter="adopt")
    if dry:
        return
    written = written or map_layer
    changed = {stage.GetRootLayer()}
    for layer, name in held:
        new = relative_asset(layer, written)
        layer.subLayerPaths = [new if n == name else n for n in layer.subLayerPaths]
        changed.add(layer)
    checksum = layer_sha256(written)
    with Usd.EditContext(stage, stage.GetRootLayer()):
        for prim in prims_with(stage.GetPseudoRoot(), "magnetometer"):
            author(prim.GetAttribute(MAP_CHECKSUM), checksum)
    for prim in prims_with(stage.GetPseudoRoot(), "anomalyMap"):
        for layer in stage.GetLayerStack(includeSessionLayers=False):
            over = layer.GetPrimAtPath(prim.GetPath())
            if layer.realPath != str(written.resolve()) and over and MADE_FROM in over.attributes:
                over.RemoveProperty(over.attributes[MADE_FROM])
                changed.add(layer)
    with transaction():
        for layer in changed:
            save_layer(layer, {relative_asset(layer, written): relative_asset(layer, map_layer)})


def _robot_prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Prims of a stage's robots, at least one."""
    root = stage.GetPseudoRoot()
    return prims_with(root, "robot") or [only_prim_with(root, "robot")]  # raises if there is none


def _read_placed(prim: Usd.Prim, check_network: bool, notes: list[str]) -> PlacedRobot:
    """The robot at a prim, its start in the lab and its default path."""
    world = UsdGeom.XformCache().GetLocalToWorldTransform(prim)
    rows = np.array(world)[:3, :3]
    if np.abs(rows @ rows.T - np.eye(3)).max() > SAME or rows[0] @ np.cross(rows[1], rows[2]) < 0:
        text = "the robot is scaled or mirrored; clear its scale and those above it"
        raise InputError(f"{place(prim)}: {text}")
    robot = read_robot(prim)
    sensor, network = only_prim_with(prim, "magnetometer"), robot.magnetometer.network
    neural = check_network and robot.magnetometer.kind == "neural"
    if neural and network is not None and not network.exists():
        text = f"magtwin:magnetometer:network names {network}, which is not there"
        raise InputError(f"{place(sensor)}: {text}")
    p, q = read_pose(prim)
    if UsdGeom.XformCache().GetParentToWorldTransform(prim) != Gf.Matrix4d(1):
        p, q, _ = read_transform(prim)
    if rows[2, 2] < UPRIGHT or abs(p[2]) > LEVEL_M:
        text = f"stands {p[2]:g} m above the floor or tilted; a run starts it on the floor"
        notes.append(f"{place(prim)}: {text}")
    with about(f"{place(prim)}:"):
        return PlacedRobot(robot=robot, start=(p[0], p[1], float(yaw_from_quat(q))), path=read_path(prim))
