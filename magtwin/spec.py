"""What there is: a Scene, its Robot and one frozen dataclass a sensor.

Plain data between `usd/`, which authors and reads it, and `sim/`, which runs it. Every field stands
for one attribute of a prim. Lengths are metres, angles radians, fields nT. A spec is checked at birth.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from magtwin.frames import IDENTITY_XYZW
from magtwin.names import RefusedError

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Matrix3 = tuple[float, float, float, float, float, float, float, float, float]
"""Rows of a 3 x 3 matrix, one after the other."""

ZERO3: Vec3 = (0.0, 0.0, 0.0)
ZERO9: Matrix3 = (0.0,) * 9  # type: ignore[assignment]


def _above_zero(spec: Any, *names: str) -> None:
    for name in names:
        if not getattr(spec, name) > 0:
            raise RefusedError(
                f"{name} of {type(spec).__name__} must be above 0, got {getattr(spec, name)!r}"
            )


def _not_negative(spec: Any, *names: str) -> None:
    for name in names:
        if not getattr(spec, name) >= 0:
            raise RefusedError(
                f"{name} of {type(spec).__name__} must not be below 0, got {getattr(spec, name)!r}"
            )


@dataclass(frozen=True, kw_only=True)
class MountSpec:
    """Where a sensor sits: a pose on a link of the robot."""

    link: str
    """Name of the robot link that carries the sensor."""

    p_link_sensor: Vec3 = ZERO3
    """Sensor's origin in the link [m]."""

    q_link_sensor_xyzw: Quat = IDENTITY_XYZW
    """Sensor's axes in the link."""


@dataclass(frozen=True, kw_only=True)
class MagnetometerSpec(MountSpec):
    """A scalar magnetometer that reads map + disturbance."""

    link: str = "magnetometer_link"

    rate_hz: float = 135.0
    """Readings a second [Hz]."""

    noise_std_nt: float = 0.02
    """Standard deviation of the white noise of one reading [nT]."""

    resolution_nt: float = 1.664e-4
    """Smallest step of a reading [nT]; 0 for none."""

    network: Path | None = None
    """Weights that predict the disturbance; none means that physics gives it."""

    network_sha256: str = ""
    """Checksum of the weights file, lower-case hex; "" means that any file will do."""

    inputs: tuple[str, ...] = ()
    """Names of the network's inputs, in order."""

    def __post_init__(self) -> None:
        _above_zero(self, "rate_hz")
        _not_negative(self, "noise_std_nt", "resolution_nt")


@dataclass(frozen=True, kw_only=True)
class ImuSpec(MountSpec):
    """An inertial unit that gives orientation, rates and acceleration with gravity removed."""

    link: str = "imu_link"

    rate_hz: float = 62.0
    """Samples a second [Hz]."""

    orientation_noise_std: float = 0.002
    """Standard deviation of each small angle of the orientation [rad]."""

    gyro_noise_std: float = 0.012
    """Standard deviation of a rate sample, each axis [rad/s]."""

    accel_noise_std: float = 0.27
    """Standard deviation of an acceleration sample, each axis [m/s2]."""

    def __post_init__(self) -> None:
        _above_zero(self, "rate_hz")
        _not_negative(self, "orientation_noise_std", "gyro_noise_std", "accel_noise_std")


@dataclass(frozen=True, kw_only=True)
class LidarSpec(MountSpec):
    """A spinning planar LiDAR; its motor and current disturb the field while it is on."""

    link: str = "rplidar_link"

    scan_rate_hz: float = 7.5
    """Turns a second [Hz]."""

    range_min_m: float = 0.15
    """Nearest range [m]."""

    range_max_m: float = 12.0
    """Farthest range [m]."""

    on_s: float = 20.0
    """Time on in each cycle of the schedule, which begins off [s]; 0 means always off."""

    off_s: float = 40.0
    """Time off in each cycle of the schedule [s]; 0 means always on."""

    def __post_init__(self) -> None:
        _above_zero(self, "scan_rate_hz", "range_max_m")
        _not_negative(self, "range_min_m", "on_s", "off_s")


@dataclass(frozen=True, kw_only=True)
class BatterySpec:
    """A battery: its charge falls linearly, its voltage follows the charge, with Gaussian noise."""

    capacity_wh: float = 26.0
    """Energy of a full pack [Wh]."""

    load_w: float = 15.0
    """Mean power drawn [W]; the charge falls by load_w / capacity_wh an hour."""

    initial_fraction: float = 1.0
    """Charge at the start of a run, 0 to 1."""

    voltage_empty_v: float = 12.44
    """Voltage at charge 0 [V]."""

    voltage_full_v: float = 16.24
    """Voltage at charge 1 [V]."""

    voltage_noise_std_v: float = 0.02
    """Standard deviation of a voltage sample [V]."""

    rate_hz: float = 0.5
    """Samples a second [Hz]."""

    def __post_init__(self) -> None:
        _above_zero(self, "capacity_wh", "voltage_empty_v", "voltage_full_v", "rate_hz")
        _not_negative(self, "load_w", "voltage_noise_std_v")
        if not 0 <= self.initial_fraction <= 1:
            raise RefusedError(
                f"initial_fraction of BatterySpec must lie in 0..1, got {self.initial_fraction!r}"
            )


@dataclass(frozen=True, kw_only=True)
class DriveSpec:
    """A differential drive: its size, its limits and its odometry."""

    left_wheel_joint: str = "left_wheel_joint"
    right_wheel_joint: str = "right_wheel_joint"

    wheel_separation_m: float = 0.233
    """Distance between the wheels' contact points [m]."""

    wheel_radius_m: float = 0.03575
    """Radius of a wheel [m]."""

    v_max: float = 0.306
    """Highest forward speed [m/s]."""

    w_max: float = 1.9
    """Highest yaw rate [rad/s]."""

    a_max: float = 0.9
    """Highest forward acceleration [m/s2]."""

    alpha_max: float = 7.725
    """Highest yaw acceleration [rad/s2]."""

    command_timeout_s: float = 0.5
    """The robot stops when no command came for this long [s]."""

    odometry_rate_hz: float = 62.0
    """Odometry samples a second [Hz]."""

    odometry_noise_std: float = 0.002
    """Relative standard deviation of the wheels' scale, drawn once a run: what makes odometry drift."""

    def __post_init__(self) -> None:
        _above_zero(
            self,
            "wheel_separation_m",
            "wheel_radius_m",
            "v_max",
            "w_max",
            "a_max",
            "alpha_max",
            "command_timeout_s",
            "odometry_rate_hz",
        )
        _not_negative(self, "odometry_noise_std")


@dataclass(frozen=True, kw_only=True)
class PlatformFieldSpec:
    """The robot's own magnetic field at its magnetometer, in base_link axes.

    B = (1 + S) b + h + E db/dt + (terms of motors, LiDAR and electronics), b the ambient field in
    base_link axes: the permanent, induced and eddy parts of Tolles and Lawson (1950), then the
    currents that an aircraft need not mind.
    """

    hard_iron_nt: Vec3 = ZERO3
    """Permanent part h [nT]."""

    soft_iron: Matrix3 = ZERO9
    """Induced part S, by rows [nT per nT]."""

    eddy_s: Matrix3 = ZERO9
    """Eddy-current part E, by rows [nT per nT/s]."""

    left_motor_nt_s: Vec3 = ZERO3
    """Field of the left motor for each rad/s of its wheel [nT s]."""

    right_motor_nt_s: Vec3 = ZERO3
    """Field of the right motor for each rad/s of its wheel [nT s]."""

    lidar_nt: Vec3 = ZERO3
    """Field of the LiDAR's supply while it is on [nT]."""

    battery_nt: Vec3 = ZERO3
    """Field of the supply current, for each ampere above that at full charge [nT/A]."""


@dataclass(frozen=True, kw_only=True)
class RobotSpec:
    """A robot: the USD asset that shows it, and what the simulator needs to drive it."""

    name: str
    """Name of its prim."""

    asset: Path
    """USD file of the articulation."""

    footprint_radius_m: float = 0.171
    """Radius of the circle that must stay clear of walls [m]."""

    base_height_m: float = 0.0
    """Height of base_link above the floor that the robot stands on [m]; read from the asset."""

    p_base_magnetometer: Vec3 = ZERO3
    """Magnetometer's origin in base_link at rest, through the links between [m]; read from the asset."""

    drive: DriveSpec = field(default_factory=DriveSpec)
    battery: BatterySpec = field(default_factory=BatterySpec)
    platform: PlatformFieldSpec = field(default_factory=PlatformFieldSpec)
    magnetometer: MagnetometerSpec = field(default_factory=MagnetometerSpec)
    imu: ImuSpec = field(default_factory=ImuSpec)
    lidar: LidarSpec = field(default_factory=LidarSpec)

    def __post_init__(self) -> None:
        _above_zero(self, "footprint_radius_m")


@dataclass(frozen=True, kw_only=True)
class LabSpec:
    """A room: a floor centred on the world's origin, low walls, posts of a motion-capture frame."""

    floor_m: tuple[float, float] = (6.0, 3.5)
    """Extent of the floor in x and y [m]."""

    wall_height_m: float = 0.3
    """Height of the walls [m]; 0 for none."""

    wall_thickness_m: float = 0.05
    """Thickness of the walls, outside the floor [m]."""

    post_height_m: float = 2.2
    """Height of the motion-capture posts, one at each corner and amid each long wall [m]; 0 for none."""

    def __post_init__(self) -> None:
        if not (self.floor_m[0] > 0 and self.floor_m[1] > 0):
            raise RefusedError(f"floor_m of LabSpec must be above 0 m each way, got {self.floor_m}")
        _not_negative(self, "wall_height_m", "post_height_m")
        _above_zero(self, "wall_thickness_m")


@dataclass(frozen=True, kw_only=True)
class EarthFieldSpec:
    """The Earth's field in the lab, uniform over it; world x is east, y north, z up."""

    b_world_nt: Vec3
    """Field in world axes [nT]."""

    latitude_deg: float
    """Geodetic latitude of the lab [deg]."""

    longitude_deg: float
    """Longitude of the lab [deg]."""

    height_m: float
    """Height above the WGS 84 ellipsoid [m]."""

    date: str
    """Day for which the field holds, YYYY-MM-DD."""


@dataclass(frozen=True, kw_only=True)
class SourceSpec:
    """A magnetised thing, seen as a point dipole."""

    name: str
    """Name of its prim."""

    p_world: Vec3
    """Position [m]."""

    m_world: Vec3
    """Dipole moment [A m2]."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """A lab, its magnetic map, and a robot in it."""

    name: str
    """Name of the scene, and of its root layer."""

    map_layer: Path
    """USD layer of the anomaly map."""

    robot: RobotSpec
    lab: LabSpec = field(default_factory=LabSpec)
    earth: EarthFieldSpec | None = None
    """Earth's field; none where only a survey is known."""

    sources: tuple[SourceSpec, ...] = ()
    """Magnetised things in the lab; with `earth` they make the exact field known."""

    start: Vec3 = ZERO3
    """Robot's first x [m], y [m] and yaw [rad] in world, where a path does not say."""
