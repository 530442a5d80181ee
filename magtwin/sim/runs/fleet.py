"""Fleet: robots that are commanded step by step, all at once, and what their sensors read after each step.

A table of a fleet has a robot a row, in the columns of a Run. The drive is the closed loop's, with motors,
slip and obstacles. Sensors are those of a run with their figures, but read at the end of each step: without
latency, jitter, rates of their own and dropouts, and the magnetometer with white noise and rounding alone, as
the rest of what it does remembers more than a step. What a robot does depends on its own commands and
generator, whatever robots are beside it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import (
    canonical,
    into_base,
    matrix_from_quat,
    quat_from_rpy,
    quat_from_yaw,
    quat_multiply,
    wrap_angle,
)
from magtwin.run.run import Run
from magtwin.sim.exact import ExactField, check_truth
from magtwin.sim.interference import TORQUE_S, platforms_of_rows
from magtwin.sim.motion import loop
from magtwin.sim.motion.controllers import guide_by_commands
from magtwin.sim.motion.course import Course, fence_of
from magtwin.sim.motion.drive import Moment, Pose, draw_wheel_errors, wheel_rates
from magtwin.sim.motion.follow import CONTROL_RATE_HZ
from magtwin.sim.motion.sampling import into_sensor
from magtwin.sim.runs.simulate import Predict
from magtwin.sim.sensors.battery import SECONDS_PER_HOUR, current_a, open_voltage
from magtwin.sim.sensors.lidar import lidar_on
from magtwin.sim.sensors.magnetometer import rounded
from magtwin.sim.sensors.model_error import ModelError
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]

_WHITE = 22
"""Standard normal numbers that a robot's sensors take a step."""

_ERROR_KEY = 2**31
"""Spawn key of the generators of model errors: no generator that is spawned one by one comes to it."""


@dataclass(frozen=True, eq=False)
class _Before:
    """What robots did a little ago, to whoever asks a motion for that."""

    moment: Moment

    def at(self, t: ArrayLike) -> Moment:
        return self.moment


SENSED = frozenset(
    (
        *("t", "p_world_base", "yaw", "v_base", "w_base", "v_cmd", "w_cmd", "lidar_on", "flag_bump"),
        *("odom_p", "odom_q_xyzw", "odom_v", "odom_w", "imu_q_xyzw", "imu_w", "imu_a"),
        *("battery_v", "battery_a", "battery_fraction", "b_map_nt", "b_map_gradient_nt_m"),
    )
)
"""Columns that a network of a fleet can read."""


class Fleet:
    """Robots of one kind in one lab, which meet obstacles and not each other."""

    def __init__(
        self,
        scene: Scene,
        count: int,
        *,
        anomaly_map: AnomalyMap,
        obstacles: Obstacles,
        step_s: float,
        disturbance_nt: Predict | None = None,
        model_error: ModelError | None = None,
    ) -> None:
        """Make room for robots; each must be put somewhere by `begin` before the first step.

        Args:
            scene: Lab, robot and sensors.
            count: How many robots.
            anomaly_map: What the scene's map layer holds; outside its extent it reads the nearest value.
            obstacles: What stops the robots.
            step_s: Length of a step [s], a multiple of the control step.
            disturbance_nt: What predicts the disturbance of a neural magnetometer and the standard deviation
                of its error, from a table.
            model_error: Statistics of that error, drawn for each robot each time that it begins; None draws
                none.

        Raises:
            InputError: `count` or `step_s` is out of range, or nothing gives the disturbance.
        """
        kind, timeout = scene.robot.magnetometer.kind, scene.robot.drive.command_timeout_s
        if not isinstance(count, int) or count < 1:
            raise InputError(f"a fleet needs a whole number of robots from 1 up, got {count!r}")
        self._steps = round(step_s * CONTROL_RATE_HZ) if math.isfinite(step_s) else 0
        if not (0 < step_s < timeout and abs(self._steps - step_s * CONTROL_RATE_HZ) < 1e-6):
            raise InputError(
                f"step_s must be a multiple of the control step, {1 / CONTROL_RATE_HZ:g} s, below the "
                f"drive's command_timeout_s, {timeout:g} s; got {step_s!r}"
            )
        if disturbance_nt is None:
            check_truth(scene, anomaly_map)
        if disturbance_nt is None and kind == "neural":
            raise InputError(f"nothing gives the disturbance of scene {scene.name!r}, of the kind {kind!r}")
        self.scene, self.count, self.step_s = scene, count, step_s
        self._map, self._obstacles, self._disturbance_nt = anomaly_map, obstacles, disturbance_nt
        self._exact = ExactField(scene=scene, anomaly_map=anomaly_map, outside="clamp")
        self._model_error = model_error
        self._begun = [0] * count
        self._error_rngs: list[np.random.Generator] = [np.random.default_rng(0)] * count
        self._offset, self._process = np.zeros(count), np.zeros(count)
        self._fence = fence_of(obstacles)
        self._drive = _compiled_or_plain()
        self._figures, self._state = np.zeros((count, loop.FIGURES)), np.zeros((count, loop.STATE))
        self._record = np.zeros((count, loop.RECORD, self._steps))
        self._rngs: list[np.random.Generator] = [np.random.default_rng(0)] * count
        self._t, self._angle, self._factors = np.zeros(count), np.zeros((count, 2)), np.ones((count, 2))
        self._odom, self._twist = np.zeros((count, 3)), np.zeros((count, 2))
        self._bias, self._ran_away, self._tilt = np.zeros((count, 3)), np.zeros(count), np.zeros((count, 2))
        self._charge, self._supply_a = np.ones(count), np.zeros(count)
        self._days = [scene.robot] * count
        self._yaw_zero, self._lidar_s = np.zeros(count), np.zeros(count)
        self._columns: dict[str, NDArray[Any]] = {}

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """The table after the last step: columns of a Run, a robot a row."""
        return self._columns

    def begin(
        self,
        which: Sequence[int],
        poses: Sequence[Pose],
        rngs: Sequence[np.random.Generator],
        robots: Sequence[RobotSpec] | None = None,
    ) -> None:
        """Put robots somewhere, at rest, with a new run's draws; the others stay as they are.

        Args:
            which: Numbers of the robots.
            poses: x [m], y [m], yaw [rad] in world of each.
            rngs: Source of all noise of each until it begins anew.
            robots: The scene's robot as it is on a day of each, as `magtwin.sim.session.draw_session` gives
                it; None takes it as the scene has it.

        Raises:
            InputError: One would begin in an obstacle.
        """
        days = [self.scene.robot] * len(which) if robots is None else robots
        for i, pose, rng, robot in zip(which, poses, rngs, days, strict=True):
            drive, imu = robot.drive, robot.imu
            course = Course(
                drive=drive,
                guide=guide_by_commands([[0.0, 0.0, 0.0]], drive),
                dt=1 / CONTROL_RATE_HZ,
                pose0=pose,
                steps=self._steps,
                footprint_radius_m=robot.footprint_radius_m,
                wheel_errors=draw_wheel_errors(drive, rng),
            )
            course.check(self._obstacles)
            self._figures[i], self._state[i] = course.figures(), course.state()
            self._state[i, 8] = 0.0 if len(self._obstacles) else np.inf
            self._rngs[i] = rng
            self._begin_error(i, rng)
            draw = rng.standard_normal(4)
            self._factors[i] = np.array(drive.odometry_scale) * (1 + drive.odometry_noise_std * draw[:2])
            self._bias[i], self._ran_away[i], self._tilt[i] = imu.gyro_bias, 0.0, draw[2:]
            self._t[i], self._angle[i], self._odom[i], self._twist[i] = 0.0, 0.0, 0.0, 0.0
            self._charge[i], self._days[i] = robot.battery.initial_fraction, robot
            self._yaw_zero[i] = imu.yaw_zero
            self._lidar_s[i] = robot.lidar.phase_s - self.scene.robot.lidar.phase_s
            self._record[i] = 0.0
            self._record[i, :3] = np.array(pose)[:, None]
        self._sense(np.asarray(which), moved=False)

    def _begin_error(self, i: int, rng: np.random.Generator) -> None:
        """A session of a robot's model error, from a generator of its own: `rng` is left as it is."""
        if self._model_error is None:
            return
        parent: Any = rng.bit_generator.seed_seq
        key = (*parent.spawn_key, _ERROR_KEY, self._begun[i])
        own = np.random.default_rng(np.random.SeedSequence(parent.entropy, spawn_key=key))
        self._begun[i] += 1
        self._error_rngs[i], self._offset[i] = own, self._model_error.in_session(own).offset

    def _error_nt(self, which: NDArray[np.intp], sd_nt: Array, *, moved: bool) -> Array:
        """Errors of what a network predicted for some robots [nT], shape (len(which),)."""
        if self._model_error is None:
            return np.zeros(len(which))
        white = np.array([self._error_rngs[i].standard_normal() for i in which])
        decay = self._model_error.decay(self.step_s) if moved else 0.0
        self._process[which] = decay * self._process[which] + math.sqrt(1 - decay * decay) * white
        return self._model_error.error_nt(sd_nt, self._process[which], self._offset[which])

    def step(self, commands: ArrayLike, which: Sequence[int] | NDArray[np.intp] | None = None) -> None:
        """Drive robots on for a step, and read their sensors.

        Args:
            commands: Forward speed [m/s] and yaw rate [rad/s] of each, shape (count, 2).
            which: Numbers of the robots; None is all. The others stay as they are.

        Raises:
            InputError: A command is not finite, or they are not of that shape.
        """
        twists = np.asarray(commands, float)
        if twists.shape != (self.count, 2) or not np.isfinite(twists).all():
            raise InputError(
                f"commands must be finite v [m/s], w [rad/s] of shape {(self.count, 2)}, got shape "
                f"{twists.shape}, {np.count_nonzero(~np.isfinite(twists))} of them not finite"
            )
        rows = np.arange(self.count) if which is None else np.asarray(which, np.int64)
        count = len(rows)
        if not count:
            return
        each, tables = np.arange(count, dtype=np.int64), np.zeros((loop.TABLE, count))
        tables[1:3] = twists[rows].T
        laws, made = np.full(count, loop.COMMANDS, np.int64), np.zeros(count, np.int64)
        state, record = self._state[rows], np.zeros((count, loop.RECORD, self._steps))
        state[:, 10] = 0.0
        figures = self._figures[rows]
        self._drive(laws, figures, tables, each, each + 1, *self._fence, state, 0, self._steps, record, made)
        self._state[rows], self._record[rows] = state, record
        self._t[rows] += self.step_s
        self._sense(rows, moved=True)

    def _sense(self, which: NDArray[np.intp], *, moved: bool) -> None:
        """Read the sensors of some robots, after a step or where they begin."""
        record, robot = self._record[which], self.scene.robot
        white = np.array([self._rngs[i].standard_normal(_WHITE) for i in which])
        turned = np.zeros((len(which), 2))
        if moved:
            rates = wheel_rates(record[:, 5], record[:, 6], robot.drive)
            turned = np.sum(rates, axis=1) / CONTROL_RATE_HZ
        self._angle[which] += turned
        now = self._moment(which, -1)
        half = np.array(self.scene.lab.floor_m) / 2
        beyond = np.any(np.abs(now.pose[:, :2]) + robot.footprint_radius_m > half + 1e-9, axis=1)
        yaw, zero = wrap_angle(now.pose[:, 2]), np.zeros(len(which))
        on = lidar_on(robot.lidar, self._t[which] + self._lidar_s[which], "schedule")
        table: dict[str, NDArray[Any]] = {
            "t": self._t[which],
            "p_world_base": np.column_stack([now.pose[:, :2], zero + robot.base_height_m]),
            "yaw": yaw,
            "v_base": np.column_stack([now.v, zero, zero]),
            "w_base": np.column_stack([zero, zero, now.w]),
            "v_cmd": now.v_cmd,
            "w_cmd": now.w_cmd,
            "lidar_on": on,
            "flag_bump": now.bump | beyond,
        }
        table |= self._odometry(which, turned, white[:, :6])
        table |= self._imu(which, now, white[:, 6:20], moved=moved)
        table |= self._battery(which, now, turned, on, white[:, 20], moved=moved)
        table |= self._field(which, now, table, white[:, 21], moved=moved)
        self._twist[which] = np.column_stack([now.v, now.w])
        whole = {name: values.copy() for name, values in self._columns.items()}  # what was given stays
        for name, values in table.items():
            column = whole.setdefault(name, np.zeros((self.count, *values.shape[1:]), values.dtype))
            column[which] = values
        self._columns = whole

    def _moment(self, which: NDArray[np.intp], k: int) -> Moment:
        """What some robots did in control step k of the last step."""
        r = self._record[which]
        return Moment(
            pose=r[:, :3, k],
            v=r[:, 3, k],
            w=r[:, 4, k],
            a=(r[:, 3, -1] - self._twist[which, 0]) / self.step_s,
            wheel_angle=self._angle[which],
            v_cmd=r[:, 7, k],
            w_cmd=r[:, 8, k],
            bump=np.any(r[:, 9] > 0, axis=1),
        )

    def _odometry(self, which: NDArray[np.intp], turned: Array, white: Array) -> dict[str, NDArray[Any]]:
        """As `magtwin.sim.sensors.odometry.sense_odometry`."""
        drive = self.scene.robot.drive
        left, right = (turned * drive.wheel_radius_m * self._factors[which]).T
        way, turn = (left + right) / 2, (right - left) / drive.wheel_separation_m
        odom = self._odom[which]
        middle, chord = odom[:, 2] + turn / 2, way * np.sinc(turn / (2 * np.pi))
        odom += np.column_stack([chord * np.cos(middle), chord * np.sin(middle), turn])
        self._odom[which] = odom
        twist = white * (*drive.odometry_v_noise_std, *drive.odometry_w_noise_std)
        twist[:, 0] += way / self.step_s
        twist[:, 5] += turn / self.step_s
        return {
            "odom_p": np.column_stack([odom[:, :2], np.zeros(len(which))]),
            "odom_q_xyzw": quat_from_yaw(wrap_angle(odom[:, 2])),
            "odom_v": twist[:, :3],
            "odom_w": twist[:, 3:],
        }

    def _imu(
        self, which: NDArray[np.intp], now: Moment, white: Array, *, moved: bool
    ) -> dict[str, NDArray[Any]]:
        """As `magtwin.sim.sensors.imu.sense_imu`."""
        robot, zero = self.scene.robot, np.zeros(len(which))
        spec, q_base_imu = robot.imu, robot.q_base_imu_xyzw
        if moved:
            self._bias[which] += spec.gyro_bias_walk * math.sqrt(self.step_s) * white[:, 9:12]
            along = np.array(matrix_from_quat(q_base_imu)[2])
            self._ran_away[which] += np.sum(self._bias[which] * along, axis=1) * self.step_s
            decay = math.exp(-self.step_s / spec.tilt_time_s) if spec.tilt_time_s > 0 else 0.0
            fresh = math.sqrt(1 - decay * decay) * white[:, 12:14]
            self._tilt[which] = decay * self._tilt[which] + fresh
        shaking = np.abs(now.v)[:, None]
        rates = into_sensor(np.column_stack([zero, zero, now.w]), q_base_imu) + self._bias[which]
        rates += np.hypot(spec.gyro_noise_std, shaking * np.array(spec.gyro_vibration)) * white[:, 3:6]
        acceleration = into_sensor(np.column_stack([now.a, now.v * now.w, zero]), q_base_imu)
        acceleration += (
            np.hypot(spec.accel_noise_std, shaking * np.array(spec.accel_vibration)) * white[:, 6:9]
        )
        heading = now.pose[:, 2] - self._yaw_zero[which] + self._ran_away[which]
        tilt = spec.tilt + spec.tilt_std * self._tilt[which]
        q = quat_multiply(quat_from_rpy(np.column_stack([tilt, heading])), q_base_imu)
        q = quat_multiply(quat_from_rpy([*spec.level_error, 0.0]), q)
        q = quat_multiply(q, quat_from_rpy(spec.orientation_noise_std * white[:, :3]))
        return {"imu_q_xyzw": canonical(q), "imu_w": rates, "imu_a": acceleration}

    def _battery(
        self,
        which: NDArray[np.intp],
        now: Moment,
        turned: Array,
        on: NDArray[np.bool_],
        white: Array,
        *,
        moved: bool,
    ) -> dict[str, NDArray[Any]]:
        """As `magtwin.sim.sensors.battery.discharge`, a step of it the length of this one."""
        spec, drive, charge = self.scene.robot.battery, self.scene.robot.drive, self._charge[which]
        resistance = 0.0 if spec.model == "linear" else spec.resistance_ohm
        power = np.full(len(which), spec.load_w)
        if spec.model != "linear":
            speed = wheel_rates(now.v, now.w, drive) * drive.wheel_radius_m
            was = wheel_rates(self._twist[which, 0], self._twist[which, 1], drive) * drive.wheel_radius_m
            gain = np.maximum(speed * speed - was * was, 0.0)
            way = np.abs(turned) * drive.wheel_radius_m
            joules = np.sum(spec.drag_n / 2 * way + spec.mass_kg / 4 * gain, axis=1) / spec.motor_efficiency
            power += spec.lidar_w * on + joules / self.step_s
            if resistance:
                power = np.minimum(power, spec.voltage_empty_v**2 / (4 * resistance))
        voltage = open_voltage(spec, charge)
        current = power / voltage if spec.model == "linear" else current_a(spec, power, charge)
        if moved:
            spent = (power + resistance * current * current) * self.step_s
            charge = np.maximum(charge - spent / (spec.capacity_wh * SECONDS_PER_HOUR), 0.0)
        self._charge[which], self._supply_a[which] = charge, current
        return {
            "battery_v": voltage - resistance * current + spec.voltage_noise_std_v * white,
            "battery_a": current,
            "battery_fraction": charge,
        }

    def _field(
        self,
        which: NDArray[np.intp],
        now: Moment,
        table: dict[str, NDArray[Any]],
        white: Array,
        *,
        moved: bool,
    ) -> dict[str, NDArray[Any]]:
        """The map, the disturbance, and what the magnetometer reads of their sum."""
        scene = self.scene
        spec = scene.robot.magnetometer
        b_map = self._map.lookup(now.pose[:, :2], table["yaw"], outside="clamp")
        b_map = np.where(np.isnan(b_map), np.nanmean(self._map.values_nt), b_map)  # beside masked nodes
        error = np.zeros(len(which))
        if self._disturbance_nt is not None:
            slopes = self._map.gradient(now.pose[:, :2], table["yaw"], outside="clamp")[:, :2]
            sloped = into_base(np.nan_to_num(slopes), table["yaw"])
            known = {"b_map_nt": b_map, "b_map_gradient_nt_m": sloped}
            found = self._disturbance_nt(Run(table | known))
            mean, sd = found if isinstance(found, tuple) else (found, np.zeros(len(which)))
            disturbance, error = mean, self._error_nt(which, sd, moved=moved)
        elif spec.kind == "physical":
            early = max(self._steps - 1 - round(TORQUE_S * CONTROL_RATE_HZ), 0)
            field = self._exact.at_sensor_nt(
                self._scene_of(which),
                _Before(self._moment(which, early)),
                np.maximum(self._t[which], TORQUE_S),  # rows are robots, whose times come in no order
                true=now,
                lidar_on=table["lidar_on"],
                supply_a=self._supply_a[which],
                at_rest_nt=b_map,
            )
            disturbance = np.sqrt(np.sum(field * field, axis=1)) - b_map
            disturbance = np.nan_to_num(disturbance)  # a map of one heading is read beside b_map's place
        else:
            disturbance = np.zeros(len(which))
        noise = spec.noise_density_nt * math.sqrt(spec.rate_hz / 2) * white
        return {
            "b_map_nt": b_map,
            "b_disturbance_nt": disturbance,
            "b_total_nt": b_map + disturbance,
            "b_model_error_nt": error,
            "b_measured_nt": rounded(b_map + disturbance + error + noise, spec.resolution_nt),
        }

    def _scene_of(self, which: NDArray[np.intp]) -> Scene:
        """The scene with the platforms of some robots' days, a row each."""
        robot = self.scene.robot
        days = [self._days[i] for i in which]
        if all(day is robot for day in days):
            return self.scene
        return replace(
            self.scene, robot=replace(robot, platform=platforms_of_rows([day.platform for day in days]))
        )


def _compiled_or_plain() -> Callable[..., None]:
    """The loop for arrays, compiled where numba works; the same bits."""
    try:
        from magtwin.sim.motion.compiled import robots
    except ImportError:
        return loop.robots
    return robots
