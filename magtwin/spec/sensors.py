"""The sensors of a robot: magnetometer, IMU, LiDAR, battery; and the motion capture of the lab."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from magtwin.frames import IDENTITY_XYZW
from magtwin.spec.base import ZERO3, ZERO9, Matrix3, Quat, Spec, Vec2, Vec3

MOST_RAYS = 100_000
"""Most rays of a scan."""

MAGNETOMETER_KINDS = ("physical", "neural", "map-only")
"""A magnetometer reads the exact field; the map and a network's prediction; or the map alone."""


@dataclass(frozen=True, kw_only=True)
class MountSpec(Spec):
    """The pose of a sensor on a link of the robot."""

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
    """A scalar magnetometer with vector axes, see `magtwin.sim.sensors.magnetometer`."""

    link: str = "magnetometer_link"
    """Name of the robot link that carries the sensor."""

    kind: Literal["physical", "neural", "map-only"] = "physical"
    """"physical": the disturbance is the exact field minus the map; "neural": `network` predicts it;
    "map-only": no disturbance."""

    rate_hz: float = 135.0
    """Output rate [Hz]."""

    noise_density_nt: float = 0.002
    """White noise, one-sided amplitude density [nT/sqrt(Hz)]."""

    flicker_corner_hz: float = 0.0
    """Frequency at which 1/f noise equals white noise [Hz]; 0 disables it."""

    resolution_nt: float = 1.664e-4
    """Smallest step of a reading [nT]; 0 disables rounding."""

    bandwidth_hz: float = 0.0
    """Corner frequency of the first-order low-pass [Hz]; 0 disables it."""

    clock_offset_s: float = 0.0
    """Offset of its clock [s]: a reading with stamp t shows the field at t minus the offset."""

    heading_error_nt: float = 0.0
    """Heading error: error with the field along the optical axis (z); it falls with the cosine of the angle
    [nT]."""

    dead_zone_axis: float = 0.0
    """The sensor loses lock if the field is within this angle of the optical axis, in either direction
    [rad]."""

    dead_zone_plane: float = 0.0
    """The sensor loses lock if the field is within this angle of the plane across the optical axis [rad]."""

    gradient_max_nt_m: float = 0.0
    """The sensor loses lock above this gradient of the magnitude [nT/m]; 0 disables it."""

    gradient_relock_nt_m: float = 0.0
    """The sensor locks again below this gradient [nT/m]; at most `gradient_max_nt_m`."""

    stuck_nt: float = 35_650.0
    """Mean reading of a sensor that is stuck, having lost lock [nT]."""

    stuck_std_nt: float = 50.0
    """Standard deviation of that reading between losses of lock [nT]; during one loss it is constant."""

    dropout_share: float = 0.0
    """Fraction of readings that are missing."""

    vector_noise_density_nt: float = 0.03
    """White noise of the vector axes, one-sided amplitude density [nT/sqrt(Hz)]."""

    vector_bias_nt: Vec3 = ZERO3
    """Bias of each vector axis [nT]."""

    vector_scale: Vec3 = ZERO3
    """Relative scale error of each vector axis."""

    vector_misalignment: Matrix3 = ZERO9
    """Misalignment of each vector axis, by rows: added to its unit vector [rad], then normalised."""

    network: Path | None = None
    """Weights that predict the disturbance if `kind` is "neural"."""

    network_sha256: str = ""
    """SHA-256 of the weights file, lower-case hex; "" accepts any file."""

    inputs: tuple[str, ...] = ()
    """Names of the network's inputs, in order."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._named("kind", MAGNETOMETER_KINDS)
        self._above_zero("rate_hz")
        self._not_negative("noise_density_nt", "flicker_corner_hz", "resolution_nt", "bandwidth_hz")
        self._not_negative("gradient_max_nt_m", "gradient_relock_nt_m", "stuck_std_nt")
        self._not_negative("vector_noise_density_nt")
        self._within("dead_zone_axis", 0, math.pi / 2)
        self._within("dead_zone_plane", 0, math.pi / 2)
        self._within("dropout_share", 0, 1)
        low, high = self.gradient_relock_nt_m, self.gradient_max_nt_m
        self._require("gradient_relock_nt_m", low <= high, f"not be above gradient_max_nt_m {high!r}", low)
        self._require("vector_scale", min(self.vector_scale) > -1, "be above -1", self.vector_scale)

    @property
    def noise_std_nt(self) -> float:
        """Standard deviation of the white noise of one reading [nT]: density times sqrt(rate / 2)."""
        return self.noise_density_nt * math.sqrt(self.rate_hz / 2)


@dataclass(frozen=True, kw_only=True)
class ImuSpec(MountSpec):
    """An inertial unit with orientation, angular rates, and acceleration without gravity."""

    link: str = "imu_link"

    rate_hz: float = 62.0
    """Sample rate [Hz]."""

    latency_s: float = 0.008
    """Delay of a sample [s]."""

    jitter_s: float = 0.002
    """Mean additional delay of a sample, exponentially distributed [s]."""

    yaw_zero: float = 0.0
    """World heading at which its yaw is 0 [rad]: the heading at switch-on."""

    tilt: Vec2 = (-0.009, 0.0002)
    """Roll and pitch of the sensor on the robot [rad]."""

    level_error: Vec2 = (0.0048, -0.0036)
    """Roll and pitch of the floor, about axes that do not turn with the robot [rad]. Together with `tilt`, it
    reproduces published data: the mean orientation in x and y, and its rank correlations with the
    disturbance."""

    tilt_std: float = 0.0095
    """Standard deviation of the roll and pitch that wander because of floor and casters [rad]."""

    tilt_time_s: float = 20.0
    """Correlation time of the wandering tilt [s]."""

    orientation_noise_std: float = 0.001
    """Standard deviation of each small angle of the orientation [rad]."""

    gyro_noise_std: float = 0.002
    """Standard deviation of a rate sample of each axis at rest [rad/s]."""

    gyro_bias: Vec3 = ZERO3
    """Bias of the rates at the start of a run [rad/s]."""

    gyro_bias_walk: float = 2e-5
    """Random walk of the bias: its standard deviation after 1 s [rad/s]."""

    gyro_vibration: Vec3 = (0.052, 0.16, 0.05)
    """Standard deviation of the rates by vibration, per m/s of speed [rad/m]."""

    accel_noise_std: float = 0.02
    """Standard deviation of an acceleration sample of each axis at rest [m/s2]."""

    accel_vibration: Vec3 = (1.7, 1.1, 4.1)
    """Standard deviation of the acceleration by vibration, per m/s of speed [1/s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("rate_hz")
        self._not_negative("latency_s", "jitter_s", "tilt_std", "tilt_time_s", "orientation_noise_std")
        self._not_negative("gyro_noise_std", "gyro_bias_walk", "gyro_vibration", "accel_noise_std")
        self._not_negative("accel_vibration")


@dataclass(frozen=True, kw_only=True)
class LidarSpec(MountSpec):
    """A spinning planar LiDAR. Its motor and current disturb the field while it is on."""

    link: str = "rplidar_link"

    scan_rate_hz: float = 7.5
    """Scan rate [Hz]."""

    rays: int = 720
    """Rays of a scan, evenly spaced over a full turn."""

    range_min_m: float = 0.15
    """Smallest range [m]."""

    range_max_m: float = 12.0
    """Largest range [m]."""

    range_noise_std_m: float = 0.01
    """Standard deviation of a range [m]."""

    latency_s: float = 0.14
    """Delay of a scan [s]: one turn, and the processing after it."""

    jitter_s: float = 0.005
    """Mean additional delay of a scan, exponentially distributed [s]."""

    on_s: float = 20.0
    """Time on in each cycle; a cycle starts off [s]. 0 means always off."""

    off_s: float = 40.0
    """Time off in each cycle [s]. 0 means always on."""

    phase_s: float = 0.0
    """Time within a cycle at which a run starts [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("scan_rate_hz", "range_max_m")
        self._not_negative("range_min_m", "range_noise_std_m", "latency_s", "jitter_s")
        self._not_negative("on_s", "off_s", "phase_s")
        self._within("rays", 1, MOST_RAYS)
        low, high = self.range_min_m, self.range_max_m
        self._require("range_min_m", low < high, f"be below range_max_m {high!r}", low)


@dataclass(frozen=True, kw_only=True)
class BatterySpec(Spec):
    """A battery and its loads; see `magtwin.sim.sensors.battery.Battery`."""

    model: Literal["power", "linear"] = "power"
    """"power": electronics, LiDAR and motors discharge it, and its voltage sags; "linear": the voltage falls
    linearly."""

    capacity_wh: float = 26.0
    """Energy of a full pack [Wh]."""

    load_w: float = 15.0
    """Power of the electronics [W]; in the linear model, the total power."""

    lidar_w: float = 2.3
    """Power of the LiDAR while it is on [W]."""

    drag_n: float = 2.0
    """Rolling resistance [N]."""

    mass_kg: float = 3.945
    """Mass that its wheels accelerate [kg]."""

    motor_efficiency: float = 0.4
    """Mechanical power of the wheels over electrical power of the motors, above 0, at most 1."""

    initial_fraction: float = 1.0
    """State of charge at the start of a run, 0 to 1."""

    voltage_empty_v: float = 12.44
    """Voltage at charge 0 without load [V]."""

    voltage_full_v: float = 16.24
    """Voltage at charge 1 without load [V]."""

    discharge: tuple[float, ...] = (0.0, 0.28, 0.4, 0.47, 0.52, 0.57, 0.63, 0.71, 0.8, 0.9, 1.0)
    """Voltage at evenly spaced charges from 0 to 1, scaled so that empty is 0 and full is 1."""

    resistance_ohm: float = 0.12
    """Internal resistance [ohm]."""

    voltage_noise_std_v: float = 0.02
    """Standard deviation of a voltage sample [V]."""

    rate_hz: float = 0.5
    """Sample rate [Hz]."""

    latency_s: float = 0.05
    """Delay of a sample [s]."""

    jitter_s: float = 0.01
    """Mean additional delay of a sample, exponentially distributed [s]."""

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
    """Motion capture of a robot."""

    rate_hz: float = 120.0
    """Pose rate [Hz]."""

    latency_s: float = 0.01
    """Delay of a pose [s]."""

    jitter_s: float = 0.001
    """Mean additional delay of a pose, exponentially distributed [s]."""

    p_noise_std_m: float = 0.0005
    """Standard deviation of a position along each axis [m]."""

    angle_noise_std: float = 0.003
    """Standard deviation of each small angle of an orientation [rad]."""

    dropout_every_s: float = 60.0
    """Mean time between dropouts [s]; 0 disables them."""

    dropout_s: float = 0.2
    """Mean duration of a dropout [s]; 0 disables them."""

    offset_m: tuple[float, float] = (0.0, 0.0)
    """Forward and left offset of base_link from the measured point [m]: markers are attached by hand."""

    offset_drift_m: tuple[float, float] = (0.0, 0.0)
    """Change of `offset_m` since the survey [m]: the markers were attached again."""

    latency_drift_s: float = 0.0
    """Change of `latency_s` since the survey [s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("rate_hz")
        what = f"not make the latency of {self.latency_s} s negative"
        drift = self.latency_drift_s
        self._require("latency_drift_s", self.latency_s + drift >= 0, what, drift)
        self._not_negative("latency_s", "jitter_s", "p_noise_std_m", "angle_noise_std")
        self._not_negative("dropout_every_s", "dropout_s")
