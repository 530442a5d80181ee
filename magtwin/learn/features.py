"""Features: what a neural magnetometer reads from a Run, by name, in the units it was trained on."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.names import RefusedError, find
from magtwin.run import COLUMNS, Run

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Feature:
    """One input of a network: a number of a column of a Run, and how its unit is changed."""

    column: str
    """Column of the Run it is taken from."""

    index: int | None
    """Which number of each row of that column; None where the column holds one."""

    unit: str
    """Unit in which the network reads it, "" for numbers without one."""

    convert: Callable[[NDArray[Any]], NDArray[Any]] | None = None
    """From the column, (N,) or (N, width), to what the network reads, same shape; None changes nothing."""


def degrees_0_360(yaw: NDArray[Any]) -> Array:
    """Headings [rad] as degrees in [0, 360), any shape."""
    deg = np.degrees(yaw) % 360.0
    return np.where(deg >= 360.0, 0.0, deg)  # -1e-17 % 360 is 360


def _canonical(q: NDArray[Any]) -> Array:
    """Quaternions (N, 4) with w >= 0; a factor of +-1, three times as fast as choosing whole rows."""
    return q * np.where(q[:, 3:] < 0, -1.0, 1.0)


def _vector(
    prefix: str, column: str, convert: Callable[[NDArray[Any]], NDArray[Any]] | None = None
) -> dict[str, Feature]:
    """A feature for each number of a vector column: `prefix` and the name of its part."""
    spec = COLUMNS[column]
    return {f"{prefix}_{part}": Feature(column, i, spec.unit, convert) for i, part in enumerate(spec.parts)}


FEATURES: Mapping[str, Feature] = MappingProxyType(
    {
        "yaw_deg": Feature("yaw", None, "deg", degrees_0_360),
        **_vector("odom_v", "odom_v"),
        **_vector("odom_w", "odom_w"),
        **_vector("imu_q", "imu_q_xyzw", _canonical),
        **_vector("imu_w", "imu_w"),
        **_vector("imu_a", "imu_a"),
        "battery_v": Feature("battery_v", None, "V"),
        "battery_fraction": Feature("battery_fraction", None, ""),
        "lidar_on": Feature("lidar_on", None, "0 or 1"),
    }
)
"""Every feature by name."""

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

SETS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "full": FULL,
        "correlated": ("yaw_deg", "odom_v_x", "imu_q_x", "imu_q_y", "imu_q_z", "imu_q_w"),
    }
)
"""Features by the name of a set. "correlated" holds those whose Spearman correlation with the
disturbance exceeds 0.04 in the paper's Figure 2."""


def feature_names(names: str | Sequence[str]) -> tuple[str, ...]:
    """The features of a named set, or the names given, each known and none twice.

    Raises:
        RefusedError: An unknown set or feature (the text names the near one), or one named twice.
    """
    if isinstance(names, str):
        return find("feature set", names, SETS)
    for name in names:
        find("feature", name, FEATURES)
    if len(set(names)) < len(names):
        twice = next(name for name in names if list(names).count(name) > 1)
        raise RefusedError(f"feature {twice!r} is named twice; name each input once")
    return tuple(names)


def features(run: Run, names: str | Sequence[str] = "full") -> Array:
    """Inputs of a network for each reading of a run.

    Args:
        run: Needs the columns that the features are taken from.
        names: A set ("full", "correlated") or names of features, in the order of the network's inputs.

    Returns:
        Features in the units of `FEATURES`, shape (N, F), rows contiguous.

    Raises:
        RefusedError: An unknown feature or set, or a column that the run lacks.
    """
    names = feature_names(names)
    x = np.empty((run.rows, len(names)))
    converted: dict[str, NDArray[Any]] = {}  # a quaternion is made canonical once, not four times
    for i, name in enumerate(names):
        feature = FEATURES[name]
        if feature.column not in converted:
            column = run[feature.column]
            converted[feature.column] = feature.convert(column) if feature.convert else column
        values = converted[feature.column]
        x[:, i] = values if feature.index is None else values[:, feature.index]
    return x
