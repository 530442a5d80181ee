"""Equipment: the drive of a robot, and `<sensor>` elements of `<gazebo>` tags as prims on their links.

Follows SDFormat's specification of `<sensor>` (sdformat.org/spec). Gazebo's sensors look along x with z up,
USD's cameras along -z with y up.
"""

import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdRender, Vt

from magtwin.errors import InputError, near
from magtwin.frames import matrix_from_quat, quat_from_rpy
from magtwin.spec.base import ZERO3
from magtwin.spec.drive import DriveSpec
from magtwin.spec.sensors import ImuSpec, LidarSpec, MagnetometerSpec
from magtwin.urdf.description.tag import Element, Tags
from magtwin.urdf.meshes.mesh_layer import free_child
from magtwin.urdf.shape import pose_of
from magtwin.usd.schema import prims_with
from magtwin.usd.sensors import (
    EMITTER_API,
    JOINT_FIELDS,
    WHEELS_FIELDS,
    define_drive,
    define_imu,
    define_isaac_imu,
    define_lidar,
    define_magnetometer,
    define_omni_lidar,
    write_pose,
)

METADATA = "magtwin:sensor"
"""Key of a sensor's customData: values without a schema, by name with unit."""

CONTACT_TYPE, CONTACT_API = "IsaacContactSensor", "PhysxContactReportAPI"
"""NVIDIA's types; their plugins are not installed here."""

SCANNER = np.pi
"""Smallest field of view of a spinning LiDAR [rad]; below, it is a range finder."""

APERTURE_MM = 20.955
"""Width of a camera's aperture, UsdGeom's default [mm]; only the field of view matters."""

WIDEST = np.radians(170.0)
"""Largest field of view of a camera without distortion [rad]."""

RAYS, PIXELS = 2_000_000, 65_536
"""Most rays of a LiDAR, and most pixels along one side of an image."""

X_FORWARD: NDArray[np.float64] = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Axes of USD's camera in Gazebo's sensor, as columns."""

NT_PER_T = 1e9


Fan = tuple[float, float, int]
"""Rays in one plane at equal angles: angles of the first and last [rad], and their number."""


@dataclass(frozen=True)
class Site:
    """Place of a sensor."""

    stage: Usd.Stage
    path: Sdf.Path
    """Path of its prim, below its link's."""

    pose: NDArray[np.float64]
    """Pose in its link, shape (4, 4)."""

    @property
    def mount(self) -> dict[str, Any]:
        """The place as fields of a MountSpec."""
        p, q = pose_of(self.pose)
        turn = {} if q is None else {"q_link_sensor_xyzw": q}
        return {"link": self.path.GetParentPath().name, "p_link_sensor": p, **turn}

    def define(self) -> Usd.Prim:
        """Define an Xform there."""
        prim = UsdGeom.Xform.Define(self.stage, self.path).GetPrim()
        write_pose(prim, *pose_of(self.pose))
        return prim


def define_sensors(tags: Tags, robot: Usd.Prim, prim_of: Callable[[str], Usd.Prim]) -> list[Usd.Prim]:
    """Author every `<sensor>` of `<gazebo reference="LINK">` with a known type on its link's prim.

    The first IMU, magnetometer and spinning LiDAR of a robot get magtwin's schemas, so that magtwin simulates
    them. All others become NVIDIA's types or USD cameras only. A sensor without the figures that its type
    needs becomes a frame with metadata. Sensors of other types are kept as text, with a note.

    Args:
        tags: Tags of the description.
        robot: The robot's prim.
        prim_of: Returns the prim of a link by its name.
    """
    made, description = list[Usd.Prim](), tags.description
    for block in tags.blocks("gazebo"):
        link = block.get("reference", "")
        for sensor in block.findall("sensor"):
            name, kind = sensor.get("name") or "sensor", (sensor.get("type") or "").lower()
            start = f"sensor {name!r} of link {link!r}"
            if link not in description.links:
                advice = description.repairs.suggestion(link, description.links, near)
                text = f"{start}, which is no link{advice}: kept as text"
                description.repair("name-unknown", text, sensor)
                continue
            if kind not in KINDS:
                description.note(f"{start} is of type {kind!r}, which has no counterpart: kept as text")
                continue
            tags.read(sensor)
            prim = prim_of(link)
            site = Site(prim.GetStage(), free_child(prim, name), _pose(tags, sensor))
            try:
                made.append(KINDS[kind](tags, sensor, site, robot))
            except InputError as error:
                text = f"{start}: {error}: kept as a frame with its type and rate"
                description.repair("sensor-missing", text, sensor)
                prim, rate = site.define(), tags.number(sensor, "update_rate", least=0.0)
                made.append(_metadata(prim, type=kind, **({} if rate is None else {"rateHz": rate})))
    return made


def define_differential(robot: Usd.Prim, spec: DriveSpec, prim_names: Mapping[str, str]) -> Usd.Prim:
    """Author a drive on the robot's prim.

    Args:
        robot: Its joints exist already.
        spec: The drive, with the joint names of the URDF.
        prim_names: Joint names in USD by their URDF names.
    """
    named: dict[str, Any] = {f: prim_names.get(getattr(spec, f), getattr(spec, f)) for f in JOINT_FIELDS}
    for field in WHEELS_FIELDS:
        named[field] = tuple(prim_names.get(name, name) for name in getattr(spec, field))
    return define_drive(robot, replace(spec, **named))


def _define_imu(tags: Tags, sensor: Element, site: Site, robot: Usd.Prim) -> Usd.Prim:
    rate = _rate(tags, sensor, ImuSpec.rate_hz)
    spec = ImuSpec(
        **site.mount,
        rate_hz=rate,
        tilt=(0.0, 0.0),  # Gazebo gives the true orientation without vibration
        level_error=(0.0, 0.0),
        tilt_std=0.0,
        orientation_noise_std=0.0,
        gyro_bias_walk=0.0,
        gyro_vibration=ZERO3,
        accel_vibration=ZERO3,
        gyro_noise_std=_noise(tags, tags.find(sensor, "imu/angular_velocity", "imu/noise/rate")),
        accel_noise_std=_noise(tags, tags.find(sensor, "imu/linear_acceleration", "imu/noise/accel")),
    )
    if not prims_with(robot, "imu"):
        return define_imu(site.stage, site.path, spec)
    prim = _metadata(
        site.define(), rateHz=rate, gyroNoiseStd=spec.gyro_noise_std, accelNoiseStd=spec.accel_noise_std
    )
    define_isaac_imu(prim, rate)
    tags.description.note(f"{_say(sensor)} is a second IMU, which magtwin does not simulate")
    return prim


def _define_magnetometer(tags: Tags, sensor: Element, site: Site, robot: Usd.Prim) -> Usd.Prim:
    rate = _rate(tags, sensor, MagnetometerSpec.rate_hz)
    noise = NT_PER_T * _noise(tags, tags.find(sensor, "magnetometer"))
    if noise:
        tags.description.note(f"{_say(sensor)}: the unit of its noise is assumed to be tesla: {noise:.6g} nT")
    if prims_with(robot, "magnetometer"):
        tags.description.note(f"{_say(sensor)} is a second magnetometer, which magtwin does not simulate")
        return _metadata(site.define(), rateHz=rate, noiseStdNt=noise)
    density = noise / math.sqrt(rate / 2)
    spec = MagnetometerSpec(**site.mount, rate_hz=rate, noise_density_nt=density, resolution_nt=0.0)
    return define_magnetometer(site.stage, site.path, spec)


def _define_lidar(tags: Tags, sensor: Element, site: Site, robot: Usd.Prim) -> Usd.Prim:
    scan = tags.find(sensor, "lidar", "ray")
    if scan is None:
        raise InputError("has no <lidar> or <ray>")
    across, up = (_fan(tags, tags.find(scan, f"scan/{axis}")) for axis in ("horizontal", "vertical"))
    (least, most, count), (lowest, highest, rows) = across, up
    near = tags.number(scan, "range/min", least=0.0) or 0.0
    far = tags.number(scan, "range/max", above=0.0)
    near, far = _ordered(tags, scan, "range", near, far)
    if count * rows > RAYS:
        raise InputError(f"it has {count} x {rows} rays, over {RAYS}")
    rate = _rate(tags, sensor, LidarSpec.scan_rate_hz)
    noise, step = _noise(tags, scan), tags.number(scan, "range/resolution", least=0.0) or 0.0
    spins = most - least >= SCANNER
    if spins and not prims_with(robot, "lidar"):
        spec = LidarSpec(
            **site.mount,
            scan_rate_hz=rate,
            rays=count,
            range_min_m=near,
            range_max_m=far,
            range_noise_std_m=noise,
            off_s=0.0,
        )
        prim = define_lidar(site.stage, site.path, spec)
    else:
        prim = site.define()
        if spins:
            tags.description.note(f"{_say(sensor)} is a second LiDAR, which magtwin does not simulate")
    lidar = define_omni_lidar(prim, rate, (near, far), rotary=spins)
    names = Sdf.ValueTypeNames
    if spins:  # a column of emitters fires at equal angles, between two azimuths
        full = np.isclose(most - least, 2 * np.pi, atol=1e-3)
        start, end = (0.0, 360.0) if full else (np.degrees(a) % 360 for a in (least, most))
        firings = max(1, count - 1) * 2 * np.pi / (most - least) * rate
        _write(lidar, "validStartAzimuthDeg", names.Float, start)
        _write(lidar, "validEndAzimuthDeg", names.Float, end)
        _write(lidar, "patternFiringRateHz", names.UInt, max(1, round(float(firings))))
        _define_emitters(lidar, np.zeros(rows), _angles(up))
    else:  # a grid of emitters, line by line, fires at the same time
        _write(lidar, "numLines", names.UInt, rows)
        _write(lidar, "numRaysPerLine", names.UIntArray, Vt.UIntArray([count] * rows))
        azimuth, elevation = np.meshgrid(_angles(across), _angles(up))
        _define_emitters(lidar, azimuth.ravel(), elevation.ravel())
    _write(lidar, "rangeResolutionM", names.Float, step)
    _write(lidar, "rangeAccuracyM", names.Float, noise)
    _metadata(
        prim,
        rateHz=rate,
        noiseStdM=noise,
        horizontalSamples=count,
        horizontalMinRad=least,
        horizontalMaxRad=most,
        verticalSamples=rows,
        verticalMinRad=lowest,
        verticalMaxRad=highest,
    )
    return prim


def _define_emitters(lidar: Usd.Prim, azimuth: NDArray, elevation: NDArray) -> None:
    """Author the directions of emitters [rad], shape (E,)."""
    names, state, count = Sdf.ValueTypeNames, "emitterState:s001:", len(azimuth)
    if EMITTER_API not in lidar.GetPrimTypeInfo().GetAppliedAPISchemas():
        lidar.AddAppliedSchema(EMITTER_API)
    _write(lidar, "numberOfEmitters", names.UInt, count)
    _write(lidar, "numberOfChannels", names.UInt, count)
    for name, angle in (("azimuthDeg", azimuth), ("elevationDeg", elevation)):
        degrees = np.round(np.degrees(angle), 6) + 0.0
        _write(lidar, state + name, names.FloatArray, Vt.FloatArray(list(map(float, degrees))))
    _write(lidar, state + "fireTimeNs", names.UIntArray, Vt.UIntArray([0] * count))
    _write(lidar, state + "channelId", names.UIntArray, Vt.UIntArray(range(1, count + 1)))


def _define_camera(tags: Tags, sensor: Element, site: Site, robot: Usd.Prim) -> Usd.Prim:
    lens = tags.find(sensor, "camera")
    if lens is None:
        raise InputError("has no <camera>")
    if tags.find(lens, "pose") is not None:
        site = Site(site.stage, site.path, site.pose @ _pose(tags, lens))
    fov = tags.number(lens, "horizontal_fov", above=0.0)
    fov = 1.047 if fov is None else fov  # SDFormat's own default
    if fov > WIDEST:
        text = f"{_say(sensor)}: its horizontal_fov of {fov:g} rad is reduced to {WIDEST:.3g}"
        tags.description.repair("sensor-range", text, lens)
        fov = WIDEST
    size = [tags.number(lens, f"image/{side}", above=0.0) for side in ("width", "height")]
    wanted = [n or default for n, default in zip(size, (320, 240), strict=True)]
    width, height = (int(min(max(n, 1), PIXELS)) for n in wanted)
    if [width, height] != [int(n) for n in wanted]:
        was = " x ".join(f"{n:g}" for n in wanted)
        text = f"{_say(sensor)}: its image of {was} pixels becomes {width} x {height}"
        tags.description.repair("sensor-range", text, lens)
    near = tags.number(lens, "clip/near", "depth_camera/clip/near", above=0.0) or 0.1
    far = tags.number(lens, "clip/far", "depth_camera/clip/far", above=0.0) or 100.0
    near, far = _ordered(tags, lens, "clip", near, far)
    prim = site.define()
    camera = UsdGeom.Camera.Define(site.stage, site.path.AppendChild("camera"))
    turn = np.eye(4)
    turn[:3, :3] = X_FORWARD
    write_pose(camera.GetPrim(), *pose_of(turn))
    camera.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    camera.CreateHorizontalApertureAttr(APERTURE_MM)
    camera.CreateVerticalApertureAttr(APERTURE_MM * height / width)
    camera.CreateFocalLengthAttr(APERTURE_MM / 2 / np.tan(fov / 2))
    camera.CreateClippingRangeAttr(Gf.Vec2f(near, far))
    kind = (sensor.get("type") or "").lower()
    product = UsdRender.Product.Define(site.stage, prim.GetPath().AppendChild("image"))
    product.CreateResolutionAttr(Gf.Vec2i(width, height))
    product.CreateCameraRel().SetTargets([camera.GetPath()])
    channels = [] if kind.startswith("depth") else [("colour", "LdrColor")]
    channels += [] if kind == "camera" else [("depth", "DistanceToImagePlaneSD")]
    paths = [product.GetPath().AppendChild(name) for name, _ in channels]
    for path, (_, source) in zip(paths, channels, strict=True):
        UsdRender.Var.Define(site.stage, path).CreateSourceNameAttr(source)
    product.CreateOrderedVarsRel().SetTargets(paths)
    return _metadata(
        prim,
        type=kind,
        rateHz=_rate(tags, sensor, 30.0),
        width=width,
        height=height,
        horizontalFovRad=fov,
        noiseStd=_noise(tags, lens),
    )


def _define_contact(tags: Tags, sensor: Element, site: Site, robot: Usd.Prim) -> Usd.Prim:
    rate = _rate(tags, sensor, 0.0)
    link = site.stage.GetPrimAtPath(site.path.GetParentPath())
    prim = site.stage.DefinePrim(site.path, CONTACT_TYPE)  # NVIDIA's sensor needs the body as its parent
    names = Sdf.ValueTypeNames
    prim.CreateAttribute("enabled", names.Bool, custom=False).Set(True)
    prim.CreateAttribute("sensorPeriod", names.Float, custom=False).Set(1 / rate if rate else 0.0)
    link.AddAppliedSchema(CONTACT_API)
    return prim


KINDS: Mapping[str, Callable[[Tags, Element, Site, Usd.Prim], Usd.Prim]] = {
    "imu": _define_imu,
    "imu_sensor": _define_imu,
    "magnetometer": _define_magnetometer,
    **dict.fromkeys(("ray", "gpu_ray", "lidar", "gpu_lidar"), _define_lidar),
    **dict.fromkeys(("camera", "depth", "depth_camera", "rgbd", "rgbd_camera"), _define_camera),
    "contact": _define_contact,
}
"""Functions that author a sensor, by type."""


def _say(sensor: Element) -> str:
    return f"sensor {sensor.get('name') or 'sensor'!r}"


def _rate(tags: Tags, sensor: Element, default: float) -> float:
    """Rate [Hz]; the default where Gazebo would use every step."""
    rate = tags.number(sensor, "update_rate", least=0.0)
    if tags.flag(sensor, "always_on") is False:
        tags.description.note(f"{_say(sensor)} is off by default in Gazebo; here it is on")
    if not rate and default:
        tags.description.note(f"{_say(sensor)} gives no rate: {default:g} Hz")
    return rate or default


def _noise(tags: Tags, element: Element | None) -> float:
    """Standard deviation of a sensor's white noise, the RMS of its axes; 0 if there is none."""
    if element is None:
        return 0.0
    if element.tag in ("rate", "accel"):
        places: tuple[str, ...] = ("",)
    else:
        places = ("noise/", *(f"{axis}/noise/" for axis in "xyz"))
    deviations = []
    for place in places:
        tags.nothing(element, *(f"{place}{tag}" for tag in ("mean", "bias_mean", "bias_stddev")))
        if place:
            tags.find(element, f"{place}type")
        value = tags.number(element, f"{place}stddev", least=0.0)
        if value is not None:
            deviations.append(value)
    deviations = deviations or [0.0]
    if len(set(deviations)) == 1:
        return deviations[0]
    words, where = ", ".join(f"{value:g}" for value in deviations), tags.description.where(element)
    tags.description.note(f"{where}: noise {words} of the axes becomes their RMS")
    return float(np.sqrt(np.mean(np.square(deviations))))


def _fan(tags: Tags, element: Element | None) -> Fan:
    """The rays of a LiDAR's `<horizontal>` or `<vertical>`; one if there is none."""
    samples = tags.number(element, "samples", least=1)
    density = tags.number(element, "resolution", above=0.0)
    count = max(1, round((samples or 1) * (1.0 if density is None else density)))
    least = tags.number(element, "min_angle") or 0.0
    most = tags.number(element, "max_angle") or 0.0
    given = least, most
    least, most = min(given), max(given)
    most = min(most, least + 2 * np.pi)
    if element is not None and not np.allclose((least, most), given, rtol=0, atol=1e-6):
        text = f"its angles from {given[0]:.7g} to {given[1]:.7g} rad become {least:.7g} to {most:.7g}"
        tags.description.repair("sensor-range", text, element)
    return least, most, count


def _ordered(tags: Tags, element: Element, what: str, near: float, far: float | None) -> tuple[float, float]:
    """Nearest and farthest distance of a sensor [m], in this order.

    Raises:
        InputError: They are equal, or the farthest is missing.
    """
    if far is None or far == near:
        raise InputError(f"its {what} from {near:g} to {far} m is empty")
    if far < near:
        text = f"its {what} from {near:g} to {far:g} m is read in the other order"
        tags.description.repair("sensor-range", text, element)
    return min(near, far), max(near, far)


def _angles(fan: Fan) -> NDArray[np.float64]:
    """Angle of each ray [rad]; a single ray is in the middle."""
    least, most, count = fan
    return np.array([(least + most) / 2]) if count == 1 else np.linspace(least, most, count)


def _pose(tags: Tags, element: Element) -> NDArray[np.float64]:
    """A `<pose>` x y z roll pitch yaw, shape (4, 4).

    One that is not six finite numbers, or is relative to another frame, is left out.
    """
    tag, T = tags.find(element, "pose"), np.eye(4)
    if tag is None or not (tag.text or "").strip():
        return T
    frame, text = tag.get("relative_to") or tag.get("frame"), (tag.text or "").strip()
    values: list[float] = []
    with contextlib.suppress(ValueError):
        values = [float(word) for word in text.split()]
    valid = len(values) == 6 and bool(np.isfinite(values).all())
    if frame or not valid:
        reason = f"is relative to {frame!r}" if frame else f"is not x y z roll pitch yaw, but {text!r}"
        fault = f"{_say(element)}: its pose {reason}: it is at the origin of its link"
        tags.description.repair("sensor-range", fault, tag)
        return T
    angles = np.radians(values[3:]) if tag.get("degrees", "").lower() in ("true", "1") else values[3:]
    T[:3, :3], T[:3, 3] = matrix_from_quat(quat_from_rpy(angles)), values[:3]
    return T


def _metadata(prim: Usd.Prim, **metadata: object) -> Usd.Prim:
    """Keep values without a schema as custom data of a sensor's prim."""
    for name, value in metadata.items():
        prim.SetCustomDataByKey(f"{METADATA}:{name}", value)
    return prim


def _write(lidar: Usd.Prim, name: str, kind: Sdf.ValueTypeName, value: object) -> None:
    """Set an attribute of NVIDIA's LiDAR schema, which is not installed here."""
    lidar.CreateAttribute(f"omni:sensor:Core:{name}", kind, custom=False).Set(value)
