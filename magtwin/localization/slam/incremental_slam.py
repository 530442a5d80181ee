"""Incremental SLAM: an extended Kalman filter of the pose and of the field's weights together.

It is relinearised at the most probable trajectory until now.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.localization.problem import Estimate, Problem, Reading
from magtwin.localization.slam.batch import FAR, Batch, joined
from magtwin.localization.slam.model import Model, State
from magtwin.localization.slam.samples import Samples, followed_by, has_vector, samples_of
from magtwin.localization.slam.settings import Settings

Array = NDArray[np.float64]

ITERATIONS = 2
"""Gauss-Newton iterations of a solution."""

RESTART = 100
"""Readings between two attempts to find a better trajectory from dead reckoning, with annealed noise."""

LAST = 6
"""Iterations at the true noise after annealing."""


@dataclass(kw_only=True)
class IncrementalSlam(Settings):
    """Extended Kalman filter that solves for all poses until now at regular intervals.

        x' = move(x),  P' = F P F' + Q
        S = H P H' + r I,  K = P H' S^-1,  x += K (y - measure(x)),  P -= K S K'

    (Viset, Helmons and Kok 2022, Sensors 22(8), 2833, algorithm 1), over the robot's state and the constants
    of `magtwin.localization.slam.model`. At a solution, Gauss-Newton relinearises every pose since the start
    (`magtwin.localization.slam.batch`), and the filter takes the joint mean and covariance of the last pose
    and the constants, as of the last iteration. An estimate uses no later reading.

    It uses the three axes `b_vector_measured_nt` with odometry in three dimensions if the first reading has
    them, else the magnitude with x, y and yaw. It ignores `Problem.belief`.
    """

    every: int = 15
    """Readings between two solutions. More than the run has: the filter alone, which linearises each reading
    once and states too small a covariance."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (isinstance(self.every, int) and self.every >= 1):
            raise InputError(f"every must be a whole number from 1, got {self.every!r}", parameter="every")

    def reset(self, problem: Problem) -> None:
        """Begin a run."""
        self._problem = problem
        self.model: Model | None = None
        self._last: Samples | None = None
        self._samples: list[Samples] = []
        self._states: list[State] = []
        self._fresh = self._since = 0

    def step(self, reading: Reading) -> Estimate:
        """Move by the odometry, use the field reading, and solve for all poses when it is time."""
        if self.model is None:
            vector = has_vector(reading)
            sample = samples_of([reading], vector)
            self._begin(Model(self._problem, self, sample, vector))
        else:
            sample = samples_of([reading], self.model.vector)
            self._move(sample)
        self._last = sample
        if np.isfinite(sample.y_nt).all():
            self._update(sample)
        self._samples.append(sample)
        self._states.append(self.state)
        self._fresh += 1
        self._since += 1
        if self._fresh >= self.every:
            self._solve()
        return self._estimate(reading.t)

    def trajectory(self) -> tuple[Samples, State]:
        """All samples and the most probable states until now, as of the last solution."""
        return followed_by(self._samples), joined(self._states)

    def _begin(self, model: Model) -> None:
        self.model, self.state = model, model.start
        self.covariance: Array = np.diag(np.concatenate([model.start_variance, model.constants_variance]))
        self._noise = self._problem.sensor.white_nt**2

    def _move(self, sample: Samples) -> None:
        assert self.model is not None
        assert self._last is not None
        size, motion = self.model.size, self.model.layout.motion.stop
        steps = self.model.steps(followed_by([self._last, sample]))
        self.state, by_state, by_constants = self.model.move(self.state, steps)
        covariance = self.covariance
        rows = by_state[0] @ covariance[:size]
        if motion:
            rows += by_constants[0] @ covariance[size : size + motion]
        own = rows[:, :size] @ by_state[0].T + rows[:, size : size + motion] @ by_constants[0].T
        covariance[:size, size:], covariance[size:, :size] = rows[:, size:], rows[:, size:].T
        covariance[:size, :size] = (own + own.T) / 2
        covariance[range(size), range(size)] += steps.variance[0]

    def _update(self, sample: Samples) -> None:
        assert self.model is not None
        size = self.model.size
        expected, by_state, by_constants = self.model.measure(self.state)
        h = np.concatenate([by_state[0], by_constants[0]], axis=1)
        spread = h @ self.covariance
        s = spread @ h.T + (self._noise + sample.extra_nt2[0]) * np.eye(len(h))
        root = np.linalg.inv(np.linalg.cholesky(s))
        half = root @ spread  # its square is K S K'
        error = half.T @ (root @ (sample.y_nt[0] - expected[0]))
        self.state = self.model.add(self.state, error[None, :size], error[size:])
        self.covariance -= half.T @ half

    def _estimate(self, t: float) -> Estimate:
        assert self.model is not None
        size = self.model.size
        p, R, drift, _ = self.state
        return self.model.estimate(t, p[0], R[0], self.covariance[:size, :size], drift[0])

    def _solve(self) -> None:
        assert self.model is not None
        self._fresh = 0
        samples, state = self.trajectory()
        self._samples = [samples]
        batch = Batch(self.model, samples)
        state, cost, solution = batch.solved(state, ITERATIONS)
        if self._since >= RESTART:
            self._since = 0
            found, lower = batch.annealed(batch.dead_reckoning(), (*FAR, (1.0, LAST)))
            if lower < cost:
                state, _, solution = batch.solved(found, 1)
        self._states = [state]
        self.state = State(state.p[-1:], state.R[-1:], state.drift[-1:], state.g)
        self.covariance = np.ascontiguousarray(solution.last_covariance())
