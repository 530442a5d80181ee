"""Sensors, drive and battery as prims: `define_` authors a prim, `read_` reads its spec.

Every prim is an Xform with one of magtwin's applied schemas, so that programs without magtwin still place it.
Values are authored in the stage's edit target, if no layer has them yet: layers over a robot hold only what
they change.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, Vt

from magtwin.errors import InputError, hint
from magtwin.spec.drive import DriveSpec
from magtwin.spec.magnetics import PlatformFieldSpec
from magtwin.spec.plant import PlantSpec
from magtwin.spec.sensors import BatterySpec, ImuSpec, LidarSpec, MagnetometerSpec, MocapSpec, MountSpec
from magtwin.usd.attributes import read_pose, read_spec, target, targets, write_pose, write_spec
from magtwin.usd.schema import (
    apply_api,
    attribute_name,
    author,
    author_targets,
    has_api,
    place,
    require_api,
    value_of,
)

S = TypeVar("S")

ON_ROOT: dict[str, type] = {"platform": PlatformFieldSpec, "mocap": MocapSpec, "plant": PlantSpec}
"""Specs of what a robot's root prim has, by the nouns of their schemas."""

OPTIONAL = ("mocap", "plant")
"""Those without which a robot has the default."""

POSE_FIELDS = frozenset(("link", "p_link_sensor", "q_link_sensor_xyzw"))
"""Fields of a MountSpec, which are the prim's parent and transform."""

JOINT_FIELDS = ("left_wheel_joint", "right_wheel_joint")
"""Fields of a DriveSpec that are relationships to joints."""

WHEELS_FIELDS = ("more_left_wheel_joints", "more_right_wheel_joints")
"""Fields of a DriveSpec that are relationships to any number of joints."""

MAP_RELATIONSHIP = "magtwin:magnetometer:map"
MAP_CHECKSUM = "magtwin:magnetometer:mapSha256"
"""What a scene adds to a magnetometer: its map, and the checksum of the map's file."""

IMU_TYPE = "IsaacImuSensor"
LIDAR_TYPE = "OmniLidar"
LIDAR_API = "OmniSensorGenericLidarCoreAPI"
EMITTER_API = "OmniSensorGenericLidarCoreEmitterStateAPI:s001"
"""NVIDIA's types, by name: their plugins live in Omniverse, not here."""

CORE = "omni:sensor:Core:"
"""Prefix of the LiDAR's attributes."""

SINGLE_MAX = float(np.finfo(np.float32).max)
UINT_MAX = 2**32 - 1

FOOTPRINT = attribute_name("robot", "footprint_radius_m")


@dataclass(frozen=True, kw_only=True)
class _DefaultPath:
    """Attributes of a robot with its default path."""

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
    write_spec(apply_api(prim, "magnetometer"), "magnetometer", spec, skip=POSE_FIELDS)
    return prim


def read_magnetometer(prim: Usd.Prim) -> MagnetometerSpec:
    """The spec of an authored magnetometer. Whether its network exists is not checked.

    Raises:
        InputError: The prim is no magnetometer, or a value is out of range.
    """
    return _read_mounted(MagnetometerSpec, prim, "magnetometer")


def define_imu(stage: Usd.Stage, path: str | Sdf.Path, spec: ImuSpec) -> Usd.Prim:
    """Author an inertial unit below the prim of its link, with NVIDIA's sensor as a child.

    Arguments and errors as for `define_magnetometer`.
    """
    prim = _define_mounted(stage, path, spec)
    write_spec(apply_api(prim, "imu"), "imu", spec, skip=POSE_FIELDS)
    define_isaac_imu(prim, spec.rate_hz)
    return prim


def define_isaac_imu(mount: Usd.Prim, rate_hz: float) -> Usd.Prim:
    """Author NVIDIA's inertial unit as a child of an Xform; returns the sensor's prim."""
    sensor = mount.GetStage().DefinePrim(mount.GetPath().AppendChild("imu_sensor"), IMU_TYPE)
    _write_foreign(sensor, "enabled", Sdf.ValueTypeNames.Bool, True)
    _write_foreign(sensor, "sensorPeriod", Sdf.ValueTypeNames.Float, 1 / rate_hz)
    return sensor


def read_imu(prim: Usd.Prim) -> ImuSpec:
    """The spec of an authored inertial unit; errors as for `read_magnetometer`."""
    return _read_mounted(ImuSpec, prim, "imu")


def define_lidar(stage: Usd.Stage, path: str | Sdf.Path, spec: LidarSpec) -> Usd.Prim:
    """Author a planar LiDAR below the prim of its link, with NVIDIA's sensor as a child.

    Arguments and errors as for `define_magnetometer`.
    """
    prim = _define_mounted(stage, path, spec)
    write_spec(apply_api(prim, "lidar"), "lidar", spec, skip=POSE_FIELDS)
    sensor = define_omni_lidar(prim, spec.scan_rate_hz, (spec.range_min_m, spec.range_max_m))
    _define_beam(sensor, spec.rays)
    return prim


def define_omni_lidar(
    mount: Usd.Prim, scan_rate_hz: float, ranges_m: tuple[float, float], *, rotary: bool = True
) -> Usd.Prim:
    """Author NVIDIA's LiDAR as a child of an Xform; returns the sensor's prim.

    Args:
        mount: Xform with the sensor's pose.
        scan_rate_hz: Scan rate [Hz], rounded to a whole number from 1.
        ranges_m: Smallest and largest range [m].
        rotary: Whether it rotates; otherwise it fires one fixed pattern.
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
    """One emitter that fires `rays` times per turn; Isaac Sim's default has 128 emitters above each other.

    A sensor with the emitters of a URDF's tags does not change.
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
    """The spec of an authored LiDAR; errors as for `read_magnetometer`."""
    return _read_mounted(LidarSpec, prim, "lidar")


def define_battery(stage: Usd.Stage, path: str | Sdf.Path, spec: BatterySpec) -> Usd.Prim:
    """Author a battery as an Xform; returns its prim."""
    return write_spec(apply_api(_define_xform(stage, path), "battery"), "battery", spec)


def read_battery(prim: Usd.Prim) -> BatterySpec:
    """The spec of an authored battery; errors as for `read_magnetometer`."""
    return read_spec(BatterySpec, prim, "battery")


def define_footprint(prim: Usd.Prim, footprint_radius_m: float) -> Usd.Prim:
    """Mark an Xform as the root of a robot with this footprint radius [m]."""
    attribute = apply_api(prim, "robot").GetAttribute(FOOTPRINT)
    if not attribute.HasAuthoredValue() or attribute.Get() != footprint_radius_m:
        author(attribute, footprint_radius_m)
    return prim


def read_footprint(prim: Usd.Prim) -> float:
    """Footprint radius of the robot rooted at `prim` [m]."""
    return float(value_of(require_api(prim, "robot").GetAttribute(FOOTPRINT)))


def define_path(prim: Usd.Prim, path: str | Path) -> Usd.Prim:
    """Author the default path of the robot rooted at `prim`: a name, a CSV file, or ""."""
    default = _DefaultPath(path_file=path) if isinstance(path, Path) else _DefaultPath(path=path)
    return write_spec(apply_api(prim, "robot"), "robot", default)


def read_path(prim: Usd.Prim) -> str | Path:
    """Default path of the robot rooted at `prim`; a file takes precedence over a name."""
    default = read_spec(_DefaultPath, prim, "robot")
    return default.path_file or default.path


def define_drive(prim: Usd.Prim, spec: DriveSpec) -> Usd.Prim:
    """Apply a differential drive to a robot's root prim; its wheel joints must be authored below.

    Raises:
        InputError: There is no joint of that name.
    """
    write_spec(apply_api(prim, "drive"), "drive", spec, skip={*JOINT_FIELDS, *WHEELS_FIELDS})
    joints = joints_of(prim)
    for field in (*JOINT_FIELDS, *WHEELS_FIELDS):
        names = (getattr(spec, field),) if field in JOINT_FIELDS else getattr(spec, field)
        for name in names:
            if name not in joints:
                raise InputError(f"{place(prim)}: no joint {name!r} for {field}; {hint(name, joints)}")
        relationship, paths = attribute_name("drive", field), [joints[name].GetPath() for name in names]
        if prim.GetRelationship(relationship).GetTargets() != paths:
            author_targets(prim, relationship, paths)
    return prim


def joints_of(robot: Usd.Prim) -> dict[str, Usd.Prim]:
    """The joints of a robot by their names in USD, and in its description where USD does not allow those."""
    prims = [prim for prim in Usd.PrimRange(robot) if prim.IsA(UsdPhysics.Joint)]
    return {p.GetDisplayName() or p.GetName(): p for p in prims} | {p.GetName(): p for p in prims}


def read_drive(prim: Usd.Prim) -> DriveSpec:
    """The spec of an authored drive, with the joints' names in USD.

    Raises:
        InputError: The prim has no drive, a value is out of range, or a wheel's joint is missing.
    """
    require_api(prim, "drive")
    joints: dict[str, Any] = {f: target(prim, attribute_name("drive", f)).GetName() for f in JOINT_FIELDS}
    for field in WHEELS_FIELDS:
        joints[field] = tuple(joint.GetName() for joint in targets(prim, attribute_name("drive", field)))
    return read_spec(DriveSpec, prim, "drive", **joints)


def define_on_root(prim: Usd.Prim, noun: str, spec: Any) -> Usd.Prim:
    """Apply one of `ON_ROOT` to a robot's root prim; a plant without effect only over another."""
    if noun == "plant" and spec == PlantSpec() and not has_api(prim, "plant"):
        return prim
    return write_spec(apply_api(prim, noun), noun, spec)


def read_on_root(prim: Usd.Prim, noun: str) -> Any:
    """The spec of one of `ON_ROOT` of the robot rooted at `prim`; errors as for `read_magnetometer`."""
    if noun in OPTIONAL and not has_api(prim, noun):
        return ON_ROOT[noun]()
    return read_spec(ON_ROOT[noun], prim, noun)


def _define_xform(stage: Usd.Stage, path: str | Sdf.Path) -> Usd.Prim:
    """The Xform at `path`, defined if it does not exist."""
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
    return read_spec(cls, prim, noun, link=link, p_link_sensor=p, q_link_sensor_xyzw=q)


def _write_foreign(prim: Usd.Prim, name: str, kind: Sdf.ValueTypeName, value: Any) -> None:
    """Set an attribute of a type whose schema is not here."""
    if kind == Sdf.ValueTypeNames.Float:
        value = float(np.float32(np.clip(value, -SINGLE_MAX, SINGLE_MAX)))
    attribute = prim.GetAttribute(name) or prim.CreateAttribute(name, kind, custom=False)
    if not attribute.HasAuthoredValue() or attribute.Get() != value:
        attribute.Set(value)
