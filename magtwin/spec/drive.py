"""The differential drive of a robot."""

from dataclasses import dataclass, field

from magtwin.spec.base import LATER, Spec, Vec2, Vec3

DRAWN = ("wheel_radius_error_std", "wheel_separation_error_std", "odometry_noise_std")
"""Spreads from which a run draws; 0 in a session, which has drawn."""


@dataclass(frozen=True, kw_only=True)
class DriveSpec(Spec):
    """A differential drive: dimensions, limits and odometry.

    It stands for every drive that moves along its heading: skid steering with an effective separation, four
    mecanum wheels without sideways motion, and with `turning_radius_m` a car about its rear axle.
    """

    left_wheel_joint: str = "left_wheel_joint"
    """Name of the left wheel's joint."""

    right_wheel_joint: str = "right_wheel_joint"
    """Name of the right wheel's joint."""

    more_left_wheel_joints: tuple[str, ...] = field(default=(), metadata={LATER: True})
    """Names of the joints of further wheels on the left, which turn as the left wheel does."""

    more_right_wheel_joints: tuple[str, ...] = field(default=(), metadata={LATER: True})
    """Names of the joints of further wheels on the right, which turn as the right wheel does."""

    wheel_separation_m: float = 0.233
    """Distance between the wheels' contact points [m]. Wheels that scrub, such as those of a skid-steered
    robot, have an effective separation that is larger: wheel speeds differ by it times the yaw rate."""

    turning_radius_m: float = field(default=0.0, metadata={LATER: True})
    """Smallest turning radius of a robot that steers like a car [m]; 0: it turns on the spot."""

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
    """Highest rate of a wheel [rad/s]. Default: that of a Create 3 at 0.46 m/s, its top speed with safety
    off."""

    motor_lag_s: float = 0.04
    """Time constant of the motors' first-order lag [s]; 0 disables it. Default: typical of small geared
    motors."""

    slip_s2_m: float = 0.011
    """Longitudinal slip of the wheels per m/s2 of acceleration [s2/m]. Default, an estimate: 1 % at 0.9
    m/s2."""

    yaw_slip: float = 0.01
    """Fraction of the yaw rate that is lost as the wheels scrub [1]; an estimate."""

    wheel_radius_error_std: float = 0.002
    """Relative standard deviation of the wheel radius, drawn once per run; an estimate."""

    wheel_separation_error_std: float = 0.003
    """Relative standard deviation of the wheel separation, drawn once per run; an estimate."""

    wheel_errors: Vec2 = (0.0, 0.0)
    """Relative error of radius and separation in all runs of the session, in addition to that of each run."""

    localization_std_m: float = 0.02
    """Standard deviation of the position that a path follower gets, on each axis [m]; 0 disables it. Default:
    that of a good indoor localization."""

    localization_yaw_std: float = 0.01
    """Standard deviation of the heading that a path follower gets [rad]; an estimate."""

    localization_time_s: float = 5.0
    """Correlation time of these errors [s]; an estimate."""

    localization_latency_s: float = 0.1
    """Age of the pose that a path follower gets [s], the delay of its commands included; an estimate."""

    command_timeout_s: float = 0.5
    """The robot stops if no command arrives for this time [s]."""

    odometry_rate_hz: float = 62.0
    """Odometry rate [Hz]."""

    odometry_latency_s: float = 0.012
    """Delay of an odometry sample [s]."""

    odometry_jitter_s: float = 0.003
    """Mean additional delay of a sample, exponentially distributed [s]."""

    odometry_scale: Vec2 = (1.0, 1.0)
    """Measured over true travel of the left and the right wheel."""

    odometry_noise_std: float = 0.002
    """Relative standard deviation of the wheels' scale, drawn once per run; it makes odometry drift."""

    odometry_v_noise_std: Vec3 = (0.003, 0.00275, 0.000135)
    """Standard deviation of the linear velocity's noise along each axis [m/s]."""

    odometry_w_noise_std: Vec3 = (0.011, 0.028, 0.01)
    """Standard deviation of the angular velocity's noise about each axis [rad/s]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("wheel_separation_m", "wheel_radius_m", "v_max", "w_max", "a_max", "alpha_max")
        self._above_zero("wheel_rate_max", "command_timeout_s", "odometry_rate_hz", "odometry_scale")
        self._above_zero("localization_time_s")
        self._not_negative("odometry_latency_s", "odometry_jitter_s", "odometry_noise_std")
        self._not_negative("odometry_v_noise_std", "odometry_w_noise_std", "motor_lag_s", "slip_s2_m")
        self._not_negative("wheel_radius_error_std", "wheel_separation_error_std")
        self._not_negative("localization_std_m", "localization_yaw_std", "localization_latency_s")
        self._require("yaw_slip", 0 <= self.yaw_slip < 1, "be at least 0 and below 1", self.yaw_slip)
        whole = f"be below 1 when multiplied by a_max {self.a_max!r}"
        self._require("slip_s2_m", self.slip_s2_m * self.a_max < 1, whole, self.slip_s2_m)
        self._require("wheel_errors", min(self.wheel_errors) > -1, "be above -1", self.wheel_errors)
        left, right = self.left_wheel_joint, self.right_wheel_joint
        self._require("right_wheel_joint", left != right, "differ from left_wheel_joint", right)
        names = [left, right, *self.more_left_wheel_joints, *self.more_right_wheel_joints]
        twice = [name for i, name in enumerate(names) if name in names[:i]]
        self._require("more_left_wheel_joints", not twice, "name each wheel once", twice)
        self._not_negative("turning_radius_m")

    @property
    def sides(self) -> dict[str, int]:
        """Side of each driven wheel by its joint: 0 for left, 1 for right. The first wheels come first."""
        left, right = self.left_wheel_joint, self.right_wheel_joint
        more = dict.fromkeys(self.more_left_wheel_joints, 0) | dict.fromkeys(self.more_right_wheel_joints, 1)
        return {left: 0, right: 1} | more
