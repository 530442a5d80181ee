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
NEEDED = {"friction": "wheel_angle", "lidar": "lidar_on (at times off)", "current": "battery_a"}
COLUMNS = ("wheel_angle", "lidar_on", "battery_a", "battery_v", "battery_fraction")  # Of a Run, for signals
CREEP = 0.05  # Rate of a wheel below which its friction falls in proportion [rad/s]
LEAST_REPORTS = 10  # Fewest reports of a battery that are fitted without the rows that hold them
SMOOTH_S = 0.2  # Time over which rates and accelerations of wheels are measured [s]


def lacking(names: Collection[str]) -> list[str]:
    """What a drive does not tell of the robot's fields, from the names of its signals."""
    kinds = {name.split()[0] for name in names}
    return [text for kind, text in NEEDED.items() if kind not in kinds]


def prior_sd_nt(names: tuple[str, ...]) -> Array:
    """Standard deviation of the field of signals per axis [nT], shape (K,), by their names "kind side"."""
    return np.array([FIELDS_NT.get(name.split()[0], 100.0) for name in names])


def signals_of(t: Array, columns: Mapping[str, Array]) -> tuple[Array | None, tuple[str, ...]]:
    """Signals (N, K) of a drive at times (N,) [s], and their names, from those of `COLUMNS` that it has."""
    if not columns or len(t) < 2 or np.any(np.diff(t) <= 0):
        return None, ()
    signals = dict[str, Array]()
    ends = np.clip(t + SMOOTH_S / 2 * np.array([[-1], [1]]), t[0], t[-1])

    def slope(values: Array) -> Array:
        return np.asarray(np.diff(np.interp(ends, t, values), axis=0)[0] / np.diff(ends, axis=0)[0])

    if (angles := columns.get("wheel_angle")) is not None:
        for side, angle in zip(("left", "right"), angles.T, strict=True):
            rate = slope(angle)
            signals[f"friction {side}"] = np.clip(rate / CREEP, -1, 1)
            signals[f"rate {side}"] = rate
            signals[f"acceleration {side}"] = slope(rate)
            signals[f"cos {side}"], signals[f"sin {side}"] = np.cos(angle), np.sin(angle)
    if "lidar_on" in columns and not columns["lidar_on"].all():  # always on, it is like hard iron
        signals["lidar"] = columns["lidar_on"]
    if "battery_a" in columns:
        signals["current"] = _current(columns, signals)
    return np.column_stack([*signals.values()]) if signals else None, tuple(signals)


def _current(columns: Mapping[str, Array], signals: Mapping[str, Array]) -> Array:
    """Battery current above that at rest with a full pack [A], shape (N,).

    A battery reports its current rarely. The power U I = p_0 + p_1 on + p_2 (|w_l| + |w_r|) with the LiDAR's
    state and the wheels' rates, and the voltage U = u_0 + u_1 f with the charge f, are known at all times.
    """
    one, volts = np.ones(len(columns["battery_a"])), columns.get("battery_v", np.zeros(1))
    volts = volts if volts.min() > 0 else one
    work = [np.abs(signal) for name, signal in signals.items() if name.startswith("rate")]
    uses = np.column_stack([one, signals.get("lidar", 0 * one), sum(work, 0 * one)])
    charge = np.column_stack([one, columns.get("battery_fraction", one)])
    volt = np.linalg.lstsq(charge, volts, rcond=None)[0]
    new = np.append(True, np.diff(columns["battery_a"]) != 0)  # what is held lags behind the LiDAR and wheels
    new |= np.count_nonzero(new) < LEAST_REPORTS
    power = np.linalg.lstsq(uses[new], (volts * columns["battery_a"])[new], rcond=None)[0]
    return np.asarray(uses @ power / (charge @ volt) - power[0] / max(volt.sum(), volts.min()))
