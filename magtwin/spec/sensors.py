"""The sensors of a robot: magnetometer, IMU, LiDAR and battery; and motion capture, which sees it."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from magtwin.errors import InputError, hint
from magtwin.frames import IDENTITY_XYZW
from magtwin.spec.base import ZERO3, ZERO9, Matrix3, Quat, Spec, Vec2, Vec3

MOST_RAYS = 100_000
"""Most rays of a scan."""


MAGNETOMETER_KINDS = ("physical", "neural", "map-only")
"""What a magnetometer reads: the exact field; the map and what a network predicts; the map alone."""


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

    stuck_nt: float = 35_650.0
    """What is read while lock is lost [nT]."""

    stuck_std_nt: float = 50.0
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
            "stuck_std_nt",
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
