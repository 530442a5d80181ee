"""A robot asset with drive, battery and sensors, made from a URDF and settings."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from pxr import Sdf, Usd, UsdPhysics

from magtwin.author.shape import drive_of, footprint_of, stand_on_floor
from magtwin.errors import InputError, hint
from magtwin.files.file import existing_file
from magtwin.files.kinds import expected
from magtwin.files.settings import from_table, read_toml
from magtwin.sim.plant_families import draw_plant
from magtwin.spec.base import ZERO3, Spec
from magtwin.spec.drive import DriveSpec
from magtwin.spec.magnetics import PlatformFieldSpec
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.sensors import BatterySpec, ImuSpec, LidarSpec, MagnetometerSpec, MocapSpec
from magtwin.urdf.convert import convert_with_report
from magtwin.urdf.options import DEFAULTS, Options
from magtwin.urdf.physics.contact import define_contacts
from magtwin.urdf.report import ConversionReport
from magtwin.urdf.reroot import reroot
from magtwin.usd.geometry import BASE_LINK
from magtwin.usd.robot import load_robot as load_robot
from magtwin.usd.robot import urdf_of
from magtwin.usd.schema import NOUNS, prims_with
from magtwin.usd.sensors import (
    ON_ROOT,
    define_battery,
    define_drive,
    define_footprint,
    define_imu,
    define_lidar,
    define_magnetometer,
    define_on_root,
    joints_of,
    read_drive,
)

_DEFAULTS = RobotSpec(name="", asset=Path())


@dataclass(frozen=True, kw_only=True)
class PlantTable(PlantSpec):
    """The robot's field beyond its linear platform field. Name a family, or give the figures."""

    family: str = ""
    """Family to draw the figures from: hysteresis, warm-up, nonlinear, moving-part, drawn or all."""

    seed: int = 0
    """Seed of the draw."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.family or self.seed:
            draw_plant(self.family or "nominal", self.seed)
            self._require("family", not (self.family and self._figures), "come without figures", self.family)

    @property
    def _figures(self) -> dict[str, Any]:
        default, known = PlantSpec(), {f.name for f in fields(PlantSpec)}
        return {
            name: value
            for name, value in vars(self).items()
            if name in known and value != getattr(default, name)
        }

    @property
    def spec(self) -> PlantSpec:
        """The spec, drawn if a family is named."""
        return draw_plant(self.family, self.seed) if self.family else PlantSpec(**self._figures)


@dataclass(frozen=True, kw_only=True)
class RobotSettings(Spec):
    """Settings of a robot beyond its URDF: the keys of robot.toml, or of [robot] in a scene's TOML.

    A value of None comes from the URDF's own tags. If it has none, the default of the spec applies, on the
    base if the URDF has no link with the default name.
    """

    name: str = ""
    """Name of the robot in the URDF; "" accepts any."""

    footprint_radius_m: float | None = None
    """Radius of the circle that must stay free of obstacles [m]. Default: from the robot's shape."""

    drive: DriveSpec | None = None
    battery: BatterySpec = field(default_factory=BatterySpec)
    platform: PlatformFieldSpec = field(default_factory=PlatformFieldSpec)
    magnetometer: MagnetometerSpec | None = None
    imu: ImuSpec | None = None
    lidar: LidarSpec | None = None
    mocap: MocapSpec = field(default_factory=MocapSpec)
    plant: PlantTable = field(default_factory=PlantTable)

    conversion: Options = DEFAULTS
    """Options of the URDF conversion."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.footprint_radius_m is not None:
            self._above_zero("footprint_radius_m")


def build_robot(
    urdf: str | os.PathLike[str],
    settings: str | os.PathLike[str] | RobotSettings,
    out: str | os.PathLike[str],
    *,
    options: Options | None = None,
    force: bool = False,
    thumbnail: Callable[[Path, Path], object] | None = None,
) -> ConversionReport:
    """Convert a URDF and author its drive, battery, own magnetic field and sensors.

    Args:
        urdf: The description, see `convert_urdf`.
        settings: RobotSettings, or a TOML with their fields; sensors name their links.
        out: Root layer to write, `.usda`; `load_robot` reads its spec.
        options: Options of the conversion; they replace those of the settings.
        force: Whether to replace existing files.
        thumbnail: Function that draws the asset, see `convert_with_report`.

    Returns:
        The report of the conversion.

    Raises:
        InputError: The URDF or the settings are wrong (the text has file, line and key), or a file exists;
            nothing is written.
    """
    where = "" if isinstance(settings, RobotSettings) else f"{settings}: "
    given = settings if isinstance(settings, RobotSettings) else read_settings(settings)

    def finish(robot: Usd.Prim) -> list[str]:
        if given.name and robot.GetName() != given.name:
            raise InputError(f"{where}name is {given.name!r}, but the URDF's robot is {robot.GetName()!r}")
        try:
            return _equip(robot, given)
        except InputError as error:
            raise InputError(f"{where}{error}") from error

    return convert_with_report(
        urdf,
        out,
        options=options or given.conversion,
        force=force,
        finish=finish,
        thumbnail=thumbnail,
    )


def read_settings(settings: str | os.PathLike[str]) -> RobotSettings:
    """The settings of a robot.toml.

    Raises:
        InputError: The file is missing or not TOML, or a key or value is wrong; the text has the line.
    """
    return from_table(RobotSettings, read_toml(expected(settings, "settings of a robot")), settings)


def mounted(text: str) -> MagnetometerSpec:
    """A magnetometer from "LINK" or "LINK:x,y,z", its link and its place on it [m].

    Raises:
        InputError: It is neither.
    """
    link, _, place = text.partition(":")
    try:
        p = tuple(float(part) for part in place.split(",")) if place else ZERO3
    except ValueError:
        p = ()
    if not link or len(p) != 3:
        raise InputError(f"magnetometer must be LINK or LINK:X,Y,Z, got {text!r}", parameter="magnetometer")
    return MagnetometerSpec(link=link, p_link_sensor=p)


def read_description(asset: str | os.PathLike[str]) -> str:
    """Text of the URDF that an asset was converted from, with base_link as its root; "" if it is missing.

    Raises:
        InputError: The URDF cannot be read.
    """
    source = urdf_of(asset)
    if source is None:
        return ""
    try:
        text = existing_file(source, "URDF file", "XML").read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{source}: is not UTF-8, as ROS descriptions must be; save it as UTF-8") from error
    return reroot(text, BASE_LINK, source)


def _equip(robot: Usd.Prim, settings: RobotSettings) -> list[str]:
    """Author the settings on a converted robot; returns notes of what was guessed."""
    stage, links, notes = robot.GetStage(), _links(robot), list[str]()
    robot.CreateAttribute("isaac:robotType", Sdf.ValueTypeNames.Token, custom=False).Set("Wheeled")
    radius = settings.footprint_radius_m
    if radius is None:
        radius = footprint_of(robot) or _DEFAULTS.footprint_radius_m
        notes.append(f"footprint_radius_m not given: {radius:g} m, from the robot's shape")
    define_footprint(robot, radius)
    if settings.drive is not None or not prims_with(robot, "drive"):
        drive, found = _drive(robot, settings.drive or DriveSpec())
        define_drive(robot, drive)
        notes += found
    driven, joints = read_drive(robot), joints_of(robot)
    apart, sides = driven.wheel_separation_m, driven.sides.items()
    planes: dict[Usd.Prim, float | None]
    planes = {joints[n]: apart * (0.5 - side) for n, side in sides if n in joints}
    define_contacts(robot, planes if len(planes) == 2 else dict.fromkeys(planes))
    notes += stand_on_floor(robot, driven)
    for noun in ON_ROOT:
        define_on_root(robot, noun, settings.plant.spec if noun == "plant" else getattr(settings, noun))
    define_battery(stage, _free(links, _base(robot), "battery"), settings.battery)
    sensors: tuple[tuple[str, Any, Any, Any], ...] = (
        ("imu", settings.imu, ImuSpec(), define_imu),
        ("lidar", settings.lidar, LidarSpec(), define_lidar),
        ("magnetometer", settings.magnetometer, MagnetometerSpec(), define_magnetometer),
    )
    for name, given, default, define in sensors:
        if given is None and prims_with(robot, name):
            continue
        spec = given or default
        if given is None and spec.link not in links and name == "magnetometer":
            raise InputError(
                f"[magnetometer] link: the URDF has no link {spec.link!r} and no magnetometer among "
                "its sensors; place one with --magnetometer LINK:X,Y,Z of magtwin scene --urdf, or with link "
                f"and p_link_sensor of [robot.magnetometer]; links: {', '.join(links)}"
            )
        if given is None and spec.link not in links:
            base = _base(robot)
            notes.append(f"no {name} given: placed at the origin of {base.name}")
            define(stage, _free(links, base, name), replace(spec, link=base.name))
            continue
        if spec.link not in links:
            raise InputError(f"[{name}] link: the URDF has no link {spec.link!r}; {hint(spec.link, links)}")
        path = _free(links, links[spec.link], name)
        notes += _replace_sensors(robot, name, path)
        define(stage, path, replace(spec, link=path.GetParentPath().name))
    return notes


def _drive(robot: Usd.Prim, given: DriveSpec) -> tuple[DriveSpec, list[str]]:
    """The drive of the settings, filled in from that of the conversion or from the shape, and notes of this.

    A field of the settings that has its default, that of a TurtleBot 4, is not given.
    """
    if not prims_with(robot, "drive"):
        return drive_of(robot, given)
    found, default = read_drive(robot), DriveSpec()
    names = [f.name for f in fields(DriveSpec)]
    own = {name: getattr(given, name) for name in names if getattr(given, name) != getattr(default, name)}
    taken = [n for n in names if n not in own and getattr(found, n) != getattr(default, n)]
    wheels = {"left_wheel_joint", "right_wheel_joint"}
    if wheels & own.keys():  # other wheels than those of the plugin, which may have more
        own |= {"more_left_wheel_joints": given.more_left_wheel_joints}
        own |= {"more_right_wheel_joints": given.more_right_wheel_joints}
    notes = [f"[drive] filled in from the description: {', '.join(taken)}"] if taken and own else []
    return replace(found, **own), notes


def _replace_sensors(robot: Usd.Prim, noun: str, path: Sdf.Path) -> list[str]:
    """Make the settings' sensor at `path` the robot's only one of its kind; returns notes of what changed.

    A sensor of the URDF's tags on the same link is the same device and is removed. One on another link stays
    for other simulators.
    """
    stage, notes = robot.GetStage(), []
    for prim in prims_with(robot, noun):
        if prim.GetPath() == path:
            continue
        where = f"{noun} {prim.GetName()!r} of link {prim.GetParent().GetName()!r}"
        if prim.GetParent().GetPath() == path.GetParentPath():
            notes.append(f"{where}: the settings replace the URDF's tags")
            stage.RemovePrim(prim.GetPath())
            continue
        notes.append(f"{where} is not simulated here: the settings name another")
        prim.RemoveAppliedSchema(NOUNS[noun])
        for attribute in prim.GetAuthoredPropertiesInNamespace(f"magtwin:{noun}"):
            prim.RemoveProperty(attribute.GetName())
    return notes


def _links(robot: Usd.Prim) -> dict[str, Sdf.Path]:
    """Paths of a robot's links by their URDF and USD names, including links without a body."""
    named = ("IsaacLinkAPI", "IsaacSiteAPI")
    return {
        name: prim.GetPath()
        for prim in Usd.PrimRange(robot)
        if any(api in named for api in prim.GetPrimTypeInfo().GetAppliedAPISchemas())
        for name in {prim.GetName(), prim.GetDisplayName() or prim.GetName()}
    }


def _base(robot: Usd.Prim) -> Sdf.Path:
    """Path of the robot's first body, which the converter makes its base."""
    return next(p.GetPath() for p in robot.GetChildren() if p.HasAPI(UsdPhysics.RigidBodyAPI))


def _free(links: dict[str, Sdf.Path], link: Sdf.Path, name: str) -> Sdf.Path:
    """Path of a sensor on a link, called `name` unless a frame on the link has that name."""
    names = (name, *(f"{name}_{i}" for i in range(2, len(links) + 3)))
    return next(path for n in names if (path := link.AppendChild(n)) not in links.values())
