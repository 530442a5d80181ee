"""Battery: the power that the robot, its LiDAR and its electronics draw, and the charge that is left."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.sim.motion.drive import Moment
from magtwin.sim.motion.sampling import Moving
from magtwin.sim.sensors.clock import Array, Columns, SampleClock, SampledSensor
from magtwin.sim.sensors.noise import accumulate
from magtwin.spec.drive import DriveSpec
from magtwin.spec.sensors import BatterySpec

SECONDS_PER_HOUR = 3600.0

STEP_S = 0.05
"""Length of the steps in which a pack is discharged [s]."""

_ROUNDS = 50
"""Most passes over a discharge; three or four make it exact."""


def open_voltage(spec: BatterySpec, fraction: ArrayLike) -> Array:
    """Voltage of a resting pack with a charge from 0 to 1 [V], along its discharge curve."""
    curve = np.array(spec.discharge)
    share = np.interp(np.asarray(fraction, float), np.linspace(0.0, 1.0, len(curve)), curve)
    return spec.voltage_empty_v + (spec.voltage_full_v - spec.voltage_empty_v) * share


def current_a(spec: BatterySpec, power_w: ArrayLike, fraction: ArrayLike) -> Array:
    """Current of a pack that delivers a power through its inner resistance [A].

    The smaller solution of U I = (U_0 - R I) I = P, for a power of at most U_0^2 / 4 R.

    Args:
        spec: Discharge curve and resistance R.
        power_w: Power P that is drawn [W], any shape.
        fraction: Charge, 0 to 1, of the same shape.
    """
    u, power = open_voltage(spec, fraction), np.asarray(power_w, float)
    # 2 P / (U_0 + sqrt(...)), because the difference in the usual formula cancels if R is small.
    return 2 * power / (u + np.sqrt(np.maximum(u * u - 4 * spec.resistance_ohm * power, 0.0)))


def wheels_energy_j(spec: BatterySpec, drive: DriveSpec, moments: Moment) -> Array:
    """Energy that the motors draw between successive moments [J], shape (K, ...) for K + 1 moments.

    Each wheel carries half of the robot. It works against half of the drag along its way, and for the
    kinetic energy that it gains; braking gives nothing back. The motors draw this work over their efficiency.
    So a straight drive costs (drag x way + m v^2 / 2) / efficiency, however it went.
    """
    side = moments.w * drive.wheel_separation_m / 2
    speed = np.stack([moments.v - side, moments.v + side], axis=-1)
    rolled = np.abs(np.diff(moments.wheel_angle, axis=0)) * drive.wheel_radius_m
    gain = np.maximum(np.diff(speed * speed, axis=0), 0.0)
    work = spec.drag_n / 2 * rolled + spec.mass_kg / 4 * gain
    joules: Array = (work[..., 0] + work[..., 1]) / spec.motor_efficiency
    return joules


class Discharge(NamedTuple):
    """Successive steps of a pack; arrays of shape (K, ...)."""

    power_w: Array
    """Power drawn from the pack in each step, its own heat not counted [W]."""

    fraction: Array
    """Charge at the end of each step, 0 to 1."""

    voltage_v: Array
    """Voltage under load in each step [V]."""

    current_a: Array
    """Current in each step [A]."""


class Battery(SampledSensor):
    """Charge, current, and a voltage with Gaussian noise.

    Each step of `STEP_S` draws the mean power P of electronics, LiDAR and motors. The pack delivers it with
    the current I of `current_a`, at most what an empty pack can deliver, and loses (P + R I^2) dt of its
    energy. An empty pack stays at 0, and the run goes on. In the "linear" model of the paper P is always
    `load_w` and nothing sags. Columns: battery_v, battery_a, battery_fraction.
    """

    def __init__(
        self,
        spec: BatterySpec,
        drive: DriveSpec,
        lidar_on: Callable[[Array], NDArray[np.bool_]],
        rng: np.random.Generator,
    ) -> None:
        """Begin at rest with the spec's charge."""
        delays, noise = rng.spawn(2)
        super().__init__(noise, spent=0.0, initial=spec.initial_fraction)
        if spec.model == "linear":
            spec = replace(spec, model="power", resistance_ohm=0.0, lidar_w=0.0, drag_n=0.0, mass_kg=0.0)
        self.spec, self._drive, self._lidar_on = spec, drive, lidar_on
        self.clock = SampleClock(spec.rate_hz, spec.latency_s, spec.jitter_s, delays)
        self._first, self._done = 0, 0
        self._history: Array | None = None  # voltage, current and charge after step `_first` and later ones

    def rest(self, lidar_on: ArrayLike) -> Discharge:
        """A step of no length at rest: the state at the start; arrays of the shape of `lidar_on`."""
        fraction = np.broadcast_to(self._left(self.state["spent"]), np.shape(lidar_on))
        return self._loaded(np.zeros(np.shape(lidar_on)), lidar_on, fraction, fraction)

    def draw(self, energy_j: Array, lidar_on: ArrayLike, step_s: float) -> Discharge:
        """Discharge the pack in successive steps.

        f_{k+1} = f_k - (P_k + R I(P_k, f_k)^2) dt / E is solved for all k at once: I depends so little on the
        charge f that each pass makes some more digits exact, and the last pass all of them.

        Args:
            energy_j: Energy that the motors draw in each step [J], shape (K,) or (K, R).
            lidar_on: Whether the LiDAR spins in each step, of the same shape.
            step_s: Length of a step [s].
        """
        spec = self.spec
        power = self._power(energy_j / step_s, lidar_on)
        per_watt = step_s / (spec.capacity_wh * SECONDS_PER_HOUR)
        spent = np.broadcast_to(self.state["spent"], (len(power) + 1, *power.shape[1:]))
        for _ in range(_ROUNDS):
            current = current_a(spec, power, self._left(spent[:-1]))
            heat = spec.resistance_ohm * current * current
            last, spent = spent, accumulate(self.state["spent"], (power + heat) * per_watt)
            if np.array_equal(spent, last):
                break
        self.state["spent"] = spent[-1]
        return self._loaded(energy_j / step_s, lidar_on, self._left(spent[:-1]), self._left(spent[1:]))

    def readings(self, steps: Discharge) -> Columns:
        """What the battery reports of states of the pack, shape (K,) or (K, R): voltage with noise."""
        noise = self.spec.voltage_noise_std_v * self.normal(len(steps.voltage_v), 1)[..., 0]
        return {
            "battery_v": steps.voltage_v + noise,
            "battery_a": steps.current_a,
            "battery_fraction": steps.fraction,
        }

    def sense(self, motion: Moving, t: Array, until_s: float | None = None) -> Columns:
        """As for `SampledSensor`."""
        self._discharge(motion, float(t[-1]) + STEP_S if until_s is None else until_s)
        return super().sense(motion, t, until_s)

    def sample(self, stamps: Array, now: Moment) -> Columns:
        """As for `SampledSensor`, for one robot."""
        return self.readings(Discharge(*self._states(stamps).T))

    def supply_a(self, t: Array) -> Array:
        """Current drawn at the times of the last call of `sense` [A]."""
        return self._states(t)[:, 3]

    def _discharge(self, motion: Moving, until_s: float) -> None:
        """Discharge the pack in the steps that end before a time, and keep their states."""
        if self._history is None:
            start = self.rest(self._lidar_on(np.zeros(1)))
            self._history = np.column_stack(start)
        else:
            self._history = self._history[-2:]  # steps go on past the last reading, by less than one
            self._first = self._done - len(self._history) + 1
        last = max(int(np.ceil((until_s - 1e-9) / STEP_S)) - 1, self._done)
        times: Array = np.arange(self._done, last + 1, dtype=float) * STEP_S
        self._done = last
        if len(times) > 1:
            energy = wheels_energy_j(self.spec, self._drive, motion.at(times))
            steps = self.draw(energy, self._lidar_on(times[:-1]), STEP_S)
            self._history = np.concatenate([self._history, np.column_stack(steps)])

    def _states(self, t: Array) -> Array:
        """The state at times [s]: that after the last step that has ended; shape (N, 4)."""
        assert self._history is not None
        steps = np.floor(t / STEP_S + 1e-9).astype(np.intp)
        return self._history.take(np.clip(steps, self._first, self._done) - self._first, axis=0)

    def _left(self, spent: Array) -> Array:
        return np.maximum(self.state["initial"] - spent, 0.0)

    def _power(self, motors_w: Array, lidar_on: ArrayLike) -> Array:
        spec = self.spec
        power = motors_w + spec.load_w + spec.lidar_w * np.asarray(lidar_on, float)
        if spec.resistance_ohm > 0:
            power = np.minimum(power, spec.voltage_empty_v**2 / (4 * spec.resistance_ohm))
        return np.asarray(power)

    def _loaded(self, motors_w: Array, lidar_on: ArrayLike, before: Array, after: Array) -> Discharge:
        """Steps with a charge before and after."""
        power = self._power(motors_w, lidar_on)
        current = current_a(self.spec, power, before)
        voltage = open_voltage(self.spec, before) - self.spec.resistance_ohm * current
        return Discharge(power, after, voltage, current)
