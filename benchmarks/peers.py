"""Filters of other libraries as contestants: an EKF of filterpy and a particle filter of Stone Soup.

    make bench-peers

Both are textbook filters with the problem's noise models: the state is x, y, yaw, the offset of the reading
and the two terms of the session's iron; drift and map error count as white noise.
"""

import math
from datetime import datetime, timedelta

import numpy as np

from magtwin.localization.problem import Estimate, Problem, Reading

PARTICLES = 2000
STATES = 6


def moved(before: Reading, now: Reading) -> tuple[float, float, float]:
    """Forward, leftward [m] and turn [rad] by the odometry, in the robot's axes before."""
    (x0, y0, yaw0), (x1, y1, yaw1) = before.odometry, now.odometry
    c, s = math.cos(yaw0), math.sin(yaw0)
    return (x1 - x0) * c + (y1 - y0) * s, (y1 - y0) * c - (x1 - x0) * s, yaw1 - yaw0


class _Model:
    """Noise, prior and expected readings of a problem."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        sensor = problem.sensor
        mean, sd = problem.start
        self.mean = np.array([*mean, 0.0, 0.0, 0.0])
        self.sd = np.array([*sd, sensor.offset_nt, *[max(sensor.iron_nt, 1e-3)] * 2])
        variance = float(np.nanmean(problem.belief.variance([self.mean[:2]], self.mean[2:3])))
        self.white = sensor.white_nt**2 + sensor.drift_nt**2 + (0.0 if math.isnan(variance) else variance)

    def expected(self, state: np.ndarray) -> np.ndarray:
        """Readings at states, shape (6, N); nan off the map."""
        x, y, yaw, offset, c, s = state
        ax, ay = self.problem.sensor.lever_arm_m
        place = np.stack(
            [x + ax * np.cos(yaw) - ay * np.sin(yaw), y + ax * np.sin(yaw) + ay * np.cos(yaw)], -1
        )
        return self.problem.belief.mean(place, yaw) + offset + c * np.cos(yaw) + s * np.sin(yaw)

    def slope(self, state: np.ndarray) -> np.ndarray:
        """Derivatives of the expected reading at one state by its parts, by differences."""
        steps = np.diag([1e-3, 1e-3, 1e-4, 1.0, 1.0, 1.0])
        ends = self.expected(np.hstack([state[:, None] + steps, state[:, None] - steps]))
        return (ends[:STATES] - ends[STATES:]) / (2 * np.diag(steps))

    def walk(self, distance: float, turn: float, dt: float) -> np.ndarray:
        """Variances that a step adds."""
        return np.array([*self.problem.odometry.variances(distance, turn, dt), 0.0, 0.0, 0.0])


class FilterpyEkf:
    """`filterpy.kalman.ExtendedKalmanFilter`."""

    def reset(self, problem: Problem) -> None:
        """Begin at the prior."""
        from filterpy.kalman import ExtendedKalmanFilter

        self.model, self.last = _Model(problem), None
        self.filter = ExtendedKalmanFilter(dim_x=STATES, dim_z=1)
        self.filter.x, self.filter.P = self.model.mean.copy(), np.diag(self.model.sd**2)
        self.filter.R = np.array([[self.model.white]])

    def step(self, reading: Reading) -> Estimate:
        """Predict by the odometry, update by the reading."""
        ekf = self.filter
        if self.last is not None:
            forward, left, turn = moved(self.last, reading)
            c, s = math.cos(ekf.x[2]), math.sin(ekf.x[2])
            dx, dy = forward * c - left * s, forward * s + left * c
            ekf.F = np.eye(STATES)
            ekf.F[0, 2], ekf.F[1, 2] = -dy, dx
            walk = self.model.walk(math.hypot(forward, left), turn, reading.t - self.last.t)
            ekf.Q, ekf.B = np.diag(walk), np.eye(STATES)
            ekf.predict_x = lambda u: setattr(ekf, "x", ekf.x + u)
            ekf.predict(np.array([dx, dy, turn, 0.0, 0.0, 0.0]))
        self.last = reading
        if math.isfinite(reading.b_nt) and np.isfinite(slope := self.model.slope(ekf.x)).all():
            ekf.update(
                np.array([reading.b_nt]),
                lambda _: slope[None],
                lambda x: self.model.expected(x[:, None]),
            )
        x, y, yaw = ekf.x[:3]
        return Estimate(reading.t, x, y, yaw, (ekf.P[:3, :3] + ekf.P[:3, :3].T) / 2, ekf.x[3])


class StoneSoupParticles:
    """`ParticlePredictor` and `ParticleUpdater` of Stone Soup, with systematic resampling."""

    def reset(self, problem: Problem) -> None:
        """Draw particles from the prior."""
        from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
        from stonesoup.models.transition.base import TransitionModel
        from stonesoup.predictor.particle import ParticlePredictor
        from stonesoup.resampler.particle import ESSResampler
        from stonesoup.types.array import StateVectors
        from stonesoup.types.state import ParticleState
        from stonesoup.updater.particle import ParticleUpdater

        model = self.model = _Model(problem)
        rng = self.rng = np.random.default_rng(problem.seed)
        self.last, self.step_ = None, (0.0, 0.0, 0.0, np.zeros(STATES))
        contestant = self

        class Odometry(TransitionModel):
            """The motion of the odometry, with its noise."""

            ndim_state = STATES

            def function(self, state, noise=False, **_):
                """Particles after a step."""
                forward, left, turn, walk = contestant.step_
                z = np.array(state.state_vector, float)
                c, s = np.cos(z[2]), np.sin(z[2])
                z[:2] += forward * c - left * s, forward * s + left * c
                z[2] += turn
                return StateVectors(z + np.sqrt(walk)[:, None] * rng.standard_normal(z.shape))

            def rvs(self, *_, **__):
                raise NotImplementedError

            pdf = rvs

        class Field(NonLinearGaussianMeasurement):
            """The reading."""

            ndim_meas = 1

            def function(self, state, noise=False, **_):
                """Readings of particles; far off where the map ends."""
                b = model.expected(np.atleast_2d(np.array(state.state_vector, float)))
                return StateVectors(np.nan_to_num(b, nan=1e7)[None])

        field = Field(ndim_state=STATES, mapping=(0, 1, 2), noise_covar=np.array([[model.white]]))
        self.predictor = ParticlePredictor(Odometry())
        self.updater = ParticleUpdater(field, resampler=ESSResampler())
        start = model.mean[:, None] + model.sd[:, None] * rng.standard_normal((STATES, PARTICLES))
        weight = np.full(PARTICLES, 1 / PARTICLES)
        self.begin = datetime(2000, 1, 1)
        self.state = ParticleState(StateVectors(start), weight=weight, timestamp=self.begin)

    def step(self, reading: Reading) -> Estimate:
        """Predict by the odometry, update by the reading."""
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis

        time = self.begin + timedelta(seconds=reading.t)
        if self.last is not None:
            forward, left, turn = moved(self.last, reading)
            walk = self.model.walk(math.hypot(forward, left), turn, reading.t - self.last.t)
            walk[:2] += 0.01**2  # roughening
            self.step_ = forward, left, turn, walk
        else:
            self.step_ = 0.0, 0.0, 0.0, np.zeros(STATES)
        self.last = reading
        self.state = self.predictor.predict(self.state, timestamp=time)
        if math.isfinite(reading.b_nt):
            seen = Detection(np.array([[reading.b_nt]]), timestamp=time)
            self.state = self.updater.update(SingleHypothesis(self.state, seen))
        z, weight = np.array(self.state.state_vector, float), np.array(self.state.weight, float)
        mean = z @ weight
        off = z[:3] - mean[:3, None]
        return Estimate(reading.t, *mean[:3], (off * weight) @ off.T, mean[3])
