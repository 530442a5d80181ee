"""Robot: an asset with drive, battery and sensors, from a URDF and what a URDF cannot say."""

import os
from pathlib import Path

from pxr import Sdf, Usd, UsdPhysics

from magtwin.files import existing, from_table, read_toml
from magtwin.names import RefusedError, hint
from magtwin.spec import MountSpec, RobotSpec
from magtwin.usd.layers import open_stage
from magtwin.usd.sensors import (
    define_battery,
    define_drive,
    define_footprint,
    define_imu,
    define_lidar,
    define_magnetometer,
    define_platform,
    read_robot_prim,
)
from magtwin.usd.urdf.convert import convert_urdf
from magtwin.usd.urdf.options import Options

COMPUTED = ("asset", "base_height_m", "p_base_magnetometer")
"""Fields of a RobotSpec that come from the asset, not from its settings."""


def build_robot(
    urdf: str | os.PathLike[str],
    settings: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    force: bool = False,
) -> Path:
    """Convert a URDF and author its drive, battery, own magnetic field and sensors.

    Args:
        urdf: The description, see `convert_urdf`.
        settings: TOML with the fields of a RobotSpec but those of COMPUTED; sensors name their links.
        out: Root layer to write, `.usda`.
        force: Whether files that are there are replaced.

    Returns:
        `out`; `read_robot` gives its spec.

    Raises:
        RefusedError: The URDF or the settings cannot be used (file, line and key are given), or a file
            is there already; nothing is written.
    """
    out = Path(out)
    spec = read_settings(settings, out)

    def finish(robot: Usd.Prim) -> None:
        if robot.GetName() != spec.name:
            raise RefusedError(
                f"{settings}: name is {spec.name!r}, but the URDF's robot is {robot.GetName()!r}"
            )
        try:
            _equip(robot, spec)
        except RefusedError as error:
            raise RefusedError(f"{settings}: {error}") from error

    return convert_urdf(urdf, out, options=Options(single_file=True), force=force, finish=finish)


def read_settings(settings: str | os.PathLike[str], asset: Path) -> RobotSpec:
    """The spec that a TOML of settings gives the robot whose asset is `asset`.

    Raises:
        RefusedError: The file is missing or not TOML, or a key or value is wrong; the line is given.
    """
    table = read_toml(settings)
    for key in COMPUTED:
        if key in table:
            raise RefusedError(f"{settings}: {key!r} is read from the asset; remove it")
    return from_table(RobotSpec, {**table, "asset": str(asset.resolve())}, settings)


def read_robot(asset: str | os.PathLike[str]) -> RobotSpec:
    """The spec of a robot's asset.

    Raises:
        RefusedError: The file is missing, is not USD, or is not an asset that `build_robot` made.
    """
    path = existing(asset, "robot asset").resolve()
    stage = open_stage(path)
    if not stage.GetDefaultPrim():
        raise RefusedError(f"{path}: has no default prim, so no robot; make the asset with `magtwin robot`")
    return read_robot_prim(stage.GetDefaultPrim(), path)


def robot_of(prim: Usd.Prim) -> RobotSpec:
    """The spec of the robot at `prim` in a composed scene, its asset the file that the prim refers to.

    Raises:
        RefusedError: It is not the prim of a robot that `build_robot` made; the text names it.
    """
    arcs = Usd.PrimCompositionQuery.GetDirectReferences(prim).GetCompositionArcs()
    layer = arcs[0].GetTargetLayer() if arcs else prim.GetStage().GetRootLayer()
    return read_robot_prim(prim, Path(layer.realPath).resolve())


def _equip(robot: Usd.Prim, spec: RobotSpec) -> None:
    """Author what a spec says at a converted robot's prim and on its links."""
    stage = robot.GetStage()
    robot.CreateAttribute("isaac:robotType", Sdf.ValueTypeNames.Token, custom=False).Set("Wheeled")
    define_footprint(robot, spec.footprint_radius_m)
    define_drive(robot, spec.drive)
    define_platform(robot, spec.platform)
    links = _links(robot)
    define_battery(stage, _base(robot).AppendChild("battery"), spec.battery)
    define_magnetometer(stage, _mount(links, "magnetometer", spec.magnetometer), spec.magnetometer)
    define_imu(stage, _mount(links, "imu", spec.imu), spec.imu)
    define_lidar(stage, _mount(links, "lidar", spec.lidar), spec.lidar)


def _links(robot: Usd.Prim) -> dict[str, Sdf.Path]:
    """Paths of a robot's links by name, those that only name a place included."""
    named = ("IsaacLinkAPI", "IsaacSiteAPI")
    return {
        prim.GetName(): prim.GetPath()
        for prim in Usd.PrimRange(robot)
        if any(api in named for api in prim.GetPrimTypeInfo().GetAppliedAPISchemas())
    }


def _base(robot: Usd.Prim) -> Sdf.Path:
    """Path of the robot's first body, which the converter makes its base."""
    return next(p.GetPath() for p in robot.GetChildren() if p.HasAPI(UsdPhysics.RigidBodyAPI))


def _mount(links: dict[str, Sdf.Path], name: str, spec: MountSpec) -> Sdf.Path:
    """Path of a sensor on its link."""
    if spec.link not in links:
        raise RefusedError(f"[{name}] link: the URDF has no link {spec.link!r}; {hint(spec.link, links)}")
    return links[spec.link].AppendChild(name)
