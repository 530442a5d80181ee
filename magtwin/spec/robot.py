"""A robot: its USD asset, drive, sensors and magnetic field; and its place in a scene."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from magtwin.frames import IDENTITY_XYZW, quat_multiply, rotate
from magtwin.report.summary import Summarized, Summary
from magtwin.spec.base import LATER, ZERO3, Quat, Spec, Vec3
from magtwin.spec.drive import DriveSpec
from magtwin.spec.magnetics import PlatformFieldSpec
from magtwin.spec.plant import PlantSpec
from magtwin.spec.sensors import BatterySpec, ImuSpec, LidarSpec, MagnetometerSpec, MocapSpec, MountSpec


@dataclass(frozen=True, kw_only=True, repr=False)
class RobotSpec(Summarized, Spec):
    """A robot: its USD asset, and all that the simulator needs."""

    name: str
    """Name of its prim."""

    asset: Path
    """USD file of the articulation."""

    footprint_radius_m: float = 0.171
    """Radius of the circle that must stay free of obstacles [m]."""

    base_height_m: float = 0.0
    """Height of base_link above the floor [m]; read from the asset."""

    p_base_magnetometer: Vec3 = ZERO3
    """Magnetometer's origin in base_link at rest [m]; read from the asset."""

    q_base_magnetometer_link_xyzw: Quat = IDENTITY_XYZW
    """Axes of the magnetometer's link in base_link; read from the asset."""

    q_base_imu_link_xyzw: Quat = IDENTITY_XYZW
    """Axes of the IMU's link in base_link; read from the asset."""

    p_base_lidar: Vec3 = ZERO3
    """LiDAR's origin in base_link at rest [m]; read from the asset."""

    q_base_lidar_link_xyzw: Quat = IDENTITY_XYZW
    """Axes of the LiDAR's link in base_link; read from the asset."""

    drive: DriveSpec = field(default_factory=DriveSpec)
    battery: BatterySpec = field(default_factory=BatterySpec)
    platform: PlatformFieldSpec = field(default_factory=PlatformFieldSpec)
    magnetometer: MagnetometerSpec = field(default_factory=MagnetometerSpec)
    imu: ImuSpec = field(default_factory=ImuSpec)
    lidar: LidarSpec = field(default_factory=LidarSpec)
    mocap: MocapSpec = field(default_factory=MocapSpec)
    plant: PlantSpec = field(default_factory=PlantSpec, metadata={LATER: True})

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("footprint_radius_m")
        self._unit("q_base_magnetometer_link_xyzw", "q_base_imu_link_xyzw", "q_base_lidar_link_xyzw")

    def with_part(self, name: str, spec: Spec) -> "RobotSpec":
        """The robot with another drive, battery, platform, sensor or plant.

        Args:
            name: Field of the robot, such as "magnetometer".
            spec: Its new value. A sensor stays on its link, and may move there.

        Raises:
            InputError: The sensor is on another link, whose place only the asset knows.
        """
        before, moved = getattr(self, name), {}
        if isinstance(spec, MountSpec):
            what = f"stay {before.link!r}, on which the robot's asset has it"
            spec._require("link", spec.link == before.link, what, spec.link)
            if name in ("magnetometer", "lidar") and spec.p_link_sensor != before.p_link_sensor:
                off = [a - b for a, b in zip(spec.p_link_sensor, before.p_link_sensor, strict=True)]
                turned = rotate(getattr(self, f"q_base_{name}_link_xyzw"), off)
                p = tuple((turned + getattr(self, f"p_base_{name}")).tolist())
                moved = {f"p_base_{name}": p}
        return replace(self, **{name: spec}, **moved)  # type: ignore[arg-type]

    @property
    def q_base_magnetometer_xyzw(self) -> Quat:
        """Magnetometer's axes in base_link."""
        return _product(self.q_base_magnetometer_link_xyzw, self.magnetometer.q_link_sensor_xyzw)

    @property
    def q_base_imu_xyzw(self) -> Quat:
        """IMU's axes in base_link."""
        return _product(self.q_base_imu_link_xyzw, self.imu.q_link_sensor_xyzw)

    @property
    def q_base_lidar_xyzw(self) -> Quat:
        """LiDAR's axes in base_link."""
        return _product(self.q_base_lidar_link_xyzw, self.lidar.q_link_sensor_xyzw)

    def _summary(self) -> Summary:
        """Name and magnetometer; drive; other sensors; asset."""
        sensor, drive = self.magnetometer, self.drive
        network = "" if sensor.network is None else f" ({sensor.network.name})"
        place = "({:.3g}, {:.3g}, {:.3g}) m in base_link".format(*self.p_base_magnetometer)
        radius = f"radius {self.footprint_radius_m:.3g} m"
        others = f"LiDAR {self.lidar.rays} rays, IMU {self.imu.rate_hz:g} Hz"
        rows = {
            "sensor": f"{place}, {sensor.noise_density_nt:.3g} nT/sqrt(Hz)",
            "drive": f"{drive.v_max:.3g} m/s, {drive.w_max:.3g} rad/s, {radius}",
            "others": f"{others}, battery {self.battery.capacity_wh:g} Wh",
            "asset": str(self.asset),
        }
        title = f"RobotSpec {self.name}: {sensor.kind} magnetometer{network} at {sensor.rate_hz:g} Hz"
        return Summary(title, tuple(rows.items()))


def _product(a: Quat, b: Quat) -> Quat:
    x, y, z, w = quat_multiply(a, b).tolist()
    return (x, y, z, w)


@dataclass(frozen=True, kw_only=True, repr=False)
class PlacedRobot(Summarized, Spec):
    """A robot in a scene, with its start and its default path."""

    robot: RobotSpec

    start: Vec3 = ZERO3
    """Start: x [m], y [m] and yaw [rad] in world. A path starts at its own first point."""

    path: str | Path = ""
    """Default path: a name of `magtwin.path.PATHS`, "random", or a CSV file; "" for the caller's default."""


def fields_of(robots: Sequence[PlacedRobot]) -> dict[str, Any]:
    """The fields of a `Scene` with these robots, by name."""
    first, *others = robots
    return {"robot": first.robot, "start": first.start, "path": first.path, "others": tuple(others)}
