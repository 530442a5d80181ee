"""Incremental SLAM: a causal filter that is relinearised at the most probable trajectory until now."""

from dataclasses import dataclass

import numpy as np

from magtwin.errors import InputError
from magtwin.localization.problem import Estimate, Problem, Reading
from magtwin.localization.slam.batch import FAR, Batch, joined
from magtwin.localization.slam.ekf_slam import EkfSlam
from magtwin.localization.slam.model import State
from magtwin.localization.slam.samples import Samples, followed_by

LAST = 6
"""Iterations at the true noise after annealing."""


@dataclass(kw_only=True)
class IncrementalSlam(EkfSlam):
    """EKF-SLAM that solves for all poses until now at regular intervals, and goes on from the solution.

    Between two solutions it is `EkfSlam`. At a solution, Gauss-Newton relinearises every pose since the start
    (`magtwin.localization.slam.batch`), and the filter takes the joint mean and covariance of the last pose
    and the constants, as of the last iteration. An estimate uses no later reading.
    """

    every: int = 15
    """Readings between two solutions."""

    iterations: int = 2
    """Gauss-Newton iterations of a solution."""

    restart: int = 100
    """Readings between two attempts to find a better trajectory from dead reckoning, with annealed noise."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("every", "iterations", "restart"):
            if not (isinstance(getattr(self, name), int) and getattr(self, name) >= 1):
                raise InputError(f"{name} must be a whole number from 1", parameter=name)

    def reset(self, problem: Problem) -> None:
        """Begin a run."""
        super().reset(problem)
        self._samples: list[Samples] = []
        self._states: list[State] = []
        self._fresh = self._since = 0

    def step(self, reading: Reading) -> Estimate:
        """Move and update as `EkfSlam`; solve for all poses when it is time."""
        estimate = super().step(reading)
        assert self._last is not None
        self._samples.append(self._last)
        self._states.append(self.state)
        self._fresh += 1
        self._since += 1
        if self._fresh < self.every:
            return estimate
        self._solve()
        return self._estimate(reading.t)

    def trajectory(self) -> tuple[Samples, State]:
        """All samples and the most probable states until now, as of the last solution."""
        return followed_by(self._samples), joined(self._states)

    def _solve(self) -> None:
        assert self.model is not None
        self._fresh = 0
        samples, state = self.trajectory()
        self._samples = [samples]
        batch = Batch(self.model, samples)
        state, cost, solution = batch.solved(state, self.iterations)
        if self._since >= self.restart:
            self._since = 0
            found, lower = batch.annealed(batch.dead_reckoning(), (*FAR, (1.0, LAST)))
            if lower < cost:
                state, _, solution = batch.solved(found, 1)
        self._states = [state]
        self.state = State(state.p[-1:], state.R[-1:], state.drift[-1:], state.g)
        self.covariance = np.ascontiguousarray(solution.last_covariance())
