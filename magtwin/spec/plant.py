"""Effects of a robot on its magnetometer beyond the linear platform field, and their spread over sessions."""

from dataclasses import dataclass

from magtwin.spec.base import ZERO3, ZERO9, Matrix3, Spec, Vec3


@dataclass(frozen=True, kw_only=True)
class PlantSpec(Spec):
    """What the linear platform field leaves out: hysteresis, warm-up, nonlinear currents, a moving part.

    Vectors are in base_link axes. `magtwin.sim.plant` has the equations. The default has no effect. Surveys
    leave the plant out.
    """

    hysteresis: Matrix3 = ZERO9
    """Hysteretic part of the soft iron, by rows [nT per nT]; it multiplies the weighted sum of play
    operators."""

    play_thresholds_nt: tuple[float, ...] = ()
    """Threshold of each play operator: half of the width of its loop [nT]."""

    play_weights: tuple[float, ...] = ()
    """Weight of each play operator."""

    start_field_nt: Vec3 = ZERO3
    """Field to which the demagnetised iron was exposed before the run [nT]. Default: none."""

    start_field_std_nt: float = 0.0
    """Standard deviation of each component of `start_field_nt` between sessions [nT]: robots are carried."""

    warm_up_s: tuple[float, ...] = ()
    """Time constants of the warm-up [s]."""

    warm_up_nt: tuple[float, ...] = ()
    """Change of the permanent field when warm, three components per time constant [nT]."""

    warm_up_soft_iron: tuple[float, ...] = ()
    """Change of the field when warm relative to the ambient field, one per time constant [nT per nT]: of the
    iron's permeability, and of the sensor's scale."""

    warm_up_age_s: float = 0.0
    """Time between switching on and the start of a run [s]."""

    warm_up_age_mean_s: float = 0.0
    """Mean of a further such time, exponentially distributed over sessions [s]."""

    motor_abs_nt_nm: Vec3 = ZERO3
    """Field per N m of |torque|, summed over both wheels [nT/(N m)]: supply current has one sign."""

    motor_square_nt_nm2: Vec3 = ZERO3
    """Field per squared torque, summed over both wheels [nT/(N m)^2]: current of resistive losses."""

    lidar_speed_nt_s_m: Vec3 = ZERO3
    """Field per m/s of speed while the LiDAR is on [nT s/m]."""

    lidar_supply_nt_a: Vec3 = ZERO3
    """Field per ampere of supply current above that at rest while the LiDAR is on [nT/A]."""

    moving_moment: Vec3 = ZERO3
    """Magnetic moment of a part that pans about base_link's z, at the pan angle 0 [A m2]."""

    p_magnetometer_moving: Vec3 = ZERO3
    """Pan axis of that part relative to the magnetometer, in base_link axes [m]."""

    moving_arm_m: float = 0.0
    """Distance of the moment from its pan axis, forwards at the pan angle 0 [m]."""

    pan_range: float = 0.0
    """Greatest pan angle to either side [rad]."""

    pan_period_s: float = 60.0
    """Duration of a pan to one side, to the other and back [s]."""

    pan_dwell: float = 0.0
    """Share of the time that the part rests at its greatest angles, from 0 to below 1."""

    pan_phase: float = 0.0
    """Share of a period that is over at the start of a run; drawn if a session is drawn."""

    session_std: float = 0.0
    """Relative standard deviation between sessions of warm-up, nonlinear terms and the moving moment."""

    hard_iron_std_nt: float = 0.0
    """Standard deviation of each component of the permanent field between sessions [nT], beside
    `PlatformFieldSpec.hard_iron_std_nt`."""

    current_direction_std: float = 0.0
    """Standard deviation between sessions of each small rotation of the fields of motors, LiDAR and battery
    [rad]: wires move."""

    marker_offset_std_m: float = 0.0
    """Standard deviation between sessions of each component of motion capture's `offset_m` [m]."""

    mocap_latency_std_s: float = 0.0
    """Standard deviation between sessions of the latency of motion capture [s]; it stays at least 0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._count("play_weights", "play_thresholds_nt", 1)
        self._count("warm_up_nt", "warm_up_s", 3)
        self._count("warm_up_soft_iron", "warm_up_s", 1)
        if self.play_thresholds_nt:
            self._not_negative("play_thresholds_nt")
        if self.warm_up_s:
            self._above_zero("warm_up_s")
        self._above_zero("pan_period_s")
        self._require("pan_dwell", 0 <= self.pan_dwell < 1, "lie from 0 to below 1", self.pan_dwell)
        self._not_negative(
            *("start_field_std_nt", "warm_up_age_s", "warm_up_age_mean_s", "moving_arm_m", "pan_range"),
            *("session_std", "hard_iron_std_nt", "current_direction_std", "marker_offset_std_m"),
            "mocap_latency_std_s",
        )
        if any(self.moving_moment):
            x, y, z = self.p_magnetometer_moving
            apart = (abs((x * x + y * y) ** 0.5 - self.moving_arm_m) ** 2 + z * z) ** 0.5
            what = "keep the moving part more than 1 mm from the magnetometer"
            self._require("p_magnetometer_moving", apart > 1e-3, what, self.p_magnetometer_moving)

    def _count(self, name: str, like: str, per: int) -> None:
        """Require `per` numbers in the field `name` for each number in the field `like`."""
        seen, wanted = len(getattr(self, name)), per * len(getattr(self, like))
        self._require(name, seen == wanted, f"have {wanted} numbers, as `{like}` has {wanted // per}", seen)
