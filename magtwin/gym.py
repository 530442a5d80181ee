"""Gymnasium environments: `magtwin/MagNav-v0`, a robot that a policy commands from its sensor readings.

Importing this module registers it. `gymnasium.make` gives one robot, `gymnasium.make_vec` many that step
together in arrays; `docs/gym.md` shows both. Needs the extra `gym`.
"""

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, find
from magtwin.path import Path, check_clear, check_on_floor
from magtwin.run.run import COLUMNS, Run
from magtwin.sim.exact import check_field
from magtwin.sim.motion.drive_input import drive_input
from magtwin.sim.runs.simulate import Predict
from magtwin.sim.runs.stepped import SENSED, SteppedRobots
from magtwin.sim.session import draw_session
from magtwin.spec.scene import Scene
from magtwin.twin import Kind, Twin, room_of
from magtwin.twin.twin import opened

if TYPE_CHECKING:
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer

Array = NDArray[np.float64]

BOUNDS: dict[str, tuple[float, float]] = {
    "b_measured_nt": (0.0, 1e6),
    "odom_p": (-1e3, 1e3),
    "odom_q_xyzw": (-1.0, 1.0),
    "odom_v": (-10.0, 10.0),
    "odom_w": (-50.0, 50.0),
    "imu_q_xyzw": (-1.0, 1.0),
    "imu_w": (-50.0, 50.0),
    "imu_a": (-100.0, 100.0),
    "battery_v": (0.0, 100.0),
    "battery_a": (0.0, 100.0),
    "battery_fraction": (0.0, 1.0),
    "lidar_on": (0.0, 1.0),
    "p_world_base": (-1e3, 1e3),
    "yaw": (-math.pi, math.pi),
    "b_map_nt": (0.0, 1e6),
    "b_total_nt": (0.0, 1e6),
}
"""Observable signals (columns of a Run) and the bounds of their values, in their units."""

SIGNALS = (
    "b_measured_nt",
    "odom_p",
    "odom_q_xyzw",
    "odom_v",
    "odom_w",
    "imu_q_xyzw",
    "imu_w",
    "imu_a",
    "battery_v",
    "battery_fraction",
    "lidar_on",
)
"""Default observation, in this order: what a robot measures without motion capture."""

SEARCH_M = 0.3
"""Distance along the path, ahead and behind, in which a robot is searched after a step [m]."""


@dataclass(frozen=True, eq=False)
class Transition:
    """A step of robots, for which a reward is given; arrays with one robot a row."""

    before: dict[str, NDArray[Any]]
    """Columns before the step; see `magtwin.sim.runs.stepped.SteppedRobots.columns`."""

    after: dict[str, NDArray[Any]]
    """Columns after the step."""

    action: Array
    """Commanded forward speed [m/s] and yaw rate [rad/s], shape (N, 2)."""

    progress_m: Array
    """Progress along the path [m], shape (N,)."""

    off_path_m: Array
    """Distance from the path after the step [m], shape (N,)."""

    step_s: float
    """Length of the step [s]."""


Reward = Callable[[Transition], NDArray[Any]]


def progress(step: Transition) -> Array:
    """Default reward: progress along the path, minus the distance from it times the length of the step [m].

    A robot that drives on the path earns its length. One that stands a metre away loses a metre a second.
    """
    return step.progress_m - step.off_path_m * step.step_s


class MagNavVectorEnv(VectorEnv[Any, Any, Any]):
    """Robots of a scene that step together, each alone in the lab."""

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012 - Gymnasium's

    def __init__(
        self,
        num_envs: int = 1,
        *,
        scene: Twin | Scene | str | FilePath | None = None,
        lab: str = "",
        network: str | FilePath | None = None,
        magnetometer: Kind | None = None,
        model_error: bool = True,
        path: Path | str | FilePath | ArrayLike = "figure8",
        signals: Sequence[str] = SIGNALS,
        reward: Reward = progress,
        step_s: float = 0.1,
        duration_s: float = 60.0,
        end_on_bump: bool = False,
        random_start: bool = False,
        session: Literal["drawn", "survey"] = "drawn",
        render_mode: None = None,
    ) -> None:
        """Open a scene for several robots.

        Args:
            num_envs: How many robots.
            scene: The file of a stage, a `Scene`, or a `Twin`.
            lab: As for `magtwin.open_twin`, if `scene` is a file.
            network: As for `magtwin.open_twin`, if `scene` is a file.
            magnetometer: As for `magtwin.open_twin`, if `scene` is a file.
            model_error: As for `magtwin.simulate`; each episode counts as a session.
            path: Where the robots begin and what they are rewarded for: a path, its name, a CSV file, or
                points in world [m], shape (N, 2).
            signals: Columns of `BOUNDS` that are observed, in this order.
            reward: From a step of N robots to N rewards.
            step_s: Time between commands [s], a multiple of 0.02.
            duration_s: Time after which an episode is truncated [s].
            end_on_bump: Whether touching an obstacle, or the floor's border, ends an episode.
            random_start: Whether robots begin anywhere on the path. Default: at its first point.
            session: "drawn": each episode is a new session, from `magtwin.sim.session.draw_session`: charge,
                IMU zero, LiDAR's phase, wheels, odometry and the robot's own field. "survey": the robot as
                in the survey of the map. A Twin that is in a session stays in it.
            render_mode: Must be None.

        Raises:
            InputError: No scene is given, or one of these is out of range.
        """
        if scene is None:
            raise InputError("MagNav needs a scene: gymnasium.make('magtwin/MagNav-v0', scene='lab.usda')")
        if render_mode is not None:
            raise InputError(f"MagNav has no render_mode, got {render_mode!r}; write a Run and view that")
        twin = opened(scene, network, magnetometer, model_error, "MagNav", lab=lab)
        check_field(twin.scene, twin.field)
        network_read = twin.magnetometer
        if network_read and (missing := sorted(network_read.columns - SENSED)):
            raise InputError(
                f"{network_read.name}: reads {', '.join(missing)}, which MagNav does not simulate; give a "
                'network of other inputs, such as the set "gradient", or take magnetometer="physical"'
            )
        robot = twin.scene.robot
        line = drive_input(path, room_of(twin))
        if not isinstance(line, Path):
            raise InputError(f"path must be a path to drive along, got {line!r}", parameter="path")
        self.path = line
        check_on_floor(self.path, twin.scene.lab, robot.footprint_radius_m)
        check_clear(self.path, twin.obstacles, robot.footprint_radius_m)
        if not callable(reward):
            raise InputError(f"reward must be a function of a Transition, got {reward!r}")
        if not step_s <= duration_s < math.inf:
            raise InputError(f"duration_s must be at least step_s, {step_s:g} s, got {duration_s!r}")
        self.signals = tuple(signals)
        bounds = [find("signal", name, BOUNDS) for name in self.signals]
        if not bounds:
            raise InputError("signals are empty; name at least one")
        widths = [COLUMNS[name].width for name in self.signals]
        self.stepped = SteppedRobots(
            twin.scene,
            num_envs,
            anomaly_map=twin.field,
            obstacles=twin.obstacles,
            step_s=step_s,
            disturbance_nt=_predictions(network_read) if network_read else None,
            model_error=twin.model_error,
        )
        self.num_envs, self.reward, self.end_on_bump = num_envs, reward, end_on_bump
        find("session", session, {"drawn": None, "survey": None})
        self.random_start, self._draws = random_start, session == "drawn" and not twin.session
        self._last_step = math.ceil(duration_s / step_s - 1e-9)
        low, high = np.repeat(np.array(bounds, np.float32).T, widths, axis=1)
        self.single_observation_space = spaces.Box(low, high, dtype=np.float32)
        top = np.array([robot.drive.v_max, robot.drive.w_max], np.float32)
        self.single_action_space = spaces.Box(-top, top, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._s, self._made = np.zeros(num_envs), np.zeros(num_envs, int)
        self._over = np.zeros(num_envs, bool)
        self._begun = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode of every robot.

        Args:
            seed: Seed of the first robot, increased by one for each of the others; or a seed for each. None
                continues the robots' generators.
            options: Not used.

        Returns:
            Observations, shape (num_envs, F), and infos: the true pose, and whether the robot bumps.
        """
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise InputError(f"give one seed for each of the {self.num_envs} robots, got {len(seeds)}")
        for i, own in enumerate(seeds):
            if own is not None or self._rngs[i] is None:
                self._rngs[i] = seeding.np_random(None if own is None else operator.index(own))[0]
        self._begin(np.arange(self.num_envs))
        self._begun = True
        return self._observations(), self._infos()

    def step(
        self, actions: NDArray[Any]
    ) -> tuple[
        NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]
    ]:
        """Command every robot for `step_s`; a robot whose episode is over begins again instead.

        Args:
            actions: Forward speed [m/s] and yaw rate [rad/s] of each, shape (num_envs, 2).

        Returns:
            Observations, rewards, episodes ended by a bump, episodes ended by time, and infos as `reset`.
        """
        if not self._begun:
            raise gymnasium.error.ResetNeeded("call reset before step")
        again, action = self._over.copy(), np.asarray(actions, float)
        before, s = self.stepped.columns, self._s
        self.stepped.step(action, np.flatnonzero(~again))
        after = self.stepped.columns
        self._s, off = _on_path(self.path, s, after["p_world_base"][:, :2])
        step = Transition(before, after, action, self._s - s, off, self.stepped.step_s)
        rewards = np.asarray(self.reward(step), float)
        if rewards.shape != (self.num_envs,):
            raise InputError(f"reward must give shape {(self.num_envs,)}, got {rewards.shape}")
        self._made += 1
        ended = after["flag_bump"] & self.end_on_bump & ~again
        truncated = (self._made >= self._last_step) & ~ended & ~again
        if again.any():
            self._begin(np.flatnonzero(again))
        self._over = ended | truncated
        return self._observations(), np.where(again, 0.0, rewards), ended, truncated, self._infos()

    def _begin(self, which: NDArray[np.intp]) -> None:
        """Place robots on the path."""
        rngs: list[np.random.Generator] = [rng for i in which if (rng := self._rngs[i]) is not None]
        for i, rng in zip(which, rngs, strict=True):
            self._s[i] = rng.uniform(0.0, self.path.length) if self.random_start else 0.0
        xy, heading = self.path.at(self._s[which]), self.path.heading(self._s[which])
        poses = [(float(x), float(y), float(yaw)) for (x, y), yaw in zip(xy, heading, strict=True)]
        robot = self.stepped.scene.robot
        drawn = [draw_session(robot, rng) for rng in rngs] if self._draws else None
        self.stepped.begin(which.tolist(), poses, rngs, drawn)
        self._made[which], self._over[which] = 0, False

    def _observations(self) -> NDArray[np.float32]:
        columns = self.stepped.columns
        parts = [np.reshape(columns[name], (self.num_envs, -1)) for name in self.signals]
        box = self.single_observation_space
        assert isinstance(box, spaces.Box)
        return np.clip(np.concatenate(parts, axis=1).astype(np.float32), box.low, box.high)

    def _infos(self) -> dict[str, Any]:
        """True poses and bumps, in Gymnasium's form of vector infos."""
        columns, known = self.stepped.columns, np.ones(self.num_envs, bool)
        infos: dict[str, Any] = {
            "p_world_base": columns["p_world_base"].copy(),
            "yaw": columns["yaw"].copy(),
            "bump": columns["flag_bump"].copy(),
        }
        return infos | {f"_{name}": known.copy() for name in infos}


class MagNavEnv(gymnasium.Env[Any, Any]):
    """One robot of a scene; arguments are those of `MagNavVectorEnv` without `num_envs`."""

    metadata = {"render_modes": []}  # noqa: RUF012 - Gymnasium's

    def __init__(self, *, render_mode: None = None, **options: Any) -> None:
        """Open a scene for a robot."""
        self.robots = MagNavVectorEnv(1, render_mode=render_mode, **options)
        self.render_mode = render_mode
        self.observation_space = self.robots.single_observation_space
        self.action_space = self.robots.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin an episode; as `MagNavVectorEnv.reset`."""
        super().reset(seed=seed)
        self.robots._rngs = [self.np_random]
        observations, infos = self.robots.reset()
        return observations[0], _first(infos)

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Command the robot for `step_s`; as `MagNavVectorEnv.step`."""
        self.robots._over[:] = False  # a step after the end of an episode drives on
        actions = np.asarray(action, float)[None]
        observations, rewards, ended, truncated, infos = self.robots.step(actions)
        return observations[0], float(rewards[0]), bool(ended[0]), bool(truncated[0]), _first(infos)


def _predictions(network: "NeuralMagnetometer") -> Predict:
    """A function from a table of robots to a network's predictions and their standard deviations."""

    def predictions(table: Run) -> tuple[Array, Array]:
        (read,) = network.read([table], outside=False, known=[True])
        return read.disturbance_nt, read.sd_nt

    return predictions


def _first(infos: dict[str, Any]) -> dict[str, Any]:
    """The info of the first robot."""
    return {name: values[0] for name, values in infos.items() if not name.startswith("_")}


def _on_path(path: Path, s: Array, p_xy: Array) -> tuple[Array, Array]:
    """Arc lengths of robots on a path, to a centimetre, and their distances from it [m], each (N,).

    Args:
        path: The path.
        s: Arc lengths before the step, which grow over the laps of a closed path [m], shape (N,).
        p_xy: Places of the robots [m], shape (N, 2).
    """
    tried = s[:, None] + np.linspace(-SEARCH_M, SEARCH_M, 61)
    if not path.closed:
        tried = np.clip(tried, 0.0, path.length)
    away = np.linalg.norm(path.at(tried) - p_xy[:, None], axis=2)
    best = np.argmin(away, axis=1)
    rows = np.arange(len(s))
    return tried[rows, best], away[rows, best]


gymnasium.register(
    "magtwin/MagNav-v0", entry_point="magtwin.gym:MagNavEnv", vector_entry_point="magtwin.gym:MagNavVectorEnv"
)
