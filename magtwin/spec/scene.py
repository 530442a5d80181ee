"""What there is: a Scene, its Robot and one frozen dataclass a sensor.

Plain data between `usd/`, which authors and reads it, and `sim/`, which runs it. Every field stands
for one attribute of a prim. Lengths are metres, angles radians, fields nT. A spec is checked at birth.
"""

import datetime
import math
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from magtwin.errors import InputError, find, hint
from magtwin.field.sources.bodies import SHAPES, Body, check_mesh, induced_magnetization
from magtwin.field.sources.earth import MODEL, SPAN
from magtwin.frames import IDENTITY_XYZW, quat_multiply, rotate
from magtwin.spec.furniture import Part, parts_of
from magtwin.summary import Summarized, Summary, listed

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]
Matrix3 = tuple[float, float, float, float, float, float, float, float, float]
"""Rows of a 3 x 3 matrix, one after the other."""

ZERO3: Vec3 = (0.0, 0.0, 0.0)
ZERO9: Matrix3 = (0.0,) * 9  # type: ignore[assignment]


MOST_RAYS = 100_000
"""Most rays of a scan."""

UNIT_TOLERANCE = 1e-6
"""How far the square of a unit quaternion's length may be from 1: single precision passes."""


class Spec:
    """What every spec has: all of its numbers are finite."""

    def __post_init__(self) -> None:
        for f in fields(self):  # type: ignore[arg-type]
            value = getattr(self, f.name)
            numbers = value if isinstance(value, tuple) else (value,)
            finite = all(abs(x) < math.inf for x in numbers if isinstance(x, int | float))
            self._require(f.name, finite, "be finite", value)

    def _require(self, name: str, holds: bool, what: str, seen: Any) -> None:
        if not holds:
            kind = type(self).__name__.lstrip("_")
            raise InputError(f"{name} of {kind} must {what}, got {seen!r}")

    def _above_zero(self, *names: str) -> None:
        for name in names:
            value = getattr(self, name)
            self._require(name, _least(value) > 0, "be above 0", value)

    def _not_negative(self, *names: str) -> None:
        for name in names:
            value = getattr(self, name)
            self._require(name, _least(value) >= 0, "not be below 0", value)

    def _within(self, name: str, least: float, most: float) -> None:
        value = getattr(self, name)
        self._require(name, least <= value <= most, f"lie in {least:g}..{most:g}", value)

    def _unit(self, *names: str) -> None:
        for name in names:
            q = getattr(self, name)
            off = abs(sum(c * c for c in q) - 1)
            self._require(name, off <= UNIT_TOLERANCE, "be a unit quaternion", q)


def _least(value: float | tuple[float, ...]) -> float:
    return min(value) if isinstance(value, tuple) else value


def spelled(value: Any) -> str:
    """Every figure of a spec as text, of which checksums are taken.

    It is what `repr` of a plain dataclass gives, whatever a class shows of itself at a prompt; runs keep its
    checksum, so it must not change.
    """
    if is_dataclass(value) and not isinstance(value, type):
        figures = ", ".join(f"{f.name}={spelled(getattr(value, f.name))}" for f in fields(value) if f.repr)
        return f"{type(value).__qualname__}({figures})"
    if type(value) is tuple:
        return f"({', '.join(map(spelled, value))}{',' * (len(value) == 1)})"
    return repr(value)


@dataclass(frozen=True, kw_only=True)
class MountSpec(Spec):
    """Where a sensor sits: a pose on a link of the robot."""

    link: str
    """Name of the robot link that carries the sensor."""

    p_link_sensor: Vec3 = ZERO3
    """Sensor's origin in the link [m]."""

    q_link_sensor_xyzw: Quat = IDENTITY_XYZW
    """Sensor's axes in the link."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._unit("q_link_sensor_xyzw")


MAGNETOMETER_KINDS = ("physical", "neural", "map-only")
"""What a magnetometer reads: the exact field; the map and what a network predicts; the map alone."""


@dataclass(frozen=True, kw_only=True)
class MagnetometerSpec(MountSpec):
    """A scalar magnetometer, whose vector axes are measured in turn; see
    `magtwin.sim.sensors.magnetometer`.
    """

    link: str = "magnetometer_link"
    """Name of the robot link that carries the sensor."""

    kind: Literal["physical", "neural", "map-only"] = "physical"
    """"physical": the disturbance is the exact field less the map; "neural": `network` predicts it;
    "map-only": there is none."""

    rate_hz: float = 135.0
    """Readings a second [Hz]."""

    noise_density_nt: float = 0.002
    """White noise, one-sided amplitude density [nT/sqrt(Hz)]."""

    flicker_corner_hz: float = 0.0
    """Frequency at which 1/f noise is as strong as white noise [Hz]; 0 for none."""

    resolution_nt: float = 1.664e-4
    """Smallest step of a reading [nT]; 0 for none."""

    bandwidth_hz: float = 0.0
    """Corner of the first-order low-pass that the field goes through [Hz]; 0 for none."""

    clock_offset_s: float = 0.0
    """How far its clock is ahead [s]: a reading stamped t is of the field at t less this."""

    heading_error_nt: float = 0.0
    """Error of a reading along the optical axis, its own z; falls with the cosine of the angle to it [nT]."""

    dead_zone_axis: float = 0.0
    """Angle between field and optical axis, either way, within which lock is lost [rad]."""

    dead_zone_plane: float = 0.0
    """Angle between field and the plane across the optical axis within which lock is lost [rad]."""

    gradient_max_nt_m: float = 0.0
    """Gradient of the field's magnitude above which lock is lost [nT/m]; 0 for never."""

    gradient_relock_nt_m: float = 0.0
    """Gradient below which lock is found again [nT/m]; not above `gradient_max_nt_m`."""

    latched_nt: float = 35_650.0
    """What is read while lock is lost [nT]."""

    latched_std_nt: float = 50.0
    """Standard deviation of that from one loss to the next [nT]; during one it stays the same."""

    dropout_share: float = 0.0
    """Share of readings that are missing."""

    vector_noise_density_nt: float = 0.03
    """White noise of the vector axes, one-sided amplitude density [nT/sqrt(Hz)]."""

    vector_bias_nt: Vec3 = ZERO3
    """Bias of each vector axis [nT]."""

    vector_scale: Vec3 = ZERO3
    """Relative error of each vector axis's scale."""

    vector_misalignment: Matrix3 = ZERO9
    """Where each vector axis points, by rows: its own unit vector and this [rad], brought to unit length."""

    network: Path | None = None
    """Weights that predict the disturbance where `kind` is "neural"."""

    network_sha256: str = ""
    """Checksum of the weights file, lower-case hex; "" means that any file will do."""

    inputs: tuple[str, ...] = ()
    """Names of the network's inputs, in order."""

    def __post_init__(self) -> None:
        super().__post_init__()
        kinds = MAGNETOMETER_KINDS
        self._require("kind", self.kind in kinds, f"be a known kind ({hint(self.kind, kinds)})", self.kind)
        self._above_zero("rate_hz")
        self._not_negative(
            "noise_density_nt",
            "flicker_corner_hz",
            "resolution_nt",
            "bandwidth_hz",
            "gradient_max_nt_m",
            "gradient_relock_nt_m",
            "latched_std_nt",
            "vector_noise_density_nt",
        )
        self._within("dead_zone_axis", 0, math.pi / 2)
        self._within("dead_zone_plane", 0, math.pi / 2)
        self._within("dropout_share", 0, 1)
        low, high = self.gradient_relock_nt_m, self.gradient_max_nt_m
        self._require("gradient_relock_nt_m", low <= high, f"not be above gradient_max_nt_m {high!r}", low)
        self._require("vector_scale", min(self.vector_scale) > -1, "be above -1", self.vector_scale)

    @property
    def noise_std_nt(self) -> float:
        """Standard deviation of the white noise of one reading at its own rate [nT]."""
        return self.noise_density_nt * math.sqrt(self.rate_hz / 2)


@dataclass(frozen=True, kw_only=True)
class ImuSpec(MountSpec):
    """An inertial unit that gives orientation, rates and acceleration with gravity removed."""

    link: str = "imu_link"

    rate_hz: float = 62.0
    """Samples a second [Hz]."""

    latency_s: float = 0.008
    """Time that a sample takes to arrive [s]."""

    jitter_s: float = 0.002
    """Mean of the further delay of each sample, exponentially distributed [s]."""

    yaw_zero: float = 0.0
    """World heading of base_link at which the orientation's yaw is 0 [rad]: where it was switched on."""

    tilt: Vec2 = (-0.009, 0.0002)
    """Roll and pitch by which the sensor is not quite level on its robot [rad]."""

    level_error: Vec2 = (0.0048, -0.0036)
    """Roll and pitch, about axes that do not turn with the robot, by which what the sensor takes for level
    is off [rad]: the floor slopes a little. With `tilt` it gives the orientation's x and y the means and the
    rank correlations with the disturbance that the published ones have."""

    tilt_std: float = 0.0095
    """Standard deviation of the roll and pitch that wander, by floor and casters [rad]."""

    tilt_time_s: float = 20.0
    """Time in which the wandering tilt forgets itself [s]."""

    orientation_noise_std: float = 0.001
    """Standard deviation of each small angle of the orientation [rad]."""

    gyro_noise_std: float = 0.002
    """Standard deviation of a rate sample, each axis, of a robot that stands [rad/s]."""

    gyro_bias: Vec3 = ZERO3
    """Bias of the rates at the start of a run [rad/s]."""

    gyro_bias_walk: float = 2e-5
    """How fast the bias walks: its standard deviation after 1 s [rad/s]."""

    gyro_vibration: Vec3 = (0.052, 0.16, 0.05)
    """Standard deviation of the rates by vibration, for each m/s of speed [rad/m]."""

    accel_noise_std: float = 0.02
    """Standard deviation of an acceleration sample, each axis, of a robot that stands [m/s2]."""

    accel_vibration: Vec3 = (1.7, 1.1, 4.1)
    """Standard deviation of the acceleration by vibration, for each m/s of speed [1/s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("rate_hz")
        self._not_negative(
            "latency_s",
            "jitter_s",
            "tilt_std",
            "tilt_time_s",
            "orientation_noise_std",
            "gyro_noise_std",
            "gyro_bias_walk",
            "gyro_vibration",
            "accel_noise_std",
            "accel_vibration",
        )


@dataclass(frozen=True, kw_only=True)
class LidarSpec(MountSpec):
    """A spinning planar LiDAR; its motor and current disturb the field while it is on."""

    link: str = "rplidar_link"

    scan_rate_hz: float = 7.5
    """Turns a second [Hz]."""

    rays: int = 720
    """Rays of a scan, evenly all the way round."""

    range_min_m: float = 0.15
    """Nearest range [m]."""

    range_max_m: float = 12.0
    """Farthest range [m]."""

    range_noise_std_m: float = 0.01
    """Standard deviation of a range [m]."""

    latency_s: float = 0.14
    """Time that a scan takes to arrive [s]: a whole turn, and what comes after it."""

    jitter_s: float = 0.005
    """Mean of the further delay of each scan, exponentially distributed [s]."""

    on_s: float = 20.0
    """Time on in each cycle of the schedule, which begins off [s]; 0 means always off."""

    off_s: float = 40.0
    """Time off in each cycle of the schedule [s]; 0 means always on."""

    phase_s: float = 0.0
    """How far into a cycle a run begins [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("scan_rate_hz", "range_max_m")
        self._not_negative("range_min_m", "range_noise_std_m", "latency_s", "jitter_s")
        self._not_negative("on_s", "off_s", "phase_s")
        self._require("rays", isinstance(self.rays, int), "be a whole number", self.rays)
        self._within("rays", 1, MOST_RAYS)
        low, high = self.range_min_m, self.range_max_m
        self._require("range_min_m", low < high, f"be below range_max_m {high!r}", low)


@dataclass(frozen=True, kw_only=True)
class BatterySpec(Spec):
    """A battery and what it feeds; `magtwin.sim.sensors.battery.discharge` says what becomes of it."""

    model: Literal["power", "linear"] = "power"
    """"power": it gives what electronics, LiDAR and motors draw, and sags; "linear": it falls evenly."""

    capacity_wh: float = 26.0
    """Energy of a full pack [Wh]."""

    load_w: float = 15.0
    """Power of the electronics [W]; of the linear model all power."""

    lidar_w: float = 2.3
    """Power of the LiDAR while it is on [W]."""

    drag_n: float = 2.0
    """Force that the robot drives against [N]."""

    mass_kg: float = 3.945
    """Mass that its wheels accelerate [kg]."""

    motor_efficiency: float = 0.4
    """Work of the wheels for each joule that the motors draw, above 0 to 1."""

    initial_fraction: float = 1.0
    """Charge at the start of a run, 0 to 1."""

    voltage_empty_v: float = 12.44
    """Voltage at charge 0, no load on it [V]."""

    voltage_full_v: float = 16.24
    """Voltage at charge 1, no load on it [V]."""

    discharge: tuple[float, ...] = (0.0, 0.28, 0.4, 0.47, 0.52, 0.57, 0.63, 0.71, 0.8, 0.9, 1.0)
    """Voltage at evenly spaced charges from 0 to 1, as a share of the way from empty to full."""

    resistance_ohm: float = 0.12
    """Inner resistance [ohm], which makes the voltage sag under load."""

    voltage_noise_std_v: float = 0.02
    """Standard deviation of a voltage sample [V]."""

    rate_hz: float = 0.5
    """Samples a second [Hz]."""

    latency_s: float = 0.05
    """Time that a sample takes to arrive [s]."""

    jitter_s: float = 0.01
    """Mean of the further delay of each sample, exponentially distributed [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("model", self.model in ("power", "linear"), 'be "power" or "linear"', self.model)
        self._above_zero("capacity_wh", "motor_efficiency", "voltage_empty_v", "voltage_full_v", "rate_hz")
        self._not_negative("load_w", "lidar_w", "drag_n", "mass_kg", "resistance_ohm")
        self._not_negative("voltage_noise_std_v", "latency_s", "jitter_s")
        self._within("initial_fraction", 0, 1)
        self._within("motor_efficiency", 0, 1)
        low, high, curve = self.voltage_empty_v, self.voltage_full_v, self.discharge
        self._require("voltage_full_v", high >= low, f"not be below voltage_empty_v {low!r}", high)
        rises = len(curve) > 1 and curve[0] == 0 and curve[-1] == 1 and list(curve) == sorted(curve)
        self._require("discharge", rises, "rise from 0 to 1 in two numbers or more", curve)


@dataclass(frozen=True, kw_only=True)
class MocapSpec(Spec):
    """How the lab's motion capture sees a robot."""

    rate_hz: float = 120.0
    """Poses a second [Hz]."""

    latency_s: float = 0.01
    """Time that a pose takes to arrive [s]."""

    jitter_s: float = 0.001
    """Mean of the further delay of each pose, exponentially distributed [s]."""

    p_noise_std_m: float = 0.0005
    """Standard deviation of a position, each axis [m]."""

    angle_noise_std: float = 0.003
    """Standard deviation of each small angle of an orientation [rad]."""

    dropout_every_s: float = 60.0
    """Mean time in which the markers are seen, between two dropouts [s]; 0 for no dropouts."""

    dropout_s: float = 0.2
    """Mean length of a dropout [s]; 0 for no dropouts."""

    offset_m: tuple[float, float] = (0.0, 0.0)
    """Where base_link lies forward and left of where it is taken to be [m]: markers are put on by hand."""

    offset_drift_m: tuple[float, float] = (0.0, 0.0)
    """What `offset_m` has changed by since the survey [m]: the markers were put on anew."""

    latency_drift_s: float = 0.0
    """What `latency_s` has changed by since the survey [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("rate_hz")
        if self.latency_s + self.latency_drift_s < 0:
            raise InputError(
                f"latency_drift_s of motion capture takes its latency of {self.latency_s} s below 0, "
                f"got {self.latency_drift_s}"
            )
        self._not_negative("latency_s", "jitter_s", "p_noise_std_m", "angle_noise_std")
        self._not_negative("dropout_every_s", "dropout_s")


@dataclass(frozen=True, kw_only=True)
class DriveSpec(Spec):
    """A differential drive: its size, its limits and its odometry."""

    left_wheel_joint: str = "left_wheel_joint"
    """Name of the left wheel's joint."""

    right_wheel_joint: str = "right_wheel_joint"
    """Name of the right wheel's joint."""

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

    wheel_rate_max: float = 12.87
    """Highest rate of a wheel [rad/s]: a Create 3's rim at 0.46 m/s, its top speed with safety off."""

    motor_lag_s: float = 0.04
    """Time constant of the motors' first-order lag [s]; 0 for none. Ours: that of small geared motors."""

    slip_s2_m: float = 0.011
    """Slip of the wheels along their way, for each m/s2 of acceleration [s2/m]; ours: 1 % at 0.9 m/s2."""

    yaw_slip: float = 0.01
    """Share of a yaw rate that the wheels' scrubbing takes [1]; ours."""

    wheel_radius_error_std: float = 0.002
    """Relative standard deviation of the wheels' radius about the nominal one, drawn once a run; ours."""

    wheel_separation_error_std: float = 0.003
    """Relative standard deviation of their separation about the nominal one, drawn once a run; ours."""

    wheel_errors: Vec2 = (0.0, 0.0)
    """Relative error of radius and separation that the session's runs share, beside what each run draws."""

    command_timeout_s: float = 0.5
    """The robot stops when no command came for this long [s]."""

    odometry_rate_hz: float = 62.0
    """Odometry samples a second [Hz]."""

    odometry_latency_s: float = 0.012
    """Time that a sample of odometry takes to arrive [s]."""

    odometry_jitter_s: float = 0.003
    """Mean of the further delay of each sample, exponentially distributed [s]."""

    odometry_scale: Vec2 = (1.0, 1.0)
    """Factor by which odometry mistakes the travel of the left and the right wheel."""

    odometry_noise_std: float = 0.002
    """Relative standard deviation of the wheels' scale, drawn once a run: what makes odometry drift."""

    odometry_v_noise_std: Vec3 = (0.003, 0.00275, 0.000135)
    """Standard deviation of the noise of the linear velocity, each axis [m/s]."""

    odometry_w_noise_std: Vec3 = (0.011, 0.028, 0.01)
    """Standard deviation of the noise of the angular velocity, each axis [rad/s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero(
            "wheel_separation_m",
            "wheel_radius_m",
            "v_max",
            "w_max",
            "a_max",
            "alpha_max",
            "wheel_rate_max",
            "command_timeout_s",
            "odometry_rate_hz",
            "odometry_scale",
        )
        self._not_negative(
            "odometry_latency_s",
            "odometry_jitter_s",
            "odometry_noise_std",
            "odometry_v_noise_std",
            "odometry_w_noise_std",
            "motor_lag_s",
            "slip_s2_m",
            "wheel_radius_error_std",
            "wheel_separation_error_std",
        )
        self._require("yaw_slip", 0 <= self.yaw_slip < 1, "be at least 0 and below 1", self.yaw_slip)
        whole = f"be below 1 at a_max {self.a_max!r}, where all of the way would be slip"
        self._require("slip_s2_m", self.slip_s2_m * self.a_max < 1, whole, self.slip_s2_m)
        self._require("wheel_errors", min(self.wheel_errors) > -1, "be above -1", self.wheel_errors)
        left, right = self.left_wheel_joint, self.right_wheel_joint
        self._require("right_wheel_joint", left != right, "be another joint than the left wheel's", right)


@dataclass(frozen=True, kw_only=True)
class PlatformFieldSpec(Spec):
    """The robot's own magnetic field at its magnetometer, in base_link axes.

    B = (1 + S) b + h + E db/dt + (terms of motors, LiDAR, electronics and iron that turns), b the ambient
    field in base_link axes: the permanent, induced and eddy parts of Tolles and Lawson (1950), then what an
    aircraft need not mind. `magtwin.sim.interference` says how each enters.
    """

    hard_iron_nt: Vec3 = ZERO3
    """Permanent part h [nT]."""

    soft_iron: Matrix3 = ZERO9
    """Induced part S, by rows [nT per nT]."""

    eddy_s: Matrix3 = ZERO9
    """Eddy-current part E, by rows [nT per nT/s]."""

    left_motor_nt_nm: Vec3 = ZERO3
    """Field of the left motor for each N m of torque at its wheel, which its current is in proportion to
    [nT/(N m)]."""

    right_motor_nt_nm: Vec3 = ZERO3
    """Field of the right motor for each N m of torque at its wheel [nT/(N m)]."""

    lidar_nt: Vec3 = ZERO3
    """Steady field of the LiDAR and its supply while it is on [nT]."""

    lidar_cos_nt: Vec3 = ZERO3
    """Field of the LiDAR's turning motor when its angle is 0 [nT]; at angle a it is cos(a) of this."""

    lidar_sin_nt: Vec3 = ZERO3
    """Field of the LiDAR's turning motor a quarter turn on [nT]; at angle a it is sin(a) of this."""

    lidar_phase: float = 0.0
    """Angle of the LiDAR's motor at the start of a run [rad]."""

    battery_nt: Vec3 = ZERO3
    """Field of the supply current, for each ampere above that at rest with a full pack [nT/A]."""

    left_wheel_moment: float = 0.0
    """Magnetic moment of the left wheel's iron across its axle [A m2]: it turns with the wheel."""

    left_wheel_phase: float = 0.0
    """Angle from up, forwards, at which that moment is at the start of a run [rad]."""

    right_wheel_moment: float = 0.0
    """Magnetic moment of the right wheel's iron across its axle [A m2]."""

    right_wheel_phase: float = 0.0
    """Angle from up, forwards, at which that moment is at the start of a run [rad]."""

    caster_moment: float = 0.0
    """Magnetic moment of the caster's iron across the way [A m2]; it rolls as the robot drives."""

    caster_phase: float = 0.0
    """Angle from up, forwards, at which that moment is at the start of a run [rad]."""

    p_base_caster: Vec3 = ZERO3
    """Middle of the caster in base_link [m]."""

    caster_radius_m: float = 0.01
    """Radius that the caster rolls on [m]."""

    hard_iron_change_nt: Vec3 = ZERO3
    """Part of h that came after the survey of the map [nT]; 0 in the survey's session. A map that this robot
    surveyed holds h without it."""

    hard_iron_drift_nt: Vec3 = ZERO3
    """Mean change of h from the day of a survey to the days of driving that follow [nT]: handling, docking
    and tools magnetise or demagnetise."""

    hard_iron_std_nt: float = 0.0
    """Standard deviation of each part of h from one day of driving to another [nT]."""

    current_std: float = 0.0
    """Relative standard deviation of what motors, LiDAR and battery add, from one day to another: wires lie
    otherwise."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("caster_radius_m")
        self._not_negative("hard_iron_std_nt", "current_std")


@dataclass(frozen=True, kw_only=True, repr=False)
class RobotSpec(Summarized, Spec):
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

    q_base_magnetometer_link_xyzw: Quat = IDENTITY_XYZW
    """Axes of the link that carries the magnetometer, in base_link; read from the asset."""

    q_base_imu_link_xyzw: Quat = IDENTITY_XYZW
    """Axes of the link that carries the IMU, in base_link; read from the asset."""

    p_base_lidar: Vec3 = ZERO3
    """LiDAR's origin in base_link at rest [m]; read from the asset."""

    q_base_lidar_link_xyzw: Quat = IDENTITY_XYZW
    """Axes of the link that carries the LiDAR, in base_link; read from the asset."""

    drive: DriveSpec = field(default_factory=DriveSpec)
    battery: BatterySpec = field(default_factory=BatterySpec)
    platform: PlatformFieldSpec = field(default_factory=PlatformFieldSpec)
    magnetometer: MagnetometerSpec = field(default_factory=MagnetometerSpec)
    imu: ImuSpec = field(default_factory=ImuSpec)
    lidar: LidarSpec = field(default_factory=LidarSpec)
    mocap: MocapSpec = field(default_factory=MocapSpec)

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("footprint_radius_m")
        self._unit("q_base_magnetometer_link_xyzw", "q_base_imu_link_xyzw", "q_base_lidar_link_xyzw")

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
        """Name and magnetometer; drive; other sensors; the field that it makes itself."""
        sensor, drive = self.magnetometer, self.drive
        network = "" if sensor.network is None else f" ({sensor.network.name})"
        x, y, z = self.p_base_magnetometer
        return Summary(
            f"RobotSpec {self.name}: {sensor.kind} magnetometer{network} at {sensor.rate_hz:g} Hz",
            (
                (
                    "sensor",
                    f"({x:.3g}, {y:.3g}, {z:.3g}) m in base_link, {sensor.noise_density_nt:.3g} nT/sqrt(Hz)",
                ),
                (
                    "drive",
                    f"{drive.v_max:.3g} m/s, {drive.w_max:.3g} rad/s, radius {self.footprint_radius_m:.3g} m",
                ),
                (
                    "others",
                    f"LiDAR {self.lidar.rays} rays, IMU {self.imu.rate_hz:g} Hz, "
                    f"battery {self.battery.capacity_wh:g} Wh",
                ),
                ("asset", str(self.asset)),
            ),
        )


def _product(a: Quat, b: Quat) -> Quat:
    x, y, z, w = quat_multiply(a, b).tolist()
    return (x, y, z, w)


@dataclass(frozen=True, kw_only=True)
class LabSpec(Spec):
    """A room: a floor centred on the world's origin, low walls, posts of a motion-capture frame."""

    floor_m: tuple[float, float] = (6.0, 3.5)
    """Size of the floor in x and y [m]."""

    wall_height_m: float = 0.3
    """Height of the walls [m]; 0 for none."""

    wall_thickness_m: float = 0.05
    """Thickness of the walls, outside the floor [m]."""

    post_height_m: float = 2.2
    """Height of the motion-capture posts, one at each corner and amid each long wall [m]; 0 for none."""

    apron_m: float = 0.2
    """Width of the slab outside of the walls, which furniture may stand on [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("floor_m", min(self.floor_m) > 0, "be above 0 m each way", self.floor_m)
        self._not_negative("wall_height_m", "post_height_m", "apron_m")
        self._above_zero("wall_thickness_m")


@dataclass(frozen=True, kw_only=True)
class EarthFieldSpec(Spec):
    """The Earth's field in the lab, uniform over it."""

    b_world_nt: Vec3
    """Field in world axes [nT]."""

    latitude_deg: float
    """Geodetic latitude of the room, north positive [deg]."""

    longitude_deg: float
    """Longitude of the room, east positive [deg]."""

    height_m: float
    """Height above the WGS 84 ellipsoid [m]."""

    date: str
    """Date of the field, YYYY-MM-DD."""

    north_deg: float = 0.0
    """Angle from the world's y to true north, counter-clockwise seen from above [deg]."""

    measured: bool = False
    """Whether the field was measured, so that it may differ from the model's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._within("latitude_deg", -90, 90)
        self._within("longitude_deg", -180, 360)
        self._within("north_deg", -360, 360)
        self._require("date", _is_day(self.date), "be a day as YYYY-MM-DD", self.date)
        first, last = SPAN
        if not self.measured:
            within = first <= datetime.date.fromisoformat(self.date) <= last
            self._require("date", within, f"lie in {MODEL}'s span, {first} to {last}", self.date)


def _is_day(text: str) -> bool:
    try:
        return datetime.date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


@dataclass(frozen=True, kw_only=True, repr=False)
class SourceSpec(Summarized, Spec):
    """A magnetised thing: a point dipole, or a uniformly magnetised body of some shape."""

    name: str
    """Name of its prim: letters, digits and _, no digit first."""

    p_world: Vec3
    """Where it is: the middle of all but a mesh [m]."""

    m_world: Vec3 = ZERO3
    """Dipole moment of a point, in world axes [A m2]."""

    shape: str = "point"
    """"point", "cuboid", "cylinder", "sphere" or "mesh"."""

    q_world_xyzw: Quat = IDENTITY_XYZW
    """Axes of a body in world; a cylinder's axis is its own z."""

    size_m: Vec3 = ZERO3
    """Sides of the box about a body along its own axes [m]; follows from the vertices of a mesh."""

    magnetization: Vec3 = ZERO3
    """Remanent magnetization of a body in its own axes [A/m]."""

    susceptibility: float = 0.0
    """Volume susceptibility of a body's material [1]; see
    `magtwin.field.sources.bodies.induced_magnetization`."""

    vertices_m: tuple[Vec3, ...] = ()
    """Vertices of a mesh in its own axes [m], in single precision, as USD has them."""

    faces: tuple[tuple[int, int, int], ...] = ()
    """Corners of a mesh's triangles, counter-clockwise seen from outside."""

    def __post_init__(self) -> None:
        super().__post_init__()
        kinds = ("point", *SHAPES)
        self._require(
            "shape", self.shape in kinds, f"be a known shape ({hint(self.shape, kinds)})", self.shape
        )
        self._unit("q_world_xyzw")
        self._not_negative("susceptibility")
        if self.shape == "point":
            self._check_point()
            return
        self._require("m_world", self.m_world == ZERO3, f"not be given for a {self.shape}", self.m_world)
        if self.shape == "mesh":
            vertices = np.asarray(np.asarray(self.vertices_m, np.float32), float).reshape(-1, 3)
            check_mesh(vertices, np.asarray(self.faces, int).reshape(-1, 3), f"source {self.name!r}")
            object.__setattr__(self, "vertices_m", tuple(map(tuple, vertices.tolist())))
            object.__setattr__(self, "size_m", tuple(np.ptp(vertices, axis=0).tolist()))
        else:
            self._require("vertices_m", not (self.vertices_m or self.faces), "go with shape mesh", "some")
            self._require(
                "size_m", min(self.size_m) > 0, "be above 0 m each way: no volume, no field", self.size_m
            )
        x, y, z = self.size_m
        if self.shape == "cylinder":
            self._require("size_m", x == y, "be as wide in y as in x for a cylinder", self.size_m)
        if self.shape == "sphere":
            self._require("size_m", x == y == z, "be alike each way for a sphere", self.size_m)

    def _check_point(self) -> None:
        for name, none in {"size_m": ZERO3, "magnetization": ZERO3, "susceptibility": 0.0}.items():
            seen = getattr(self, name)
            self._require(
                name, seen == none, "be given with a shape: a point has no volume, only m_world", seen
            )
        turned = self.q_world_xyzw != IDENTITY_XYZW
        self._require(
            "q_world_xyzw", not turned, "not turn a point, whose m_world is in world axes", "a turn"
        )
        self._require("vertices_m", not (self.vertices_m or self.faces), "go with shape mesh", "some")

    def body(self, b_world_nt: Vec3 | None = None) -> Body:
        """What is magnetised, its induced part included; of all but a point.

        Args:
            b_world_nt: The Earth's field in world axes [nT]; none where it is not known.

        Raises:
            InputError: It has a susceptibility, and the Earth's field is not known.
        """
        body = Body(
            shape=self.shape,
            size_m=np.array(self.size_m),
            p_world=np.array(self.p_world),
            q_world_xyzw=np.array(self.q_world_xyzw),
            magnetization=np.array(self.magnetization),
            vertices=np.array(self.vertices_m) if self.vertices_m else None,
            faces=np.array(self.faces) if self.faces else None,
        )
        if not self.susceptibility:
            return body
        if b_world_nt is None:
            raise InputError(
                f"source {self.name!r} has susceptibility {self.susceptibility:g}, but the Earth's field, "
                "which magnetises it, is not known; give the scene an [earth] table"
            )
        induced = induced_magnetization(body, self.susceptibility, b_world_nt)
        return replace(body, magnetization=body.magnetization + induced)


@dataclass(frozen=True, kw_only=True)
class FurnitureSpec(Spec):
    """A piece of furniture or of the building; `magtwin.spec.furniture` says what each kind consists of."""

    name: str
    """Name of its prim."""

    kind: str
    """What it is, a name of `magtwin.spec.furniture.KINDS`, or "box", "cylinder" or "mesh"."""

    p_world: Vec3
    """Where it stands: the middle of its footprint, on the floor [m]."""

    q_world_xyzw: Quat = IDENTITY_XYZW
    """Its axes in world: x is its front, z up."""

    magnetization: tuple[float, ...] = ()
    """Magnetization of its steel parts, each along its longest side, in their order [A/m]; () for none."""

    susceptibility: float = 0.0
    """Volume susceptibility of its steel parts [1]."""

    material: str = ""
    """What a box, cylinder or mesh is made of, a name of `magtwin.spec.furniture.MATERIALS`."""

    size_m: Vec3 = ZERO3
    """Size of a box along its own x, y and z, or diameter, diameter and height of a cylinder [m]."""

    vertices_m: tuple[Vec3, ...] = ()
    """Vertices of a mesh about the middle of its box [m], in single precision; it stands on the floor."""

    faces: tuple[tuple[int, int, int], ...] = ()
    """Corners of a mesh's triangles, counter-clockwise from outside."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._unit("q_world_xyzw")
        self._not_negative("susceptibility")
        steel = [part.name for part in self.parts if part.steel]
        fits = len(self.magnetization) in (0, len(steel))
        what = f"have one number for each of {', '.join(steel)}" if steel else "be left out: it has no steel"
        self._require("magnetization", fits, what, self.magnetization)
        if not any(self.magnetization):
            object.__setattr__(self, "magnetization", ())
        if self.faces:
            object.__setattr__(self, "vertices_m", self.parts[0].vertices_m)
            self.sources()  # refuses a steel mesh that is not closed

    @property
    def parts(self) -> tuple[Part, ...]:
        """What it consists of."""
        return parts_of(
            self.kind,
            material=self.material,
            size_m=self.size_m,
            vertices_m=self.vertices_m,
            faces=self.faces,
        )

    def sources(self, *, in_world: bool = True) -> tuple[SourceSpec, ...]:
        """Its steel, a source each, named after the piece and the part.

        Args:
            in_world: Whether they stand where it does; otherwise they are in its own axes.
        """
        steel = [part for part in self.parts if part.steel]
        turn = self.q_world_xyzw if in_world else IDENTITY_XYZW
        sources = []
        for part, m in zip(steel, self.magnetization or (0.0,) * len(steel), strict=True):
            x, y, z = rotate(turn, part.p) + self.p_world if in_world else map(float, part.p)
            sources.append(
                SourceSpec(
                    name=f"{self.name}_{part.name}",
                    p_world=(float(x), float(y), float(z)),
                    shape=part.shape,
                    q_world_xyzw=turn,
                    size_m=ZERO3 if part.faces else part.size_m,
                    vertices_m=part.vertices_m,
                    faces=part.faces,
                    magnetization=tuple(m * (k == part.along) for k in range(3)),  # type: ignore[arg-type]
                    susceptibility=self.susceptibility,
                )
            )
        return tuple(sources)


@lru_cache(maxsize=1024)
def _steel(piece: FurnitureSpec) -> tuple[SourceSpec, ...]:
    """`piece.sources()`, kept, as every run of a furnished lab asks for them."""
    return tuple(piece.sources())


@dataclass(frozen=True, kw_only=True)
class SurveySpec(Spec):
    """How the robot surveys a room without a map: it stands at each node of a grid in each heading."""

    spacing_m: float = 0.25
    """Distance between nodes [m]."""

    headings_deg: tuple[float, ...] = (0.0, 90.0, 180.0, 270.0)
    """Headings in which it stands at each node, ascending [deg]."""

    readings: int = 135
    """Readings whose mean a node gives."""

    height_m: float | None = None
    """Height of the sensor above the floor [m]; by default the robot's own."""

    heading_error_deg: float = 0.0
    """Standard deviation of its heading about the node's [deg]."""

    position_error_m: float = 0.0
    """Standard deviation of where it stands about the node, along x and y [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("spacing_m")
        self._require("readings", self.readings >= 1, "be at least 1", self.readings)
        self._not_negative("heading_error_deg", "position_error_m")
        self._require("height_m", (self.height_m or 0.0) >= 0, "not be below 0", self.height_m)
        headings = self.headings_deg
        rises = bool(headings) and list(headings) == sorted(set(headings))
        within = rises and headings[0] >= 0 and headings[-1] < 360
        self._require("headings_deg", within, "ascend from 0 to below 360", headings)


@dataclass(frozen=True, kw_only=True, repr=False)
class PlacedRobot(Summarized, Spec):
    """A robot in a scene: what it is, where it begins, and what it drives."""

    robot: RobotSpec

    start: Vec3 = ZERO3
    """First x [m], y [m] and yaw [rad] in world, where a path does not say."""

    path: str | Path = ""
    """What it drives unless told otherwise: a name of `magtwin.path.PATHS`, "random", or a CSV file; "" for
    what whoever runs the scene takes."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Scene(Summarized, Spec):
    """A lab, its magnetic map, and a robot in it, or several.

    What is asked of a scene is asked of its first robot, `robot`; `led_by` makes another one the first.
    """

    name: str
    """Name of the scene, and of its root layer."""

    map_layer: Path
    """USD layer of the anomaly map."""

    map_sha256: str = ""
    """Checksum of the map layer's file, lower-case hex; "" means that any file will do."""

    robot: RobotSpec
    lab: LabSpec = field(default_factory=LabSpec)
    earth: EarthFieldSpec | None = None
    """Earth's field; none where only a survey is known."""

    sources: tuple[SourceSpec, ...] = ()
    """Magnetised things in the lab; with `earth` and `furniture` they make the exact field known."""

    furniture: tuple[FurnitureSpec, ...] = ()
    """Furniture and parts of the building, whose steel is magnetised too."""

    start: Vec3 = ZERO3
    """Robot's first x [m], y [m] and yaw [rad] in world, where a path does not say."""

    path: str | Path = ""
    """What the robot drives unless told otherwise; see `PlacedRobot`."""

    others: tuple[PlacedRobot, ...] = ()
    """Further robots in the lab, each of a name of its own."""

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [placed.robot.name for placed in self.robots]
        twice = next((name for name in names if names.count(name) > 1), "")
        self._require("others", not twice, "be robots of names of their own", f"{twice!r} twice")

    @property
    def robots(self) -> tuple[PlacedRobot, ...]:
        """Every robot, `robot` first."""
        return (PlacedRobot(robot=self.robot, start=self.start, path=self.path), *self.others)

    def led_by(self, name: str) -> "Scene":
        """The scene with the robot of that name as its first, the others after it in their order.

        Raises:
            UnknownNameError: No robot is called so; the text names the nearest one.
        """
        placed = find("robot", name, {placed.robot.name: placed for placed in self.robots})
        rest = tuple(other for other in self.robots if other.robot.name != name)
        return replace(self, robot=placed.robot, start=placed.start, path=placed.path, others=rest)

    def _summary(self) -> Summary:
        """Name and floor; robots; map; what makes the field; what is driven."""
        width, depth = self.lab.floor_m
        robots = [f"{one.robot.name} ({one.robot.magnetometer.kind} magnetometer)" for one in self.robots]
        field = "no Earth's field" if self.earth is None else f"Earth's field of {self.earth.date}"
        return Summary(
            f"Scene {self.name}: floor {width:g} x {depth:g} m",
            (
                ("robots" if self.others else "robot", listed(robots, 80)),
                ("map", str(self.map_layer)),
                (
                    "field",
                    f"{field}, {len(self.sources):,} sources, {len(self.furniture):,} pieces of furniture",
                ),
                ("path", listed([str(one.path) or "not set" for one in self.robots])),
                ("furniture", listed([one.name for one in self.furniture], 200)),
            ),
        )

    @property
    def magnets(self) -> tuple[SourceSpec, ...]:
        """Everything that is magnetised: the sources, and the steel of the furniture."""
        return (*self.sources, *(source for piece in self.furniture for source in _steel(piece)))
