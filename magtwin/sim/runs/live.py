"""LiveRobot: a robot that is commanded while it drives, with its sensors read step by step.

If `simulate` drives the same commands from the same seed, it gives the same columns.
"""

from array import array
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.field.maps.map import AnomalyMap
from magtwin.run.run import Run
from magtwin.sim.motion.closed_loop import Chassis
from magtwin.sim.motion.commands import Commands
from magtwin.sim.motion.drive import Moment, draw_wheel_errors, moment_in_steps, wheel_rates
from magtwin.sim.runs.driving import course_of
from magtwin.sim.runs.neighbours import Neighbour
from magtwin.sim.runs.sensing import Conditions, Sensing, streams
from magtwin.sim.runs.simulate import Finish, Sensed, check_run, run_metadata
from magtwin.sim.sensors.clock import Samples
from magtwin.sim.sensors.lidar import Scanner, Scans
from magtwin.spec.drive import DriveSpec
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]
KEPT = 256
"""Control steps that are kept: 5 s, more than any sensor needs."""


class Track:
    """The last steps of a chassis, as a motion."""

    def __init__(self, drive: DriveSpec, dt: float, pose0: tuple[float, float, float]) -> None:
        """Begin at rest."""
        self._drive, self._dt = drive, dt
        self._first, self._count = 0, 0
        self._steps = np.zeros((2 * KEPT, 13))
        self._pose = np.array(pose0, float)
        self._turned = np.zeros(2)  # sum of rates, as in a Motion
        self._v = 0.0

    @property
    def steps(self) -> int:
        """Number of steps so far."""
        return self._first + self._count

    @property
    def end_s(self) -> float:
        """Time at the end of the last step [s]."""
        return self.steps * self._dt

    duration_s = end_s

    def add(self, record: Array) -> None:
        """Add a step; see `magtwin.sim.motion.loop.RECORD`."""
        if self._count == len(self._steps):
            self._steps[:KEPT] = self._steps[KEPT:]
            self._first, self._count = self._first + KEPT, KEPT
        x, y, yaw, v, w, wheel_v, wheel_w, v_cmd, w_cmd, bump = record
        rates = wheel_rates(wheel_v, wheel_w, self._drive)
        row = self._steps[self._count]
        row[:3], row[3:5], row[5:7] = self._pose, self._turned * self._dt, rates
        row[7:] = v, w, (v - self._v) / self._dt, v_cmd, w_cmd, bump
        self._pose, self._v = np.array([x, y, yaw]), v
        self._turned = self._turned + rates
        self._count += 1

    def at(self, t: Any) -> Moment:
        """As `magtwin.sim.motion.drive.Motion.at`, for times within the kept steps."""
        steps = self._steps[: self._count]
        return moment_in_steps(steps, self._dt, np.asarray(t, float), first=self._first)


class LiveRobot:
    """A robot of a scene that is commanded step by step."""

    def __init__(
        self,
        scene: Scene,
        *,
        anomaly_map: AnomalyMap,
        rng: np.random.Generator,
        network: bool = False,
        finish: Finish = Sensed.read,
        **options: Any,
    ) -> None:
        """Put it at the scene's start, at rest; arguments as for `magtwin.sim.runs.simulate.simulate`."""
        conditions = Conditions(anomaly_map=anomaly_map, network=network, **options)
        robot, obstacles, stand = scene.robot, conditions.obstacles, Commands("live", np.zeros((1, 3)))
        check_run(scene, stand, conditions)
        loop = course_of(scene, stand, 0.0, conditions).loop
        assert loop is not None
        self.step_s, draws = loop.dt, streams(rng)
        errors = draw_wheel_errors(robot.drive, draws["drive"])
        self._chassis = Chassis(replace(loop, wheel_errors=errors), obstacles)
        self._track = Track(robot.drive, self.step_s, scene.start)
        self._finish, self._height_m = finish, robot.base_height_m
        self._robot, self._neighbours = robot, list[Neighbour]()
        self._sensing = Sensing(scene, draws, conditions, neighbours=self._neighbours)
        self.rate_hz = self._sensing.rate_hz
        self._scanner = Scanner(robot, obstacles, draws["lidar"])
        self._readings = 0
        self._commands = array("d")  # three numbers a command: a live robot drives for hours
        self._metadata = {**run_metadata(self._sensing), "controller": "commands"}

    @property
    def t(self) -> float:
        """Time at the end of the last step [s]."""
        return self._track.end_s

    @property
    def pose(self) -> tuple[float, float, float]:
        """Pose at the end of the last step: x [m], y [m], yaw [rad] in world."""
        return self._chassis.pose

    @property
    def commands(self) -> Commands:
        """The commands so far; `simulate` drives the same run from them."""
        end = (self._track.steps * self.step_s, 0.0, 0.0)
        return Commands("live", np.vstack([np.zeros(3), np.array(self._commands).reshape(-1, 3), end]))

    def beside(self, others: "Iterable[LiveRobot]") -> None:
        """Put other robots into the lab, which this one senses as in `magtwin.sim.runs.multi_robot`.

        Robots beside each other must `drive` all before any of them is `read`.
        """
        self._neighbours += [Neighbour(other._robot, other._track) for other in others]

    def step(self, command: tuple[float, float] | None = None) -> Run:
        """Drive on for a control step, and read the sensors in its time: `drive`, then `read`.

        Args:
            command: Forward speed [m/s] and yaw rate [rad/s]. None keeps the last command until the drive's
                command_timeout_s is over. In the first step the robot stands.

        Returns:
            The readings in the step's time, every column of `COLUMNS`; there may be none.
        """
        self.drive(command)
        return self.read()

    def drive(self, command: tuple[float, float] | None = None) -> None:
        """Drive on for a control step; the command is as for `step`."""
        begin = self._track.end_s
        if begin == 0:
            command = (0.0, 0.0)
        self._track.add(self._chassis.step(command))
        if command is not None and begin > 0:
            self._commands.extend((begin, *command))

    def scans(self) -> Scans:
        """The LiDAR's scans whose time lay in the last step, with the times at which they will arrive."""

        def poses(t: Array) -> Array:
            x, y, yaw = self._track.at(t).pose.T
            return np.column_stack([x, y, np.full(len(t), self._height_m), yaw])

        return self._scanner.scan(self._track.end_s, poses, self._sensing.lidar_on)

    def samples(self) -> dict[str, list[Samples]]:
        """The samples of odometry, imu, mocap and battery since the last call, by these names."""
        return {name: sensor.clock.take_fresh() for name, sensor in self._sensing.sampled.items()}

    def read(self) -> Run:
        """The readings in the time of the last step; see `step`."""
        until = self._track.end_s
        count = int(np.ceil(until * self.rate_hz - 1e-9))
        t = np.arange(self._readings, count) / self.rate_hz
        self._readings = count
        columns = self._sensing.sense(self._track, t, until)
        return self._finish(Sensed(Run(columns, self._metadata, self._sensing.specs), self._sensing))
