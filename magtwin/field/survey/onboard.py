"""On-board signals: what the motors, the battery, the LiDAR and the wheels of a robot do while it drives.

Each adds a field at the magnetometer that is fixed in the robot's axes and in proportion to its signal. A
signal is 0 where the robot stands with its LiDAR off, as in a survey at rest.
"""

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Standard deviation of the field of each signal per axis, at 1 of the signal [nT], for robots of some
# decimetres with their magnetometer on a mast
FIELDS_NT: Mapping[str, float] = {
    "lidar": 1000.0,  # On or off
    "current": 1500.0,  # Battery current above that at rest [A]
    "friction": 300.0,  # Direction in which a wheel turns, -1 to 1: its motor works against friction
    "rate": 30.0,  # Rate of a wheel [rad/s]
    "acceleration": 30.0,  # Its acceleration [rad/s^2]
    "cos": 100.0,  # Iron that turns with a wheel
    "sin": 100.0,
}
# Signals without which a map of one drive has an unknown offset, and the columns of a Run that tell them
NEEDED = {"friction": "wheel_angle", "lidar": "lidar_on", "current": "battery_a"}
CREEP = 0.05  # Rate of a wheel below which its friction falls in proportion [rad/s]
SMOOTH_S = 0.2  # Time over which the rates of wheels are measured [s]


def lacking(names: Collection[str]) -> list[str]:
    """What a drive does not tell of the robot's fields, from the names of its signals."""
    kinds = {name.split()[0] for name in names}
    return [text for kind, text in NEEDED.items() if kind not in kinds]


def prior_sd_nt(names: tuple[str, ...]) -> Array:
    """Standard deviation of the field of signals per axis [nT], shape (K,), by their names "kind side"."""
    return np.array([FIELDS_NT.get(name.split()[0], 100.0) for name in names])


def signals_of(t: Array, columns: Mapping[str, Array]) -> tuple[Array, tuple[str, ...]]:
    """The signals of a drive, shape (N, K), and their names.

    Args:
        t: Times [s], ascending, shape (N,).
        columns: Columns of a Run by name: `wheel_angle`, `lidar_on`, `battery_a`, `battery_v`,
            `battery_fraction`; those that are known.
    """
    signals = dict[str, Array]()
    if (angles := columns.get("wheel_angle")) is not None:
        ends = np.clip(t + SMOOTH_S / 2 * np.array([[-1], [1]]), t[0], t[-1])
        for side, angle in zip(("left", "right"), angles.T, strict=True):
            rate = np.diff(np.interp(ends, t, angle), axis=0)[0] / np.diff(ends, axis=0)[0]
            signals[f"friction {side}"] = np.clip(rate / CREEP, -1, 1)
            signals[f"rate {side}"] = rate
            signals[f"acceleration {side}"] = np.gradient(rate, t)
            signals[f"cos {side}"], signals[f"sin {side}"] = np.cos(angle), np.sin(angle)
    if "lidar_on" in columns:
        signals["lidar"] = columns["lidar_on"]
    if "battery_a" in columns:
        signals["current"] = _current(columns, signals)
    return np.column_stack(list(signals.values())), tuple(signals)


def _current(columns: Mapping[str, Array], signals: Mapping[str, Array]) -> Array:
    """Battery current above that at rest with a full pack [A], shape (N,).

    A battery reports its current rarely. The power U I = p_0 + p_1 on + p_2 (|w_l| + |w_r|) with the LiDAR's
    state and the wheels' rates, and the voltage U = u_0 + u_1 f with the charge f, are known at all times.
    """
    current = columns["battery_a"]
    one, work = np.ones(len(current)), [np.abs(s) for name, s in signals.items() if name.startswith("rate")]
    uses = [one, *([signals["lidar"]] if "lidar" in signals else []), *([sum(work)] if work else [])]
    charge = np.column_stack([one, columns.get("battery_fraction", one)])
    volts = columns.get("battery_v", one)
    volt = np.linalg.lstsq(charge, volts, rcond=None)[0]
    power = np.linalg.lstsq(np.column_stack(uses), volts * current, rcond=None)[0]
    return np.asarray(np.column_stack(uses) @ power / (charge @ volt) - power[0] / volt.sum())
