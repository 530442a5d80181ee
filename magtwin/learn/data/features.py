"""Features: the inputs of neural magnetometers, by name, computed from the columns of a Run."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, find
from magtwin.run.run import COLUMNS, Run

Array = NDArray[np.float64]


Convert = Callable[..., NDArray[Any]]

WARM_S = (100.0, 400.0)
"""Time constants of `warming` [s]."""


@dataclass(frozen=True)
class Feature:
    """One input of a network: a number computed from columns of a Run."""

    columns: tuple[str, ...]
    """Columns of the Run."""

    index: int | None
    """Index into the result of the conversion; None if that is one number per row."""

    unit: str
    """Unit of the input, "" if it has none."""

    convert: Convert | None = None
    """From the columns, each (N,) or (N, width), to inputs, (N,) or (N, width'); no row depends on another.
    None takes the one column as it is."""

    session_sd_nt: float = 0.0
    """Least standard deviation of its effect between sessions, in a mixed model [nT per unit]: parts that
    differ more between robots of one type than training sessions show."""


def degrees_0_360(yaw: NDArray[Any]) -> Array:
    """Headings [rad] as degrees in [0, 360), any shape."""
    deg = np.degrees(yaw) % 360.0
    return np.where(deg >= 360.0, 0.0, deg)  # -1e-17 % 360 is 360


def circle(yaw: NDArray[Any]) -> Array:
    """Sin and cos of headings [rad], shape (N,), and of twice the headings, shape (N, 4).

    The field of hard iron varies with the heading, that of soft iron with twice the heading.
    """
    return np.column_stack([np.sin(yaw), np.cos(yaw), np.sin(2 * yaw), np.cos(2 * yaw)])


def carried(gradient_nt_m: NDArray[Any], odom_v: NDArray[Any]) -> Array:
    """Gradients forward and to the left [nT/m], (N, 2), times the forward speed [m/s] of (N, 3): [nT/s].

    A reading that is late by tau errs by tau times this; a lever arm l errs by l times the gradient.
    """
    return gradient_nt_m * odom_v[:, :1]


def lags(v_cmd: NDArray[Any], w_cmd: NDArray[Any], odom_v: NDArray[Any], odom_w: NDArray[Any]) -> Array:
    """Commanded minus driven speed [m/s] and turning [rad/s], shape (N, 2).

    The motors' torque, and so their current, follows it while the robot changes speed.
    """
    return np.column_stack([v_cmd - odom_v[:, 0], w_cmd - odom_w[:, 2]])


def turned(yaw: NDArray[Any], *signals: NDArray[Any]) -> Array:
    """Signals (N,) or (N, width) times sin and cos of the heading, shape (N, 2 x their numbers).

    A current's field is fixed to the robot, relative to which the Earth's field turns. The magnitude changes
    by the part along the Earth's field.
    """
    each = np.column_stack(signals)
    return np.column_stack([w * s for s in each.T for w in (np.sin(yaw), np.cos(yaw))])


def turned_motion(yaw: NDArray[Any], odom_v: NDArray[Any], odom_w: NDArray[Any]) -> Array:
    """Speed and turning, signed and by size, times sin and cos of the heading, shape (N, 6)."""
    return turned(yaw, odom_v[:, 0], odom_w[:, 2], np.abs(odom_w[:, 2]))


def turned_lags(
    yaw: NDArray[Any], v_cmd: NDArray[Any], w_cmd: NDArray[Any], odom_v: NDArray[Any], odom_w: NDArray[Any]
) -> Array:
    """`lags` times sin and cos of the heading, shape (N, 4)."""
    return turned(yaw, lags(v_cmd, w_cmd, odom_v, odom_w))


def turning_size(odom_w: NDArray[Any]) -> Array:
    """Size of the turning rate [rad/s], shape (N,), which friction depends on."""
    return np.abs(odom_w[:, 2])


def direction_cosines(b_vector_nt: NDArray[Any]) -> Array:
    """Unit vectors along fields, shape (N, 3); nan for a field of 0.

    The size is left out on purpose: it is the field that is to be predicted.
    """
    size = np.linalg.norm(b_vector_nt, axis=1, keepdims=True)
    return np.divide(b_vector_nt, size, out=np.full(b_vector_nt.shape, np.nan), where=size > 0)


def induced_products(b_vector_nt: NDArray[Any]) -> Array:
    """Products of direction cosines xx, xy, xz, yy, yz, shape (N, 5); zz is 1 less xx and yy.

    Tolles and Lawson's induced terms (Leliak 1961), without the field's size.
    """
    x, y, z = direction_cosines(b_vector_nt).T
    return np.column_stack([x * x, x * y, x * z, y * y, y * z])


def eddy_products(b_vector_nt: NDArray[Any], imu_w: NDArray[Any]) -> Array:
    """Products u_i du_j/dt of direction cosines and their rates [1/s], j = x, y of i = x, y, z: (N, 6).

    Tolles and Lawson's eddy terms (Leliak 1961). In a constant field a turning body sees du/dt = -w x u, so
    the gyroscope gives the rates without neighbouring rows; on a floor that of z is about 0.
    """
    u = direction_cosines(b_vector_nt)
    rate = -np.cross(imu_w, u)
    return np.column_stack([u[:, i] * rate[:, j] for i in range(3) for j in range(2)])


def warming(t: NDArray[Any], yaw: NDArray[Any]) -> Array:
    """1 - exp(-t / tau) times 1, cos and sin of the heading, for each tau of `WARM_S`, shape (N, 6).

    The field of parts that warm up after switching on, t = 0: iron and magnets fixed to the robot.
    """
    ways = (np.ones_like(yaw), np.cos(yaw), np.sin(yaw))
    return np.column_stack([-np.expm1(-t / tau) * way for tau in WARM_S for way in ways])


def wheels(yaw: NDArray[Any], wheel_angle: NDArray[Any]) -> Array:
    """Cos and sin of the angles of both wheels, (N, 2), times 1, cos and sin of the heading, shape (N, 12).

    The field of magnetised wheels turns with them, in a plane that is fixed to the robot.
    """
    turning = np.column_stack([np.cos(wheel_angle), np.sin(wheel_angle)])
    ways = (np.ones_like(yaw), np.cos(yaw), np.sin(yaw))
    return np.column_stack([turning * way[:, None] for way in ways])


def _canonical(q: NDArray[Any]) -> Array:
    """Quaternions (N, 4) with w >= 0."""
    return q * np.where(q[:, 3:] < 0, -1.0, 1.0)


def _vector(prefix: str, column: str, convert: Convert | None = None) -> dict[str, Feature]:
    """A feature for each part of a vector column."""
    spec = COLUMNS[column]
    return _named({f"{prefix}_{part}": spec.unit for part in spec.parts}, convert, column)


def _named(units: Mapping[str, str], convert: Convert | None, *columns: str) -> dict[str, Feature]:
    """A feature for each number that `convert` computes."""
    return {name: Feature(columns, i, unit, convert) for i, (name, unit) in enumerate(units.items())}


_B = "b_vector_measured_nt"
CIRCLE = ("yaw_sin", "yaw_cos", "yaw_sin_2", "yaw_cos_2")
GRADIENT = ("map_gradient_forward", "map_gradient_left")
CARRIED = ("speed_map_gradient_forward", "speed_map_gradient_left")
COSINES = ("cosine_x", "cosine_y", "cosine_z")
INDUCED = ("induced_xx", "induced_xy", "induced_xz", "induced_yy", "induced_yz")
LAGS = ("lag_v", "lag_w")
TURNED = tuple(f"{signal}_yaw_{part}" for signal in ("lidar_on", "battery_a") for part in ("sin", "cos"))
TURNED_MOTION = tuple(
    f"{signal}_yaw_{part}" for signal in ("odom_v_x", "odom_w_z", "turning") for part in ("sin", "cos")
)
TURNED_LAGS = tuple(f"{signal}_yaw_{part}" for signal in LAGS for part in ("sin", "cos"))
WARM = tuple(f"warm_{tau:.0f}{way}" for tau in WARM_S for way in ("", "_yaw_cos", "_yaw_sin"))
WHEELS = {
    f"wheel_{side}_{part}{way}": sd_nt
    for way, sd_nt in (("", 150.0), ("_yaw_cos", 80.0), ("_yaw_sin", 80.0))
    for part in ("cos", "sin")
    for side in ("left", "right")
}
"""Features of the wheels' angles, and what wheels as found on robots add [nT]."""
EDDY = ("eddy_xdx", "eddy_xdy", "eddy_ydx", "eddy_ydy", "eddy_zdx", "eddy_zdy")

FEATURES: Mapping[str, Feature] = MappingProxyType(
    {
        "yaw_deg": Feature(("yaw",), None, "deg", degrees_0_360),
        **_vector("odom_v", "odom_v"),
        **_vector("odom_w", "odom_w"),
        **_vector("imu_q", "imu_q_xyzw", _canonical),
        **_vector("imu_w", "imu_w"),
        **_vector("imu_a", "imu_a"),
        "battery_v": Feature(("battery_v",), None, "V"),
        "battery_fraction": Feature(("battery_fraction",), None, ""),
        "lidar_on": Feature(("lidar_on",), None, "0 or 1"),
        **_named(dict.fromkeys(CIRCLE, ""), circle, "yaw"),
        "battery_a": Feature(("battery_a",), None, "A"),
        **_named(dict.fromkeys(GRADIENT, "nT/m"), None, "b_map_gradient_nt_m"),
        **_named(dict.fromkeys(CARRIED, "nT/s"), carried, "b_map_gradient_nt_m", "odom_v"),
        **_named({"lag_v": "m/s", "lag_w": "rad/s"}, lags, "v_cmd", "w_cmd", "odom_v", "odom_w"),
        "turning": Feature(("odom_w",), None, "rad/s", turning_size),
        **_named(
            dict(zip(TURNED, ("0 or 1", "0 or 1", "A", "A"), strict=True)),
            turned,
            "yaw",
            "lidar_on",
            "battery_a",
        ),
        **_named(
            dict(zip(TURNED_MOTION, ("m/s",) * 2 + ("rad/s",) * 4, strict=True)),
            turned_motion,
            *("yaw", "odom_v", "odom_w"),
        ),
        **_named(
            dict(zip(TURNED_LAGS, ("m/s",) * 2 + ("rad/s",) * 2, strict=True)),
            turned_lags,
            *("yaw", "v_cmd", "w_cmd", "odom_v", "odom_w"),
        ),
        **_named(dict.fromkeys(COSINES, ""), direction_cosines, _B),
        **_named(dict.fromkeys(INDUCED, ""), induced_products, _B),
        **_named(dict.fromkeys(EDDY, "1/s"), eddy_products, _B, "imu_w"),
        **_named(dict.fromkeys(WARM, ""), warming, "t", "yaw"),
        **{
            name: Feature(("yaw", "wheel_angle"), i, "", wheels, sd_nt)
            for i, (name, sd_nt) in enumerate(WHEELS.items())
        },
    }
)
"""Every feature by name. Weights keep the names, so their meaning never changes."""

FULL: tuple[str, ...] = (
    "yaw_deg",
    *("odom_v_x", "odom_v_y", "odom_v_z"),
    *("odom_w_x", "odom_w_y", "odom_w_z"),
    *("imu_q_x", "imu_q_y", "imu_q_z", "imu_q_w"),
    *("imu_w_x", "imu_w_y", "imu_w_z"),
    *("imu_a_x", "imu_a_y", "imu_a_z"),
    *("battery_v", "battery_fraction", "lidar_on"),
)
"""The 20 inputs of the paper's network, in its order: true heading, odometry's linear and angular
velocity, IMU's orientation, rates and acceleration, battery voltage and charge, LiDAR on or off."""

CIRCULAR: tuple[str, ...] = (
    *CIRCLE,
    *("odom_v_x", "odom_w_z"),
    *("imu_w_x", "imu_w_y", "imu_w_z"),
    *("imu_a_x", "imu_a_y", "imu_a_z"),
    *("battery_a", "lidar_on"),
)
"""What a robot's field depends on, without inputs that identify a session: no charge or voltage, and no
orientation relative to the IMU's own zero."""

PLATFORM: tuple[str, ...] = (
    *(*CIRCULAR, *GRADIENT, *CARRIED, *LAGS),
    *("turning", *TURNED, *TURNED_MOTION, *TURNED_LAGS),
)
"""`CIRCULAR`, the map's gradient, and currents, torques and the LiDAR by heading."""

SETS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "full": FULL,
        "correlated": ("yaw_deg", "odom_v_x", "imu_q_x", "imu_q_y", "imu_q_z", "imu_q_w"),
        "circular": CIRCULAR,
        "gradient": (*CIRCULAR, *GRADIENT, *CARRIED),
        "platform": PLATFORM,
        "session": (*PLATFORM, *WARM),
        "wheels": (*PLATFORM, *WARM, *WHEELS),
        "vector": (*CIRCULAR, *GRADIENT, *CARRIED, *COSINES, *INDUCED, *EDDY),
    }
)
"""Sets of features by name. "correlated": those with a Spearman correlation with the disturbance above 0.04
in the paper's Figure 2. "gradient": "circular" and the map's gradient, for a lever arm and a latency.
"platform": also currents, torques and the LiDAR by heading. "session": also parts that warm up after
switching on. "wheels": also magnetised wheels, by their angles. "vector": "gradient" and the platform's
attitude in the field, from the vector axes."""


def feature_names(names: str | Sequence[str]) -> tuple[str, ...]:
    """The features of a set, or the given names, checked.

    Args:
        names: A name of `SETS`, features separated by commas, or a sequence of features.

    Raises:
        InputError: An unknown set or feature (the nearest one is named), or one named twice.
    """
    if isinstance(names, str):
        if "," not in names and names not in FEATURES:
            return find("feature set", names, SETS)
        names = [name.strip() for name in names.split(",") if name.strip()]
    for name in names:
        find("feature", name, FEATURES)
    if len(set(names)) < len(names):
        twice = next(name for name in names if list(names).count(name) > 1)
        raise InputError(f"feature {twice!r} is named twice; name each input once")
    return tuple(names)


def features(run: Run, names: str | Sequence[str] = "full") -> Array:
    """Inputs of a network for each reading of a run.

    Args:
        run: Needs the columns of the features.
        names: A set of `SETS` or names of features, in the order of the network's inputs.

    Returns:
        Features in the units of `FEATURES`, shape (N, F), rows contiguous.

    Raises:
        InputError: An unknown feature or set, or a column that the run lacks.
    """
    names = feature_names(names)
    x = np.empty((run.rows, len(names)))
    made: dict[tuple[Any, ...], NDArray[Any]] = {}  # results of conversions that several features share
    for i, name in enumerate(names):
        feature = FEATURES[name]
        key = (feature.convert, feature.columns)
        if key not in made:
            columns = [run[column] for column in feature.columns]
            made[key] = feature.convert(*columns) if feature.convert else columns[0]
        values = made[key]
        x[:, i] = values if feature.index is None else values[:, feature.index]
    return x


def columns_of(names: str | Sequence[str]) -> tuple[str, ...]:
    """Columns of a Run that features need, each once; `names` as for `features`.

    Raises:
        InputError: An unknown feature or set.
    """
    return tuple(dict.fromkeys(c for name in feature_names(names) for c in FEATURES[name].columns))
