"""Robots of one kind that are commanded step by step, all at once, with sensors read after each step.

A table has one robot a row, in the columns of a Run. The drive is the closed loop, with motors, slip and
obstacles. Sensors are those of a run, but read at the end of each step: without latency, jitter, their own
rates, and dropouts. The magnetometer has only white noise and rounding, because its other errors need its own
rate. A robot depends only on its own commands and generator, not on the robots beside it.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import into_base
from magtwin.run.run import Run
from magtwin.sim.exact import ExactField, check_truth
from magtwin.sim.interference import TORQUE_S, platforms_of_rows
from magtwin.sim.motion import loop
from magtwin.sim.motion.closed_loop import LOOPS, Robots
from magtwin.sim.motion.drive import Moment, Pose, draw_wheel_errors, wheel_rates
from magtwin.sim.motion.follow import CONTROL_RATE_HZ, STAND, loop_by_commands
from magtwin.sim.runs.sensing import streams, truth
from magtwin.sim.runs.simulate import Predict
from magtwin.sim.sensors.battery import Battery, wheels_energy_j
from magtwin.sim.sensors.imu import Imu
from magtwin.sim.sensors.lidar import lidar_on
from magtwin.sim.sensors.magnetometer import Magnetometer
from magtwin.sim.sensors.model_error import ModelError
from magtwin.sim.sensors.noise import GaussMarkov
from magtwin.sim.sensors.odometry import Odometry
from magtwin.sim.sensors.stateful import Stateful
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

SENSED = frozenset(
    (
        *("t", "p_world_base", "yaw", "v_base", "w_base", "v_cmd", "w_cmd"),
        *("wheel_angle", "lidar_on", "flag_bump"),
        *("odom_p", "odom_q_xyzw", "odom_v", "odom_w", "imu_q_xyzw", "imu_w", "imu_a"),
        *("battery_v", "battery_a", "battery_fraction", "b_map_nt", "b_map_gradient_nt_m"),
    )
)
"""Columns that a network can read here."""


@dataclass(frozen=True, eq=False)
class _Past:
    """What robots did a short time ago, as a motion."""

    moment: Moment

    def at(self, t: ArrayLike) -> Moment:
        return self.moment


class SteppedRobots:
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
        """Make room for robots; `begin` must place each before its first step."""
        kind, timeout = scene.robot.magnetometer.kind, scene.robot.drive.command_timeout_s
        if not isinstance(count, int) or count < 1:
            raise InputError(f"the number of robots must be a whole number from 1 up, got {count!r}")
        self._steps = round(step_s * CONTROL_RATE_HZ) if math.isfinite(step_s) else 0
        if not (0 < step_s < timeout and abs(self._steps - step_s * CONTROL_RATE_HZ) < 1e-6):
            raise InputError(
                f"step_s must be a multiple of the control step, {1 / CONTROL_RATE_HZ:g} s, below the "
                f"drive's command_timeout_s, {timeout:g} s; got {step_s!r}",
                parameter="step_s",
            )
        if disturbance_nt is None:
            check_truth(scene, anomaly_map)
            if kind == "neural":
                raise InputError(f"no network predicts the disturbance of scene {scene.name!r}")
        self.scene, self.count, self.step_s = scene, count, step_s
        self._map, self._obstacles, self._disturbance_nt = anomaly_map, obstacles, disturbance_nt
        self._exact = ExactField(scene=scene, anomaly_map=anomaly_map, outside="clamp")
        self._model_error = model_error
        if scene.robot.plant != PlantSpec():
            text = "has a plant, which only runs simulate; leave it out"
            raise InputError(f"robot {scene.robot.name!r} {text}")
        self._code: ModuleType | None = None  # where numba does not work; the bytes are the same
        with suppress(ImportError):
            self._code = LOOPS.open()
        self._moved = Robots([loop_by_commands(STAND, scene.robot.drive)] * count, obstacles)
        self._record = np.zeros((count, loop.RECORD, self._steps))
        self._t, self._angle, self._twist = np.zeros(count), np.zeros((count, 2)), np.zeros((count, 2))
        self._robots, self._lidar_s, self._offset = [scene.robot] * count, np.zeros(count), np.zeros(count)
        unused = [self._sensors(scene.robot, streams(np.random.default_rng(0)))] * count
        self._sensed = {
            name: type(first).stacked([one[name] for one in unused]) for name, first in unused[0].items()
        }
        self._columns: Columns = {}

    def _sensors(self, robot: RobotSpec, draws: dict[str, np.random.Generator]) -> dict[str, Stateful]:
        """The sensors of a robot that begins."""
        rate, spec = 1 / self.step_s, replace(robot.magnetometer, flicker_corner_hz=0.0)
        time_s = self._model_error.time_s if self._model_error else 0.0
        return {
            "odometry": Odometry(robot.drive, draws["odometry"], rate_hz=rate),
            "imu": Imu(robot.imu, robot.q_base_imu_xyzw, draws["imu"], rate_hz=rate),
            "battery": Battery(
                robot.battery, robot.drive, lambda t: np.zeros(t.shape, bool), draws["battery"]
            ),
            "magnetometer": Magnetometer(spec, spec.rate_hz, draws["magnetometer"]),
            "error": GaussMarkov(draws["model_error"], time_s, rate),
        }

    @property
    def columns(self) -> Columns:
        """The table after the last step: columns of a Run, a robot a row."""
        return self._columns

    def begin(
        self,
        which: Sequence[int],
        poses: Sequence[Pose],
        rngs: Sequence[np.random.Generator],
        robots: Sequence[RobotSpec] | None = None,
    ) -> None:
        """Place robots at rest, with the draws of a new run; the others stay as they are."""
        sessions = [self.scene.robot] * len(which) if robots is None else robots
        for i, pose, rng, robot in zip(which, poses, rngs, sessions, strict=True):
            draws = streams(rng)
            start = loop_by_commands(
                STAND,
                robot.drive,
                start=pose,
                footprint_radius_m=robot.footprint_radius_m,
                wheel_errors=draw_wheel_errors(robot.drive, draws["drive"]),
            )
            start.check(self._obstacles)
            self._moved.put(i, start)
            if self._model_error is not None:
                self._offset[i] = self._model_error.in_session(draws["model_error"]).offset
            for name, sensor in self._sensors(robot, draws).items():
                self._sensed[name].put(np.array([i]), type(sensor).stacked([sensor]))
            self._t[i], self._angle[i], self._twist[i] = 0.0, 0.0, 0.0
            self._robots[i] = robot
            self._lidar_s[i] = robot.lidar.phase_s - self.scene.robot.lidar.phase_s
            self._record[i] = 0.0
            self._record[i, :3] = np.array(pose)[:, None]
        self._sense(np.asarray(which), moved=False)

    def step(self, commands: ArrayLike, which: Sequence[int] | NDArray[np.intp] | None = None) -> None:
        """Drive robots for a step, and read their sensors.

        Args:
            commands: Forward speed [m/s] and yaw rate [rad/s] of each, shape (count, 2).
            which: Numbers of the robots. Default: all. The others stay as they are.
        """
        twists = np.asarray(commands, float)
        if twists.shape != (self.count, 2) or not np.isfinite(twists).all():
            got = f"got shape {twists.shape}, {np.count_nonzero(~np.isfinite(twists))} of them not finite"
            raise InputError(f"commands must be finite v [m/s], w [rad/s] of shape {(self.count, 2)}, {got}")
        rows = np.arange(self.count) if which is None else np.asarray(which, np.int64)
        if not len(rows):
            return
        self._record[rows], _ = self._moved.step(0, self._steps, rows, twists=twists[rows], code=self._code)
        self._t[rows] += self.step_s
        self._sense(rows, moved=True)

    def _sense(self, which: NDArray[np.intp], *, moved: bool) -> None:
        """Read the sensors of some robots, after a step or where they begin."""
        robot, drive = self.scene.robot, self.scene.robot.drive
        before = self._moment(which, -1)
        if moved:
            rates = wheel_rates(self._record[which, 5], self._record[which, 6], drive)
            self._angle[which] += np.sum(rates, axis=1) / CONTROL_RATE_HZ
        now = self._moment(which, -1)
        beyond = self.scene.lab.inside_m(now.pose[:, :2]) + 1e-9 < robot.footprint_radius_m
        spins = lidar_on(robot.lidar, self._t[which] + self._lidar_s[which], "schedule")
        table = truth(now, self._t[which], robot.base_height_m)
        table = {name: table[name] for name in table if name in SENSED}
        table |= {"lidar_on": spins, "flag_bump": now.bump | beyond}
        sensed: dict[str, Any] = {name: whole.of(which) for name, whole in self._sensed.items()}
        sample = _stacked_moments([now])
        for name in ("odometry", "imu"):
            values = sensed[name].sample(np.zeros(1), sample)
            table |= {column: value[0] for column, value in values.items()}
        battery: Battery = sensed["battery"]
        if moved:
            v, w = self._twist[which].T
            pair = _stacked_moments([replace(before, v=v, w=w), now])
            drawn = battery.draw(wheels_energy_j(battery.spec, drive, pair), spins[None], self.step_s)
        else:
            drawn = battery.rest(spins[None])
        table |= {column: value[0] for column, value in battery.readings(drawn).items()}
        table |= self._field(which, now, table, drawn.current_a[0], sensed)
        for name, part in sensed.items():
            self._sensed[name].put(which, part)
        self._twist[which] = np.column_stack([now.v, now.w])
        whole = {name: values.copy() for name, values in self._columns.items()}  # earlier tables stay
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

    def _field(
        self,
        which: NDArray[np.intp],
        now: Moment,
        table: Columns,
        supply_a: Array,
        sensed: dict[str, Any],
    ) -> Columns:
        """The map, the disturbance, and the magnetometer's reading of their sum."""
        spec = self.scene.robot.magnetometer
        where = now.pose[:, :2], table["yaw"]
        if self._disturbance_nt is not None:
            b_map, slopes = self._map.lookup_with_gradient(*where, outside="clamp")
        else:
            b_map = self._map.lookup(*where, outside="clamp")
        if np.isnan(b_map).any():  # beside masked nodes
            b_map = np.where(np.isnan(b_map), self._map.mean_nt, b_map)
        error = np.zeros(len(which))
        if self._disturbance_nt is not None:
            sloped = into_base(np.nan_to_num(slopes[:, :2]), table["yaw"])
            known = {"b_map_nt": b_map, "b_map_gradient_nt_m": sloped}
            predicted = self._disturbance_nt(Run(table | known))
            disturbance, sd = predicted if isinstance(predicted, tuple) else (predicted, np.zeros(len(which)))
            if self._model_error is not None:
                process = sensed["error"].next(1)[0]
                error = self._model_error.error_nt(sd, process, self._offset[which])
        elif spec.kind == "physical":
            disturbance = _sizes(self._exact_nt(which, now, table, supply_a, b_map)) - b_map
            disturbance = np.nan_to_num(disturbance)  # a map of one heading is read beside b_map's place
        else:
            disturbance = np.zeros(len(which))
        total = b_map + disturbance
        return {
            "b_map_nt": b_map,
            "b_disturbance_nt": disturbance,
            "b_total_nt": total,
            "b_model_error_nt": error,
            "b_measured_nt": sensed["magnetometer"].noisy((total + error)[None])[0],
        }

    def _exact_nt(
        self, which: NDArray[np.intp], now: Moment, table: Columns, supply_a: Array, b_map: Array
    ) -> Array:
        """The exact field in base_link axes [nT], shape (N, 3)."""
        past = _Past(self._moment(which, max(self._steps - 1 - round(TORQUE_S * CONTROL_RATE_HZ), 0)))
        return self._exact.at_sensor_nt(
            self._scene_of(which),
            past,
            np.maximum(self._t[which], TORQUE_S),  # rows are robots, so times are in no order
            true=now,
            lidar_on=table["lidar_on"],
            supply_a=supply_a,
            at_rest_nt=b_map,
        )

    def _scene_of(self, which: NDArray[np.intp]) -> Scene:
        """The scene with the platforms of some robots in their sessions, a row each."""
        robot = self.scene.robot
        robots = [self._robots[i] for i in which]
        if all(one is robot for one in robots):
            return self.scene
        platform = platforms_of_rows([one.platform for one in robots])
        return replace(self.scene, robot=replace(robot, platform=platform))


def _sizes(vectors: Array) -> Array:
    """Magnitudes of vectors (N, 3), shape (N,)."""
    return np.asarray(np.sqrt(np.sum(vectors * vectors, axis=1)))


def _stacked_moments(moments: Sequence[Moment]) -> Moment:
    """Moments of R robots with time as the first axis, arrays (K, R, ...)."""
    return Moment(**{name: np.stack([getattr(one, name) for one in moments]) for name in _PARTS})


_PARTS = tuple(Moment.__dataclass_fields__)
