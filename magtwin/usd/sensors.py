"""Sensors, drive, battery and magnetic sources as prims: `define_` authors one, `read_` gives its spec back.

Every prim is an Xform with an applied schema of magtwin's, so that a runtime which has never heard of
magtwin still places it. A figure is authored where no layer says it yet, be it the schema's fallback,
or says otherwise, in the stage's edit target: layers over a robot hold only what they change.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, Vt

from magtwin.errors import InputError, hint
from magtwin.spec.drive import DriveSpec
from magtwin.spec.magnetics import PlatformFieldSpec
from magtwin.spec.sensors import BatterySpec, ImuSpec, LidarSpec, MagnetometerSpec, MocapSpec, MountSpec
from magtwin.usd.attributes import read_figures, read_pose, target, write_figures, write_pose
from magtwin.usd.schema import NOUNS, apply_api, attribute_name, place, require_api

S = TypeVar("S")

POSE_FIELDS = frozenset(("link", "p_link_sensor", "q_link_sensor_xyzw"))
"""Fields of a MountSpec: the prim's place among the links and its transform hold them."""

JOINT_FIELDS = ("left_wheel_joint", "right_wheel_joint")
"""Fields of a DriveSpec that are relationships to joints."""

BASE = "base_link"
"""Name of the link that REP-105 makes the robot's own frame."""

MAP_RELATIONSHIP = "magtwin:magnetometer:map"
MAP_CHECKSUM = "magtwin:magnetometer:mapSha256"
"""What a scene adds to its robot's magnetometer: the map that it reads, and the checksum of its file."""

IMU_TYPE = "IsaacImuSensor"
LIDAR_TYPE = "OmniLidar"
LIDAR_API = "OmniSensorGenericLidarCoreAPI"
EMITTER_API = "OmniSensorGenericLidarCoreEmitterStateAPI:s001"
"""NVIDIA's types, by name: their plugins live in Omniverse, not here."""

CORE = "omni:sensor:Core:"
"""How the LiDAR's attributes begin."""

SINGLE_MAX = float(np.finfo(np.float32).max)
UINT_MAX = 2**32 - 1

FOOTPRINT = attribute_name("robot", "footprint_radius_m")


@dataclass(frozen=True, kw_only=True)
class _Way:
    """Attributes of a robot that say what it drives."""

    path: str = ""
    path_file: Path | None = None


def define_magnetometer(stage: Usd.Stage, path: str | Sdf.Path, spec: MagnetometerSpec) -> Usd.Prim:
    """Author a magnetometer below the prim of its link.

    Args:
        stage: Written to in its edit target.
        path: Path of the sensor's prim, a child of the prim called `spec.link`.
        spec: What to author; `network` becomes a path relative to the edited layer.

    Raises:
        InputError: The parent prim is not the link, or a prim of another type is there.
    """
    prim = _define_mounted(stage, path, spec)
    write_figures(apply_api(prim, "magnetometer"), "magnetometer", spec, skip=POSE_FIELDS)
    return prim


def read_magnetometer(prim: Usd.Prim) -> MagnetometerSpec:
    """The spec of an authored magnetometer; whether its network is there is for its user to see.

    Raises:
        InputError: It is none, or a figure is out of range.
    """
    return _read_mounted(MagnetometerSpec, prim, "magnetometer")


def define_imu(stage: Usd.Stage, path: str | Sdf.Path, spec: ImuSpec) -> Usd.Prim:
    """Author an inertial unit below the prim of its link, with NVIDIA's sensor as a child.

    Args and refusals as for `define_magnetometer`.
    """
    prim = _define_mounted(stage, path, spec)
    write_figures(apply_api(prim, "imu"), "imu", spec, skip=POSE_FIELDS)
    define_isaac_imu(prim, spec.rate_hz)
    return prim


def define_isaac_imu(mount: Usd.Prim, rate_hz: float) -> Usd.Prim:
    """Author NVIDIA's inertial unit as a child of an Xform; returns the sensor's prim."""
    sensor = mount.GetStage().DefinePrim(mount.GetPath().AppendChild("imu_sensor"), IMU_TYPE)
    _write_foreign(sensor, "enabled", Sdf.ValueTypeNames.Bool, True)
    _write_foreign(sensor, "sensorPeriod", Sdf.ValueTypeNames.Float, 1 / rate_hz)
    return sensor


def read_imu(prim: Usd.Prim) -> ImuSpec:
    """The spec of an authored inertial unit; refusals as for `read_magnetometer`."""
    return _read_mounted(ImuSpec, prim, "imu")


def define_lidar(stage: Usd.Stage, path: str | Sdf.Path, spec: LidarSpec) -> Usd.Prim:
    """Author a planar LiDAR below the prim of its link, with NVIDIA's sensor as a child.

    Args and refusals as for `define_magnetometer`.
    """
    prim = _define_mounted(stage, path, spec)
    write_figures(apply_api(prim, "lidar"), "lidar", spec, skip=POSE_FIELDS)
    sensor = define_omni_lidar(prim, spec.scan_rate_hz, (spec.range_min_m, spec.range_max_m))
    _define_beam(sensor, spec.rays)
    return prim


def define_omni_lidar(
    mount: Usd.Prim, scan_rate_hz: float, ranges_m: tuple[float, float], *, rotary: bool = True
) -> Usd.Prim:
    """Author NVIDIA's LiDAR as a child of an Xform; returns the sensor's prim.

    Args:
        mount: Its pose.
        scan_rate_hz: Scans a second [Hz]; NVIDIA's is a whole number, from 1.
        ranges_m: Nearest and farthest range [m].
        rotary: Whether it turns, or fires one fixed pattern.
    """
    sensor = mount.GetStage().DefinePrim(mount.GetPath().AppendChild("omni_lidar"), LIDAR_TYPE)
    if LIDAR_API not in sensor.GetPrimTypeInfo().GetAppliedAPISchemas():
        sensor.AddAppliedSchema(LIDAR_API)
    names, core = Sdf.ValueTypeNames, CORE
    turns = round(np.clip(scan_rate_hz, 1, 1e6))
    _write_foreign(sensor, core + "scanType", names.Token, "ROTARY" if rotary else "SOLID_STATE")
    _write_foreign(sensor, core + "scanRateBaseHz", names.UInt, turns)
    _write_foreign(sensor, core + "nearRangeM", names.Float, ranges_m[0])
    _write_foreign(sensor, core + "farRangeM", names.Float, ranges_m[1])
    return sensor


def _define_beam(sensor: Usd.Prim, rays: int) -> None:
    """One emitter that fires `rays` times a turn; without it Isaac Sim's default has 128, one above another.

    A sensor that has the emitters of a URDF's tags is left as it is.
    """
    if sensor.GetAttribute(f"{CORE}numberOfEmitters") and not sensor.GetAttribute(f"{CORE}reportRateBaseHz"):
        return
    if EMITTER_API not in sensor.GetPrimTypeInfo().GetAppliedAPISchemas():
        sensor.AddAppliedSchema(EMITTER_API)
    names = Sdf.ValueTypeNames
    firings = min(rays * int(sensor.GetAttribute(f"{CORE}scanRateBaseHz").Get()), UINT_MAX)
    # Isaac Sim 6.0.1 reads the first of these names, the sensor's own documentation has the second.
    for name in ("patternFiringRateHz", "reportRateBaseHz"):
        _write_foreign(sensor, CORE + name, names.UInt, firings)
    for name in ("numberOfEmitters", "numberOfChannels"):
        _write_foreign(sensor, CORE + name, names.UInt, 1)
    state = f"{CORE}emitterState:s001:"
    for name in ("azimuthDeg", "elevationDeg"):
        _write_foreign(sensor, state + name, names.FloatArray, Vt.FloatArray([0.0]))
    for name, value in (("fireTimeNs", 0), ("channelId", 1)):
        _write_foreign(sensor, state + name, names.UIntArray, Vt.UIntArray([value]))


def read_lidar(prim: Usd.Prim) -> LidarSpec:
    """The spec of an authored LiDAR; refusals as for `read_magnetometer`."""
    return _read_mounted(LidarSpec, prim, "lidar")


def define_battery(stage: Usd.Stage, path: str | Sdf.Path, spec: BatterySpec) -> Usd.Prim:
    """Author a battery as an Xform of its own; returns its prim."""
    return write_figures(apply_api(_define_xform(stage, path), "battery"), "battery", spec)


def read_battery(prim: Usd.Prim) -> BatterySpec:
    """The spec of an authored battery; refusals as for `read_magnetometer`."""
    return read_figures(BatterySpec, prim, "battery")


def define_footprint(prim: Usd.Prim, footprint_radius_m: float) -> Usd.Prim:
    """Mark `prim`, an Xform, as the root of a robot that needs a clear circle of this radius [m]."""
    attribute = apply_api(prim, "robot").GetAttribute(FOOTPRINT)
    if not attribute.HasAuthoredValue() or attribute.Get() != footprint_radius_m:
        attribute.Set(footprint_radius_m)
    return prim


def read_footprint(prim: Usd.Prim) -> float:
    """Radius of the circle that the robot rooted at `prim` needs clear [m]."""
    return float(require_api(prim, "robot").GetAttribute(FOOTPRINT).Get())


def define_path(prim: Usd.Prim, path: str | Path) -> Usd.Prim:
    """Say what the robot rooted at `prim` drives unless told otherwise: a name, a CSV file, or ""."""
    way = _Way(path_file=path) if isinstance(path, Path) else _Way(path=path)
    return write_figures(apply_api(prim, "robot"), "robot", way)


def read_path(prim: Usd.Prim) -> str | Path:
    """What the robot rooted at `prim` drives unless told otherwise; a file is named before a name is."""
    way = read_figures(_Way, prim, "robot")
    return way.path_file or way.path


def define_drive(prim: Usd.Prim, spec: DriveSpec) -> Usd.Prim:
    """Apply a differential drive to a robot's root prim; its wheel joints must be authored below.

    Raises:
        InputError: No joint has the name that the spec gives.
    """
    write_figures(apply_api(prim, "drive"), "drive", spec, skip=JOINT_FIELDS)
    found = [p for p in Usd.PrimRange(prim) if p.IsA(UsdPhysics.Joint)]
    joints = {p.GetDisplayName() or p.GetName(): p for p in found} | {p.GetName(): p for p in found}
    for field in JOINT_FIELDS:
        name = getattr(spec, field)
        if name not in joints:
            raise InputError(f"{place(prim)}: no joint {name!r} for {field}; {hint(name, joints)}")
        relationship = prim.GetRelationship(attribute_name("drive", field))
        if relationship.GetTargets() != [joints[name].GetPath()]:
            relationship.SetTargets([joints[name].GetPath()])
    return prim


def read_drive(prim: Usd.Prim) -> DriveSpec:
    """The spec of an authored drive.

    Raises:
        InputError: It is none, a figure is out of range, or a wheel's joint is missing.
    """
    require_api(prim, "drive")
    joints = {f: target(prim, attribute_name("drive", f)).GetName() for f in JOINT_FIELDS}
    return read_figures(DriveSpec, prim, "drive", **joints)


def define_platform(prim: Usd.Prim, spec: PlatformFieldSpec) -> Usd.Prim:
    """Apply the robot's own magnetic field to its root prim."""
    return write_figures(apply_api(prim, "platform"), "platform", spec)


def read_platform(prim: Usd.Prim) -> PlatformFieldSpec:
    """The spec of an authored platform field; refusals as for `read_magnetometer`."""
    return read_figures(PlatformFieldSpec, prim, "platform")


def define_mocap(prim: Usd.Prim, spec: MocapSpec) -> Usd.Prim:
    """Apply to a robot's root prim how motion capture sees it."""
    return write_figures(apply_api(prim, "mocap"), "mocap", spec)


def read_mocap(prim: Usd.Prim) -> MocapSpec:
    """How motion capture sees the robot rooted at `prim`: the default where no layer says it."""
    if not prim.HasAPI(NOUNS["mocap"]):
        return MocapSpec()
    return read_figures(MocapSpec, prim, "mocap")


def _define_xform(stage: Usd.Stage, path: str | Sdf.Path) -> Usd.Prim:
    """An Xform at `path`; one that is there already is left as it is."""
    prim = stage.GetPrimAtPath(path)
    if not prim or not prim.IsDefined():
        return UsdGeom.Xform.Define(stage, path).GetPrim()
    return prim


def _define_mounted(stage: Usd.Stage, path: str | Sdf.Path, spec: MountSpec) -> Usd.Prim:
    path = Sdf.Path(str(path))
    if path.GetParentPath().name != spec.link:
        raise InputError(f"<{path}>: this sensor sits on {spec.link!r}, so its prim must be a child of it")
    prim = _define_xform(stage, path)
    write_pose(prim, spec.p_link_sensor, spec.q_link_sensor_xyzw)
    return prim


def _read_mounted(cls: type[S], prim: Usd.Prim, noun: str) -> S:
    require_api(prim, noun)
    p, q = read_pose(prim)
    link = prim.GetParent().GetName()
    return read_figures(cls, prim, noun, link=link, p_link_sensor=p, q_link_sensor_xyzw=q)


def _write_foreign(prim: Usd.Prim, name: str, kind: Sdf.ValueTypeName, value: Any) -> None:
    """Set an attribute of a type whose schema is not here."""
    if kind == Sdf.ValueTypeNames.Float:
        value = float(np.float32(np.clip(value, -SINGLE_MAX, SINGLE_MAX)))
    attribute = prim.GetAttribute(name) or prim.CreateAttribute(name, kind, custom=False)
    if not attribute.HasAuthoredValue() or attribute.Get() != value:
        attribute.Set(value)
