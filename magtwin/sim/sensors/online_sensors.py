"""Online sensors: what `odometry`, `imu`, `mocap`, `battery` and `magnetometer` read, sample by sample.

The same laws and draws as those modules, for a robot whose next step is not known yet: read step by step,
each gives what the module gives for the whole run, but for rounding where a recursion is summed in another
order (1e-12 of the values; a reading that is rounded to the sensor's resolution may be a step of it off).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.frames import canonical, quat_from_rpy, quat_from_yaw, quat_multiply, wrap_angle
from magtwin.sim.motion.sampling import Moving, axes_in_base, into_sensor, moment_at
from magtwin.sim.sensors.battery import SECONDS_PER_HOUR, STEP_S, current_a, open_voltage, wheels_energy_j
from magtwin.sim.sensors.magnetometer import (
    FLICKER_STEP,
    along_axis,
    feels_direction,
    flicker_corners_hz,
    in_dead_zone,
    rounded,
    vector_gain,
)
from magtwin.sim.sensors.mocap import taken_for_base
from magtwin.spec.base import Quat
from magtwin.spec.drive import DriveSpec
from magtwin.spec.sensors import BatterySpec, ImuSpec, MagnetometerSpec, MocapSpec

Array = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

_ROUND = 64
"""Dropouts drawn at a time, as `magtwin.sim.sensors.mocap.dropouts` draws them."""


@dataclass(frozen=True, eq=False)
class Samples:
    """What a sensor read, sample by sample."""

    t: Array
    """When each was taken [s], shape (M,)."""

    arrival: Array
    """When each arrives [s], shape (M,)."""

    columns: Columns
    """What was read, columns of a Run, (M, ...)."""


class Held:
    """Samples as they are taken and arrive: `magtwin.sim.motion.sampling.held`, step by step."""

    def __init__(
        self, rate_hz: float, latency_s: float, jitter_s: float, rng: np.random.Generator | None
    ) -> None:
        """As `held` takes them."""
        self._rate, self._latency, self._jitter, self._rng = rate_hz, latency_s, jitter_s, rng
        self._next = -math.ceil(latency_s * rate_hz)
        self._arrivals = np.zeros(0)
        self._last = -math.inf
        self._columns: Columns = {}
        self.fresh: list[Samples] = []
        """Samples that were taken since somebody last emptied this."""

    def due(self, until_s: float) -> Array:
        """Times of the samples that have not been taken yet and lie before a time [s], shape (M,)."""
        last = math.ceil(until_s * self._rate - 1e-9)
        stamps = np.arange(self._next, max(last, self._next)) / self._rate
        self._next += len(stamps)
        return stamps

    def add(self, stamps: Array, columns: Columns) -> None:
        """Take samples, of these times."""
        arrivals = stamps + self._latency if self._latency else stamps
        if self._jitter > 0 and self._rng is not None:
            arrivals = arrivals + self._rng.exponential(self._jitter, len(stamps))
        if not len(stamps):
            return
        arrivals = np.maximum.accumulate(np.concatenate([[self._last], arrivals]))[1:]
        self._last = float(arrivals[-1])
        self.fresh.append(Samples(stamps, arrivals, columns))
        self._arrivals = np.concatenate([self._arrivals, arrivals])
        for name, values in columns.items():
            self._columns[name] = (
                np.concatenate([self._columns[name], values]) if name in self._columns else values
            )

    def at(self, t: Array) -> Columns:
        """What readings see at times that only go on [s], shape (N,): the newest sample that has arrived."""
        latest = np.maximum(np.searchsorted(self._arrivals, t, side="right") - 1, 0)
        seen = {name: values[latest] for name, values in self._columns.items()}
        if len(latest) and (gone := int(latest[-1])):
            self._arrivals = self._arrivals[gone:]
            self._columns = {name: values[gone:] for name, values in self._columns.items()}
        return seen


class Markov:
    """`magtwin.sim.sensors.noise.gauss_markov`, step by step; of one number or several."""

    def __init__(self, time_s: float, rate_hz: float) -> None:
        """As `gauss_markov` takes them."""
        self._decay = math.exp(-1.0 / (time_s * rate_hz)) if time_s > 0 else 0.0
        self._fresh = math.sqrt(1.0 - self._decay * self._decay)
        self._last: Any = None

    def next(self, white: Array) -> Array:
        """The process for the next white numbers, shape (M, ...)."""
        out = np.array(white, float)
        for k in range(len(out)):
            if self._last is not None:
                out[k] = self._decay * self._last + self._fresh * out[k]
            self._last = out[k].copy()
        return out


class Odometry:
    """`magtwin.sim.sensors.odometry.sense_odometry`, step by step."""

    def __init__(self, drive: DriveSpec, rng: np.random.Generator) -> None:
        delays, self._noise = rng.spawn(2)
        self._drive = drive
        factors = np.array(drive.odometry_scale)
        self._factors = factors * (1.0 + drive.odometry_noise_std * rng.standard_normal(2))
        self.held = Held(drive.odometry_rate_hz, drive.odometry_latency_s, drive.odometry_jitter_s, delays)
        self._angle: Array | None = None
        self._yaw, self._x, self._y = 0.0, 0.0, 0.0

    def sense(self, motion: Moving, t: Array, until_s: float) -> Columns:
        """Readings at times [s], shape (N,), of a motion that is known until `until_s`."""
        drive, stamps = self._drive, self.held.due(until_s)
        if len(stamps):
            rate = drive.odometry_rate_hz
            if self._angle is None:
                self._angle = moment_at(motion, stamps[:1] - 1 / rate).wheel_angle[0]
            angle = np.vstack([self._angle, moment_at(motion, stamps).wheel_angle])
            self._angle = angle[-1]
            left, right = (np.diff(angle, axis=0) * (drive.wheel_radius_m * self._factors)).T
            way, turn = (left + right) / 2, (right - left) / drive.wheel_separation_m
            yaw = np.cumsum(np.concatenate([[self._yaw], turn]))[1:]
            chord, middle = way * np.sinc(turn / (2 * np.pi)), yaw - turn / 2
            x = np.cumsum(np.concatenate([[self._x], chord * np.cos(middle)]))[1:]
            y = np.cumsum(np.concatenate([[self._y], chord * np.sin(middle)]))[1:]
            self._yaw, self._x, self._y = float(yaw[-1]), float(x[-1]), float(y[-1])
            twist = self._noise.standard_normal((len(stamps), 6))
            twist *= (*drive.odometry_v_noise_std, *drive.odometry_w_noise_std)
            twist[:, 0] += way * rate
            twist[:, 5] += turn * rate
            self.held.add(
                stamps,
                {
                    "odom_p": np.column_stack([x, y, np.zeros(len(x))]),
                    "odom_q_xyzw": quat_from_yaw(wrap_angle(yaw)),
                    "odom_v": twist[:, :3],
                    "odom_w": twist[:, 3:],
                },
            )
        return self.held.at(t)


class Imu:
    """`magtwin.sim.sensors.imu.sense_imu`, step by step."""

    def __init__(self, spec: ImuSpec, q_base_imu_xyzw: Quat, rng: np.random.Generator) -> None:
        delays, self._fast, self._slow = rng.spawn(3)
        self._spec, self._q_base = spec, q_base_imu_xyzw
        self.held = Held(spec.rate_hz, spec.latency_s, spec.jitter_s, delays)
        self._tilt = Markov(spec.tilt_time_s, spec.rate_hz)
        self._walk: Array | None = None
        self._ran, self._zero = 0.0, 0.0

    def sense(self, motion: Moving, t: Array, until_s: float) -> Columns:
        """As for `Odometry`."""
        stamps = self.held.due(until_s)
        if len(stamps):
            self.held.add(stamps, self._samples(motion, stamps))
        return self.held.at(t)

    def _samples(self, motion: Moving, stamps: Array) -> Columns:
        spec, q_base, count = self._spec, self._q_base, len(stamps)
        true, zero = moment_at(motion, stamps), np.zeros(count)
        noise, wander = self._fast.standard_normal((count, 9)), self._slow.standard_normal((count, 5))
        shaking = np.abs(true.v)[:, None]
        steps = wander[:, :3] / math.sqrt(spec.rate_hz)
        begins = self._walk is None
        before = np.zeros(3) if self._walk is None else self._walk
        if begins:
            steps[0] = 0.0
        walk = np.cumsum(np.vstack([before, steps]), axis=0)[1:]
        self._walk = walk[-1]
        bias = spec.gyro_bias + spec.gyro_bias_walk * walk
        rates = into_sensor(np.column_stack([zero, zero, true.w]), q_base) + bias
        rates += np.hypot(spec.gyro_noise_std, shaking * np.array(spec.gyro_vibration)) * noise[:, 3:6]
        acceleration = into_sensor(np.column_stack([true.a, true.v * true.w, zero]), q_base)
        acceleration += (
            np.hypot(spec.accel_noise_std, shaking * np.array(spec.accel_vibration)) * noise[:, 6:]
        )
        ran = np.cumsum(np.concatenate([[self._ran], bias @ axes_in_base(tuple(q_base))[2]]))[1:]
        self._ran = float(ran[-1])
        if begins:
            self._zero = float(ran[0]) / spec.rate_hz
        heading = true.pose[:, 2] - spec.yaw_zero + (ran / spec.rate_hz - self._zero)
        tilt = spec.tilt + spec.tilt_std * self._tilt.next(wander[:, 3:])
        q = quat_multiply(quat_from_rpy(np.column_stack([tilt, heading])), q_base)
        q = quat_multiply(quat_from_rpy([*spec.level_error, 0.0]), q)
        q = quat_multiply(q, quat_from_rpy(spec.orientation_noise_std * noise[:, :3]))
        return {"imu_q_xyzw": canonical(q), "imu_w": rates, "imu_a": acceleration}


class Mocap:
    """`magtwin.sim.sensors.mocap.sense_mocap`, step by step."""

    def __init__(self, spec: MocapSpec, height_m: float, rng: np.random.Generator) -> None:
        delays, self._noise, self._gaps = rng.spawn(3)
        self._spec, self._height = spec, height_m
        self.held = Held(spec.rate_hz, spec.latency_s, spec.jitter_s, delays)
        self._edges: Array | None = None
        self._seen: tuple[Array, Array] | None = None

    def sense(self, motion: Moving, t: Array, until_s: float) -> Columns:
        """As for `Odometry`."""
        stamps = self.held.due(until_s)
        if len(stamps):
            pose = moment_at(motion, stamps).pose
            white = self._noise.standard_normal((len(stamps), 6))
            spec = self._spec
            p = taken_for_base(spec, pose, self._height) + spec.p_noise_std_m * white[:, :3]
            q = quat_multiply(quat_from_yaw(pose[:, 2]), quat_from_rpy(spec.angle_noise_std * white[:, 3:]))
            q = canonical(q)
            lost = self._lost(stamps)
            for k in np.flatnonzero(lost):
                p[k], q[k] = self._seen if k == 0 and self._seen is not None else (p[k - 1], q[k - 1])
            self._seen = p[-1].copy(), q[-1].copy()
            self.held.add(stamps, {"mocap_p": p, "mocap_q_xyzw": q, "flag_pose_lost": lost})
        return self.held.at(t)

    def _lost(self, stamps: Array) -> NDArray[np.bool_]:
        """As `magtwin.sim.sensors.mocap.dropouts`."""
        spec = self._spec
        if not (spec.dropout_every_s and spec.dropout_s):
            return np.zeros(len(stamps), bool)
        begins = self._edges is None
        edges = stamps[:1] if self._edges is None else self._edges
        while edges[-1] <= stamps[-1]:
            lengths = self._gaps.exponential((spec.dropout_every_s, spec.dropout_s), (_ROUND, 2))
            edges = np.concatenate([edges, edges[-1] + np.cumsum(lengths)])
        self._edges = edges
        lost = np.searchsorted(edges, stamps, side="right") % 2 == 0
        if begins:
            lost[0] = False
        return np.asarray(lost)


class Battery:
    """`magtwin.sim.sensors.battery.discharge` and `sense_battery`, step by step, of a robot that begins at
    rest.

    The charge of a step is that of the recursion itself, of which `discharge` finds the solution at once.
    """

    def __init__(
        self,
        spec: BatterySpec,
        drive: DriveSpec,
        lidar_on: Callable[[Array], NDArray[np.bool_]],
        rng: np.random.Generator,
    ) -> None:
        delays, self._noise = rng.spawn(2)
        self._spec, self._drive, self._lidar_on = spec, drive, lidar_on
        self.held = Held(spec.rate_hz, spec.latency_s, spec.jitter_s, delays)
        self._spent, self._done, self._first = 0.0, 0, 0
        rest = self._step(0.0, at_s=0.0)
        self._states = np.array([[spec.initial_fraction, *rest]])

    def sense(self, motion: Moving, t: Array, until_s: float) -> Columns:
        """As for `Odometry`; and `supply_a`, the current at each reading [A]."""
        spec = self._spec
        while (self._done + 1) * STEP_S < until_s - 1e-9:
            times = np.array([self._done, self._done + 1]) * STEP_S
            energy = 0.0
            if spec.model != "linear":
                energy = float(wheels_energy_j(spec, self._drive, motion, times)[0])
            voltage, current = self._step(energy, at_s=float(times[0]), spend=True)
            self._done += 1
            self._states = np.vstack([self._states, [self._fraction(), voltage, current]])
        stamps = self.held.due(until_s)
        if len(stamps):
            state = self._states[self._index(stamps)]
            noise = spec.voltage_noise_std_v * self._noise.standard_normal(len(stamps))
            self.held.add(
                stamps,
                {"battery_v": state[:, 1] + noise, "battery_a": state[:, 2], "battery_fraction": state[:, 0]},
            )
        seen = self.held.at(t) | {"supply_a": self._states[self._index(t)][:, 2]}
        if len(self._states) > 64:
            self._first, self._states = self._first + 32, self._states[32:]
        return seen

    def _index(self, t: Array) -> NDArray[np.intp]:
        steps = np.floor(t / STEP_S + 1e-9).astype(np.intp)
        return np.clip(steps, 0, self._done) - self._first

    def _fraction(self) -> float:
        spec = self._spec
        if spec.model == "linear":
            joules = spec.load_w * (self._done * STEP_S)
            return max(spec.initial_fraction - joules / (spec.capacity_wh * SECONDS_PER_HOUR), 0.0)
        return max(spec.initial_fraction - self._spent, 0.0)

    def _step(self, energy_j: float, *, at_s: float, spend: bool = False) -> tuple[float, float]:
        """Voltage [V] and current [A] of a step that begins at a time."""
        spec = self._spec
        if spec.model == "linear":
            done = self._done + spend
            joules = spec.load_w * (done * STEP_S)
            left = max(spec.initial_fraction - joules / (spec.capacity_wh * SECONDS_PER_HOUR), 0.0)
            voltage = float(open_voltage(spec, left))
            return voltage, spec.load_w / voltage
        power = energy_j / STEP_S
        power += spec.load_w + spec.lidar_w * float(self._lidar_on(np.array(at_s)))
        if spec.resistance_ohm > 0:
            power = min(power, spec.voltage_empty_v**2 / (4 * spec.resistance_ohm))
        left = max(spec.initial_fraction - self._spent, 0.0)
        current = float(current_a(spec, power, left))
        if spend:
            energy = spec.capacity_wh * SECONDS_PER_HOUR
            self._spent += (power + spec.resistance_ohm * current * current) * (STEP_S / energy)
        return float(open_voltage(spec, left)) - spec.resistance_ohm * current, current


class Magnetometer:
    """`magtwin.sim.sensors.magnetometer.sense_magnetometer`, reading by reading.

    A clock that is ahead would read what is not known yet: the newest reading stands for that.
    """

    def __init__(self, spec: MagnetometerSpec, rate_hz: float, rng: np.random.Generator) -> None:
        noise, self._vector_noise, self._latch, self._drop = rng.spawn(4)
        self._spec, self._rate = spec, rate_hz
        self._white, slow = noise.spawn(2)
        corners = flicker_corners_hz(rate_hz) if spec.noise_density_nt and spec.flicker_corner_hz else []
        self._flicker = [
            (own, Markov(1 / (2 * math.pi * corner), rate_hz))
            for corner, own in zip(corners, slow.spawn(len(corners)), strict=True)
        ]
        self._gain, self._bias = vector_gain(spec), np.array(spec.vector_bias_nt)
        self._turn = 0
        self._axes = np.full(3, np.nan)
        self._was_lost, self._latched = (
            False,
            spec.stuck_nt + spec.stuck_std_nt * self._latch.standard_normal(),
        )
        self._known: list[float] = []
        self._low: tuple[float, float] | None = None

    def axes(self, b_vector_nt: Array, steep: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
        """The vector's readings [nT], shape (N, 3), and where lock is lost, of the next readings.

        Args:
            b_vector_nt: Field in the sensor's axes [nT], shape (N, 3); nan where it is not known.
            steep: Whether lock is lost to the gradient, shape (N,).
        """
        spec, count = self._spec, len(b_vector_nt)
        along = along_axis(b_vector_nt) if feels_direction(spec) else np.full(count, np.nan)
        lost = steep | in_dead_zone(spec, along)
        out = np.full((count, 3), np.nan)
        if count and not np.isnan(b_vector_nt).all():
            if self._turn == 0:  # two readings before the first one
                b_vector_nt = np.concatenate([b_vector_nt[:1], b_vector_nt[:1], b_vector_nt])
                lost = np.concatenate([lost[:1], lost[:1], lost])
            before = len(b_vector_nt) - count
            axis = (self._turn + np.arange(len(b_vector_nt))) % 3
            read = np.einsum("ni,ni->n", b_vector_nt, self._gain[axis]) + self._bias[axis]
            std = spec.vector_noise_density_nt * math.sqrt(self._rate / 3 / 2)
            read = rounded(read + std * self._vector_noise.standard_normal(len(read)), spec.resolution_nt)
            for k, value in enumerate(read):
                if np.isfinite(value) and not lost[k]:
                    self._axes[axis[k]] = value
                if k >= before:
                    out[k - before] = self._axes
            self._turn += len(read)
            lost = lost[before:]
        return out, lost

    def read(self, b_total_nt: Array, b_vector_nt: Array, lost: NDArray[np.bool_]) -> Columns:
        """b_measured_nt, b_noise_nt and flag_lost_lock of readings whose axes have been read.

        Args:
            b_total_nt: Field magnitude [nT], shape (N,).
            b_vector_nt: As for `axes`.
            lost: As `axes` gave it.
        """
        spec, b = self._spec, b_total_nt
        if spec.heading_error_nt:
            b = b + spec.heading_error_nt * np.nan_to_num(along_axis(b_vector_nt))
        if spec.clock_offset_s or spec.bandwidth_hz:
            b = np.array([self._passed(self._late(float(value))) for value in b])
        noise = spec.noise_density_nt * math.sqrt(self._rate / 2) * self._white.standard_normal(len(b))
        for own, process in self._flicker:
            std = spec.noise_density_nt * math.sqrt(spec.flicker_corner_hz * math.log(FLICKER_STEP))
            noise = noise + std * process.next(own.standard_normal(len(b)))
        read = b + noise
        for k in range(len(read)):
            if lost[k] and not self._was_lost:
                self._latched = spec.stuck_nt + spec.stuck_std_nt * self._latch.standard_normal()
            self._was_lost = bool(lost[k])
            if lost[k]:
                read[k] = self._latched
        read = rounded(read, spec.resolution_nt)
        read[~np.isfinite(b_total_nt)] = np.nan
        return {"b_measured_nt": read, "b_noise_nt": read - b_total_nt, "flag_lost_lock": lost}

    def dropped(self, count: int) -> NDArray[np.bool_]:
        """Which of the next readings do not come, shape (count,)."""
        if not self._spec.dropout_share:
            return np.zeros(count, bool)
        return np.asarray(self._drop.random(count) < self._spec.dropout_share)

    def _late(self, b: float) -> float:
        """The field as it was by the clock's offset before, the first known one before that."""
        known = self._known
        known.append(b if math.isfinite(b) or not known else known[-1])
        late = max(self._spec.clock_offset_s * self._rate, 0.0)
        del known[: -(math.ceil(late) + 1)]
        if not late:
            return known[-1]
        at = len(known) - 1 - late
        if at <= 0:
            return known[0]
        k = int(at)
        return known[k] + (at - k) * (known[k + 1] - known[k]) if k + 1 < len(known) else known[k]

    def _passed(self, b: float) -> float:
        """Through the low-pass, from its own settled state."""
        if not self._spec.bandwidth_hz:
            return b
        tau = self._rate / (2 * math.pi * self._spec.bandwidth_hz)
        decay, share = math.exp(-1 / tau), -math.expm1(-1 / tau) * tau
        if self._low is None or not math.isfinite(self._low[1]):
            self._low = b, b
        else:
            before, y = self._low
            self._low = b, decay * y + (1 - share) * b + (share - decay) * before
        return self._low[1]
