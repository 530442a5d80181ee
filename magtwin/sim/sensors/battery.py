"""Battery: what drives the robot, its LiDAR and its electronics, and what that leaves in the pack."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.sim.motion.sampling import Columns, Moving, held
from magtwin.spec.drive import DriveSpec
from magtwin.spec.sensors import BatterySpec

Array = NDArray[np.float64]

SECONDS_PER_HOUR = 3600.0

STEP_S = 0.05
"""Length of the steps in which a pack is discharged [s]."""

_ROUNDS = 50
"""Most passes over a discharge; three or four make it exact."""


def open_voltage(spec: BatterySpec, fraction: ArrayLike) -> Array:
    """Voltage of a pack that rests at a charge from 0 to 1 [V]: along its discharge curve, no load on it."""
    curve = np.array(spec.discharge)
    share = np.interp(np.asarray(fraction, float), np.linspace(0.0, 1.0, len(curve)), curve)
    return spec.voltage_empty_v + (spec.voltage_full_v - spec.voltage_empty_v) * share


def current_a(spec: BatterySpec, power_w: ArrayLike, fraction: ArrayLike) -> Array:
    """Current of a pack that gives a power, through its inner resistance [A]: U I = (U_0 - R I) I = P.

    Of the two solutions the smaller, for a power that the pack can give: at most U_0^2 / 4 R.

    Args:
        spec: Discharge curve and resistance R.
        power_w: Power P that is drawn [W], any shape.
        fraction: Charge, 0 to 1, of the same shape.
    """
    u, power = open_voltage(spec, fraction), np.asarray(power_w, float)
    # 2 P / (U_0 + sqrt(...)), as the difference of the usual formula cancels where R is small.
    return 2 * power / (u + np.sqrt(np.maximum(u * u - 4 * spec.resistance_ohm * power, 0.0)))


def wheels_energy_j(spec: BatterySpec, drive: DriveSpec, motion: Moving, times: Array) -> Array:
    """Energy that the motors draw in each interval between times (K + 1,) [s] in turn [J], shape (K,).

    Each wheel carries half of the robot. It works against half of the drag along its way, and for the
    kinetic energy that it gains; braking gives nothing back. The motors draw that over their efficiency:
    so a straight drive costs (drag x way + m v^2 / 2) / efficiency, however it went.
    """
    moment = motion.at(times)
    side = moment.w * drive.wheel_separation_m / 2
    speed = np.stack([moment.v - side, moment.v + side], axis=-1)
    way = np.abs(np.diff(moment.wheel_angle, axis=0)) * drive.wheel_radius_m
    gain = np.maximum(np.diff(speed * speed, axis=0), 0.0)
    return np.sum(spec.drag_n / 2 * way + spec.mass_kg / 4 * gain, axis=1) / spec.motor_efficiency


@dataclass(frozen=True, eq=False)
class Discharge:
    """What became of a pack: its state at the end of steps, one after the other from t = 0."""

    power_w: Array
    """Power drawn from the pack in each step, its own heat not counted [W], shape (K,)."""

    fraction: Array
    """Charge at the start and after each step, 0 to 1, shape (K + 1,)."""

    voltage_v: Array
    """Voltage under load in the step that ended, of the first before the first [V], shape (K + 1,)."""

    current_a: Array
    """Current in the step that ended, of the first before the first [A], shape (K + 1,)."""

    def index(self, t: ArrayLike) -> NDArray[np.intp]:
        """Which state holds at times [s], shape (N,): that of the last step that has ended by then."""
        steps = np.floor(np.asarray(t, float) / STEP_S + 1e-9).astype(np.intp)
        return np.clip(steps, 0, len(self.power_w))


def discharge(
    spec: BatterySpec,
    drive: DriveSpec,
    motion: Moving,
    lidar_on: Callable[[Array], NDArray[np.bool_]],
    duration_s: float,
) -> Discharge:
    """Discharge a pack through a run, as its model says.

    "power": each step of `STEP_S` draws the mean power P of electronics, LiDAR and motors; the pack gives
    it with the current I of `current_a`, never more than an empty one could, and loses (P + R I^2) dt of
    its energy. What the pack loses is what was drawn, to rounding, until it is empty; an empty pack stays
    at 0, as the run goes on.

    "linear", the paper's: P is `load_w`, the charge falls by P t / E, and nothing sags.

    Args:
        spec: Pack and loads.
        drive: The wheels that are driven.
        motion: What the robot did.
        lidar_on: Whether the LiDAR spins at times [s], of their shape.
        duration_s: How long [s].
    """
    count = int(duration_s / STEP_S) + 1
    times = np.arange(count + 1, dtype=float) * STEP_S
    energy_j = spec.capacity_wh * SECONDS_PER_HOUR
    if spec.model == "linear":
        power = np.full(count, spec.load_w)
        fraction = np.maximum(spec.initial_fraction - spec.load_w * times / energy_j, 0.0)
        voltage = open_voltage(spec, fraction)
        return Discharge(power, fraction, voltage, spec.load_w / voltage)
    power = wheels_energy_j(spec, drive, motion, times) / STEP_S
    power += spec.load_w + spec.lidar_w * lidar_on(times[:-1])
    if spec.resistance_ohm > 0:
        np.minimum(power, spec.voltage_empty_v**2 / (4 * spec.resistance_ohm), out=power)
    # f_{k+1} = f_k - (P_k + R I(P_k, f_k)^2) dt / E, solved for all k at once: a charge f changes I so
    # little that each pass is exact to some digits more, and the last one to all of them.
    left = np.full(count + 1, spec.initial_fraction)
    for _ in range(_ROUNDS):
        current = current_a(spec, power, np.maximum(left[:-1], 0.0))
        spent = np.cumsum((power + spec.resistance_ohm * current * current) * (STEP_S / energy_j))
        last, left = left, np.concatenate([left[:1], spec.initial_fraction - spent])
        if np.array_equal(left, last):
            break
    fraction = np.maximum(left, 0.0)
    current = current_a(spec, power, fraction[:-1])
    voltage = open_voltage(spec, fraction[:-1]) - spec.resistance_ohm * current
    return Discharge(
        power, fraction, np.concatenate([voltage[:1], voltage]), np.concatenate([current[:1], current])
    )


def sense_battery(spec: BatterySpec, pack: Discharge, t: ArrayLike, rng: np.random.Generator) -> Columns:
    """What the robot's battery reports: charge, current, and a voltage with Gaussian noise.

    Args:
        spec: Rate, delays and noise.
        pack: What became of the pack.
        t: Times of the readings [s], shape (N,).
        rng: Source of delays and noise.

    Returns:
        battery_v, battery_a, battery_fraction at `rate_hz`, held.
    """
    delays, noise = rng.spawn(2)
    stamps, latest = held(t, spec.rate_hz, latency_s=spec.latency_s, jitter_s=spec.jitter_s, rng=delays)
    state = pack.index(stamps)
    voltage = pack.voltage_v[state] + spec.voltage_noise_std_v * noise.standard_normal(len(stamps))
    return {
        "battery_v": voltage[latest],
        "battery_a": pack.current_a[state][latest],
        "battery_fraction": pack.fraction[state][latest],
    }
