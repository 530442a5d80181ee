"""EKF-SLAM: an extended Kalman filter of the pose and of the field's weights together."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.localization.problem import Estimate, Problem, Reading
from magtwin.localization.slam.model import Model
from magtwin.localization.slam.samples import Samples, followed_by, is_vector, samples_of
from magtwin.localization.slam.settings import Settings

Array = NDArray[np.float64]


@dataclass(kw_only=True)
class EkfSlam(Settings):
    """Extended Kalman filter over the robot's state and the constants of `magtwin.localization.slam.model`.

        x' = move(x),  P' = F P F' + Q
        S = H P H' + r I,  K = P H' S^-1,  x += K (y - measure(x)),  P -= K S K'

    (Viset, Helmons and Kok 2022, Sensors 22(8), 2833, algorithm 1.) It uses the three axes
    `b_vector_measured_nt` with odometry in three dimensions, or the magnitude with x, y and yaw. It ignores
    `Problem.belief`.
    """

    def reset(self, problem: Problem) -> None:
        """Begin a run."""
        self._problem = problem
        self.model: Model | None = None
        self._last: Samples | None = None

    def step(self, reading: Reading) -> Estimate:
        """Move by the increment of odometry, then use the field reading."""
        if self.model is None:
            vector = is_vector(self.field, reading)
            sample = samples_of([reading], vector)
            self._begin(Model(self._problem, self, sample, vector))
        else:
            sample = samples_of([reading], self.model.vector)
            self._move(sample)
        self._last = sample
        if np.isfinite(sample.y_nt).all():
            self._update(sample)
        return self._estimate(reading.t)

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
