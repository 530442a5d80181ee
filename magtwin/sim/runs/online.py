"""Online: a robot that is commanded while it drives, its sensors read step by step.

What `simulate` gives for commands that are known beforehand, an `Online` robot gives for those that come as
it goes on: driven again by the commands that were taken, from the same seed, `simulate` gives the same
columns (`online_sensors.py` says how nearly).
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import quat_from_yaw, quat_multiply, rotate
from magtwin.run.run import COLUMNS, Run
from magtwin.sim.exact import ExactField
from magtwin.sim.interference import level_gradient_nt_m, sensor_places
from magtwin.sim.motion.commands import Commands
from magtwin.sim.motion.course import Chassis
from magtwin.sim.motion.drive import Moment, advance, draw_wheel_errors, wheel_rates
from magtwin.sim.motion.follow import CONTROL_RATE_HZ
from magtwin.sim.motion.manual import at_start
from magtwin.sim.runs.simulate import add_error, check_run, exact_field, flags, mapped, streams, truth
from magtwin.sim.sensors.lidar import Scans, lidar_on, scan
from magtwin.sim.sensors.magnetometer import LOCK_RATE_HZ, rounded
from magtwin.sim.sensors.model_error import ModelError
from magtwin.sim.sensors.online_sensors import Battery, Imu, Magnetometer, Markov, Mocap, Odometry, Samples
from magtwin.spec.drive import DriveSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]
Network = Callable[[Run], tuple[NDArray[Any], NDArray[Any], "NDArray[np.bool_] | None"]]
"""From rows of a run to the disturbance of each, the standard deviation of its error [nT], and whether it is
out of the training's range. Rows come in the order of time, each once."""

STANDS_S = 0.06
"""For so long a robot stands at first, whatever it is commanded: its battery's first step is that of rest."""

KEPT = 256
"""Control steps that are kept: 5 s, more than any sensor looks back."""


class Track:
    """The last steps of a chassis, as `magtwin.sim.motion.drive.Motion` tells all of them."""

    def __init__(self, drive: DriveSpec, dt: float, pose0: tuple[float, float, float]) -> None:
        """Begin at rest."""
        self._drive, self._dt = drive, dt
        self._first, self._count = 0, 0
        self._steps = np.zeros((2 * KEPT, 13))
        self._pose = np.array(pose0, float)
        self._turned = np.zeros(2)  # the sum of rates, which a Motion multiplies by dt once
        self._v = 0.0

    @property
    def steps(self) -> int:
        """How many steps have been made."""
        return self._first + self._count

    @property
    def end_s(self) -> float:
        """Time at the end of the last step [s]."""
        return self.steps * self._dt

    def add(self, record: Array) -> None:
        """A step, as `magtwin.sim.motion.loop.RECORD` tells it."""
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
        """As `magtwin.sim.motion.drive.Motion.at`, of times within the steps that are kept."""
        t = np.asarray(t, float)
        starts = np.arange(self._first, self.steps) * self._dt
        k = np.maximum(np.searchsorted(starts, t, side="right") - 1, 0)
        into = np.clip(t - starts[k], 0.0, self._dt)
        then = self._steps[: self._count].take(k, axis=0)
        v, w, a, v_cmd, w_cmd, bump = then[:, 7:].T
        pose = advance(then[:, :3], v, w, into)
        turned = then[:, 3:5] + then[:, 5:7] * into[:, None]
        return Moment(pose=pose, v=v, w=w, a=a, wheel_angle=turned, v_cmd=v_cmd, w_cmd=w_cmd, bump=bump > 0)


class Online:
    """A robot of a scene, commanded step by step."""

    def __init__(
        self,
        scene: Scene,
        *,
        anomaly_map: AnomalyMap,
        rng: np.random.Generator,
        obstacles: Obstacles | None = None,
        rate_hz: float | None = None,
        network: Network | None = None,
        model_error: ModelError | None = None,
        outside: Literal["nan", "clamp"] = "nan",
        lidar: Literal["schedule", "on", "off"] = "schedule",
    ) -> None:
        """Put it at the scene's start, at rest.

        Args:
            scene: As for `magtwin.sim.runs.simulate.simulate`, as all that follows.
            anomaly_map: What `scene.map_layer` holds.
            rng: Source of all noise.
            obstacles: What stops it, and what its LiDAR sees.
            rate_hz: Magnetometer readings a second [Hz]; None takes the scene's.
            network: What predicts the disturbance of a neural magnetometer.
            model_error: Statistics of the error of these predictions; None draws none.
            outside: What the map reads outside its extent.
            lidar: Whether the LiDAR follows its schedule, or stays on or off.

        Raises:
            InputError: It would begin in an obstacle, or an option is out of range.
        """
        robot, obstacles = scene.robot, obstacles or Obstacles()
        still = Commands("online", np.zeros((1, 3)))
        self.rate_hz = check_run(
            scene,
            still,
            anomaly_map=anomaly_map,
            rate_hz=rate_hz,
            duration_s=None,
            lidar=lidar,
            network=network is not None,
        )
        self.step_s = 1.0 / CONTROL_RATE_HZ
        draws = streams(rng)
        errors = draw_wheel_errors(robot.drive, draws["drive"])
        radius = robot.footprint_radius_m
        self._chassis: Chassis = at_start(robot.drive, scene.start, obstacles, radius, errors, self.step_s)
        self._track = Track(robot.drive, self.step_s, scene.start)
        self._scene, self._map, self._outside, self._network = scene, anomaly_map, outside, network
        self._lidar_on = partial(lidar_on, robot.lidar, mode=lidar)
        self._odometry = Odometry(robot.drive, draws["odometry"])
        self._imu = Imu(robot.imu, robot.q_base_imu_xyzw, draws["imu"])
        self._mocap = Mocap(robot.mocap, robot.base_height_m, draws["mocap"])
        self._battery = Battery(robot.battery, robot.drive, self._lidar_on, draws["battery"])
        self._magnetometer = Magnetometer(robot.magnetometer, self.rate_hz, draws["magnetometer"])
        self._model_error, self._error_rng = model_error, draws["model_error"]
        self._wandering = Markov(model_error.time_s if model_error else 0.0, self.rate_hz)
        self._scanner = Scanner(scene, obstacles, self._lidar_on, draws["lidar"])
        self._readings, self._looks, self._steep = 0, 0, False
        self._rows: list[tuple[float, float, float]] = []
        self._exact = ExactField(scene=scene, anomaly_map=anomaly_map, outside=outside)
        physical = network is None and robot.magnetometer.kind == "physical"
        self._known = self._exact.of == "sources" or (self._exact.of == "map" and physical)
        self._metadata: dict[str, str | int | float | bool]
        self._metadata = {"scene": scene.name, "controller": "commands", "rate_hz": float(self.rate_hz)}
        self._metadata |= {"lidar": lidar, "magnetometer": "neural" if network else robot.magnetometer.kind}
        self._metadata |= self._exact.metadata if physical else {}

    @property
    def t(self) -> float:
        """Time at the end of the last step [s]."""
        return self._track.end_s

    @property
    def pose(self) -> tuple[float, float, float]:
        """Where it is at the end of the last step: x [m], y [m], yaw [rad] in world."""
        return self._chassis.pose

    @property
    def commands(self) -> Commands:
        """The commands that were taken, which `simulate` drives again."""
        end = (self._track.steps * self.step_s, 0.0, 0.0)
        return Commands("online", np.array([(0.0, 0.0, 0.0), *self._rows, end]))

    def step(self, command: tuple[float, float] | None = None) -> Run:
        """Drive on for a control step, and read the sensors in its time.

        Args:
            command: Forward speed [m/s] and yaw rate [rad/s]; none is no news: the last one holds until the
                drive's command_timeout_s is over.

        Returns:
            The readings of the time from the step's begin to before its end, every column of `COLUMNS`; there
            may be none.

        Raises:
            InputError: The command is not finite.
        """
        begin = self._track.end_s
        if begin < STANDS_S - 1e-9:
            command = (0.0, 0.0)
        self._chassis.step(command)
        if command is not None and begin > 0:
            self._rows.append((begin, *command))
        self._track.add(self._chassis.last)
        return self._read()

    def scans(self) -> Scans:
        """What the LiDAR saw in the last step, as it will arrive: scans whose moment lay in it."""
        return self._scanner.until(self._track)

    def samples(self) -> dict[str, list[Samples]]:
        """What odometry, IMU, motion capture and battery read since the last time, by those names."""
        queues = {
            "odometry": self._odometry.held,
            "imu": self._imu.held,
            "mocap": self._mocap.held,
            "battery": self._battery.held,
        }
        taken = {}
        for name, queue in queues.items():
            taken[name], queue.fresh = queue.fresh, []
        return taken

    def _read(self) -> Run:
        until = self._track.end_s
        count = int(np.ceil(until * self.rate_hz - 1e-9)) - self._readings
        t = np.arange(self._readings, self._readings + count) / self.rate_hz
        self._readings += count
        track, scene, robot = self._track, self._scene, self._scene.robot
        true = track.at(t)
        columns = truth(true, t, robot.base_height_m)
        for sensor in (self._odometry, self._imu, self._mocap, self._battery):
            columns |= sensor.sense(track, t, until)
        supply_a = columns.pop("supply_a")
        columns["lidar_on"] = self._lidar_on(t)
        columns |= mapped(self._map, true.pose[:, :2], columns["yaw"], self._outside, gradient=True)
        known = self._exact if self._known and count else None
        columns |= exact_field(known, scene, track, t, true, columns, supply_a)
        vector = columns["b_vector_nt"]
        columns["b_vector_measured_nt"], lost = self._magnetometer.axes(vector, self._steepness(t))
        dropped = self._magnetometer.dropped(count)
        columns["b_vector_measured_nt"][dropped] = np.nan
        columns |= flags(scene, true)
        columns["b_sd_nt"], error = np.full(count, np.nan), np.zeros(count)
        if self._network is not None:
            disturbance, sd, beyond = self._network(Run(columns, self._metadata))
            if self._model_error is not None:
                process = self._wandering.next(self._error_rng.standard_normal(count))
                error = rounded(self._model_error.error_nt(sd, process), robot.magnetometer.resolution_nt)
            density = robot.magnetometer.noise_density_nt
            columns["b_sd_nt"] = np.hypot(sd, density * np.sqrt(self.rate_hz / 2))
            if beyond is not None:
                columns["flag_out_of_distribution"] = beyond
        elif robot.magnetometer.kind == "physical":
            disturbance = columns["b_truth_nt"] - columns["b_map_nt"]
        else:
            disturbance = np.zeros(count)
        columns["b_disturbance_nt"] = np.asarray(disturbance, float)
        columns["b_total_nt"] = columns["b_map_nt"] + columns["b_disturbance_nt"]
        columns["b_model_error_nt"] = error
        columns |= self._magnetometer.read(columns["b_total_nt"], vector, lost)
        columns["b_measured_nt"][dropped] = np.nan
        columns["b_noise_nt"] = columns["b_measured_nt"] - columns["b_total_nt"]
        add_error(columns)
        return Run({name: columns[name] for name in COLUMNS if name in columns}, self._metadata)

    def _steepness(self, t: Array) -> NDArray[np.bool_]:
        """Whether lock is lost to the gradient at each reading, as it is looked at `LOCK_RATE_HZ`."""
        spec, steep = self._scene.robot.magnetometer, np.zeros(len(t), bool)
        if not spec.gradient_max_nt_m:
            return steep
        for k, look in enumerate((t * LOCK_RATE_HZ + 1e-9).astype(int)):
            while self._looks <= look:
                self._look(self._looks / LOCK_RATE_HZ)
                self._looks += 1
            steep[k] = self._steep
        return steep

    def _look(self, t: float) -> None:
        spec, scene = self._scene.robot.magnetometer, self._scene
        pose = self._track.at(np.array([t])).pose
        if self._exact.of != "sources":
            gradient = float(np.hypot(*self._map.gradient(pose[:, :2], pose[:, 2])[0, :2]))
        else:
            places = sensor_places(scene.robot, pose)
            gradient = float(level_gradient_nt_m(scene, places[:, :2], places[0, 2])[0])
        if gradient > spec.gradient_max_nt_m:
            self._steep = True
        elif gradient < spec.gradient_relock_nt_m:
            self._steep = False


class Scanner:
    """The LiDAR: `magtwin.sim.sensors.lidar.scans_of`, step by step, at the robot's true pose at each
    moment.
    """

    def __init__(
        self,
        scene: Scene,
        obstacles: Obstacles,
        on: Callable[[Array], NDArray[np.bool_]],
        rng: np.random.Generator,
    ) -> None:
        self._robot, self._obstacles, self._on = scene.robot, obstacles, on
        self._delays, self._noise = rng.spawn(2)
        self._next, self._last = 0, -np.inf

    def until(self, track: Track) -> Scans:
        """The scans whose moment has come since the last time, with the times at which they arrive."""
        spec, robot = self._robot.lidar, self._robot
        taken: list[tuple[float, float, Array, Array, Array]] = []
        while spec.scan_rate_hz and self._next / spec.scan_rate_hz < track.end_s - 1e-9:
            t = self._next / spec.scan_rate_hz
            self._next += 1
            late = spec.latency_s + spec.jitter_s * self._delays.exponential(1.0)
            self._last = max(self._last, t + late)
            if not self._on(np.array(t)):
                continue
            x, y, yaw = track.at(np.array([t])).pose[0].tolist()
            q_base = quat_from_yaw(yaw)
            p = np.array([x, y, robot.base_height_m]) + rotate(q_base, np.array(robot.p_base_lidar))
            q = quat_multiply(q_base, robot.q_base_lidar_xyzw)
            ranges = scan(self._obstacles, (p, q), spec, self._noise)
            taken.append((t, self._last, p, q, ranges))
        rays = np.array([one[4] for one in taken], np.float32).reshape(-1, spec.rays)
        return Scans(
            np.array([one[0] for one in taken]),
            np.array([one[1] for one in taken]),
            np.array([one[2] for one in taken]).reshape(-1, 3),
            np.array([one[3] for one in taken]).reshape(-1, 4),
            rays,
        )
