"""LocalFit: predict a reading from its neighbours, with a Gaussian process on the nearest readings."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.field.survey.readings import Readings

Array = NDArray[np.float64]

# Degrees of freedom of Student's t for standardised residuals: real surveys have heavy tails, since a field
# is rougher in some places than in others (Lange et al. 1989, section 2).
FREEDOM = 4.0
LEAST = 48  # Fewest readings from which the field's spread and reach are learnt
TRIED = 512  # Readings from which the parameters are learnt, evenly spaced; fewer for larger neighbourhoods
WIDEST = np.log(50)  # Largest change of the parameters from their first guess, as a logarithm
BLOCK = 64  # Neighbourhoods solved at a time: their matrices stay in the second-level cache


@dataclass(frozen=True)
class LocalFit:
    """A prior of the field, conditioned on the readings around each point.

    The field is a trend over heading (a + c cos + s sin + c2 cos 2 yaw + s2 sin 2 yaw) and a Gaussian process
    of covariance k(d) (v0 + v1 cos Dyaw + v2 cos 2 Dyaw) plus noise. k is the Matern 5/2 function of distance
    (Rasmussen & Williams 2006, eq. 4.17). The terms in Dyaw are a platform's hard and soft iron in a field
    that varies over the floor.
    """

    p_xy: Array  # Positions of the readings [m], shape (N, 2)
    yaw: Array  # Their headings [rad], shape (N,)
    residual_nt: Array  # Readings minus the trend [nT], shape (N,)
    # Logarithms of the reach [m], the sd of the three terms [nT] and the noise's sd [nT], shape (5,)
    log_figures: Array
    count: int  # Neighbours per reading
    rounding_nt: float = 0.0  # Least sd of the noise: that of the sensor's step [nT]

    @classmethod
    def to(
        cls,
        readings: Readings,
        rows: NDArray[np.intp],
        turned: NDArray[np.intp],
        rounding_nt: float,
    ) -> "LocalFit":
        """Learn the prior from the readings `rows`, `LEAST` or more, and the trend from `turned`.

        A trend holds only at headings that it was fitted to, so `turned` must have all that are predicted.

        The parameters maximise the leave-one-out predictive probability under Student's t (Rasmussen &
        Williams 2006, eq. 5.11).
        """
        from scipy.optimize import minimize

        p, yaw, b = readings.p_xy[rows], readings.yaw[rows], readings.b_nt[rows]
        trend = _trend(readings.yaw[turned], readings.b_nt[turned])
        residual = b - _waves(yaw) @ trend
        spread = deviation(residual) or 1.0
        extent = float(np.linalg.norm(np.ptp(p, axis=0))) or 1.0
        headings = 1 if readings.grid is None else len(readings.grid.headings_rad)
        count = min(max(24, 6 * headings), 96, len(rows) - 1)
        start = np.log([extent / 6, spread, spread / 8, spread / 16, spread / 50])
        some = min(TRIED * 24 // count, len(rows))
        tried = np.unique(np.linspace(0, len(rows) - 1, some).astype(np.intp))
        near = cls(p, yaw, residual, start, count)._neighbours(tried, np.arange(len(rows)))

        def unlikeliness(figures: Array) -> float:
            if np.abs(figures - start).max() > WIDEST:
                return np.inf
            mean, variance = cls(p, yaw, residual, figures, count, rounding_nt)._given(near, tried)
            z2 = (residual[tried] - mean) ** 2 / variance
            return float(np.mean(np.log(variance) / 2 + (FREEDOM + 1) / 2 * np.log1p(z2 / FREEDOM)))

        best = minimize(
            unlikeliness, start, method="Nelder-Mead", options={"xatol": 0.05, "fatol": 2e-3, "maxfev": 120}
        )
        whole = readings.b_nt - _waves(readings.yaw) @ trend
        return cls(readings.p_xy, readings.yaw, whole, best.x, count, rounding_nt)

    @property
    def _noise(self) -> float:
        """Variance of the noise [nT^2]."""
        return float(np.exp(2 * self.log_figures[4])) + self.rounding_nt**2

    def left_out(self, rows: NDArray[np.intp], pool: NDArray[np.intp]) -> tuple[Array, Array]:
        """Residuals of `rows` from the prediction by their neighbours in `pool`, without themselves.

        Returns residuals over their standard deviation, and residuals [nT], each of shape (R,).
        """
        mean, variance = self._given(self._neighbours(rows, pool), rows)
        residual = self.residual_nt[rows] - mean
        return residual / np.sqrt(variance), residual

    def together(self, rows: NDArray[np.intp], pool: NDArray[np.intp]) -> tuple[Array, Array]:
        """Residuals of a few `rows` [nT], (R,), and their covariance with noise [nT^2], (R, R).

        The prediction is joint, from their neighbours in `pool`, which holds none of them.
        """
        far = np.linalg.norm(self.p_xy[pool] - self.p_xy[rows].mean(axis=0), axis=1)
        near = pool[np.argsort(far, kind="stable")[: self.count + len(rows)]]
        noise = self._noise
        solved = np.linalg.solve(
            self._covariance(near, near) + noise * np.eye(len(near)), self._covariance(near, rows)
        )
        mean = solved.T @ self.residual_nt[near]
        covariance = self._covariance(rows, rows) - solved.T @ self._covariance(near, rows)
        return self.residual_nt[rows] - mean, (covariance + covariance.T) / 2 + noise * np.eye(len(rows))

    def _covariance(self, a: NDArray[np.intp], b: NDArray[np.intp]) -> Array:
        """Covariance of the field at readings `a` (..., A) and `b` (..., B), shape (..., A, B)."""
        reach, *spreads = np.exp(self.log_figures[:4])
        dx = self.p_xy[a, 0][..., :, None] - self.p_xy[b, 0][..., None, :]
        dy = self.p_xy[a, 1][..., :, None] - self.p_xy[b, 1][..., None, :]
        r = np.sqrt(5) / reach * np.sqrt(dx * dx + dy * dy)
        turned = np.cos(self.yaw[a][..., :, None] - self.yaw[b][..., None, :])
        v0, v1, v2 = np.square(spreads)
        angular = (v0 - v2) + turned * (v1 + 2 * v2 * turned)
        return np.asarray((1 + r + r * r / 3) * np.exp(-r) * angular)

    def _neighbours(self, rows: NDArray[np.intp], pool: NDArray[np.intp]) -> NDArray[np.intp]:
        """The readings of `pool` nearest to each of `rows`, without itself, shape (len(rows), K)."""
        from scipy.spatial import cKDTree

        count = min(self.count, len(pool) - 1)
        _, nearest = cKDTree(self.p_xy[pool]).query(self.p_xy[rows], k=count + 1)
        near = pool[nearest]
        own = near == rows[:, None]
        dropped = np.where(own.any(axis=1), own.argmax(axis=1), count)  # itself, else the farthest
        kept = np.arange(count + 1) != dropped[:, None]
        return np.asarray(near[kept].reshape(len(rows), count))

    def _given(self, near: NDArray[np.intp], rows: NDArray[np.intp]) -> tuple[Array, Array]:
        """Mean and variance, with noise, of each of `rows` given the readings `near` it."""
        noise = self._noise
        mean, variance = np.empty(len(rows)), np.empty(len(rows))
        for start in range(0, len(rows), BLOCK):
            part = slice(start, start + BLOCK)
            across = self._covariance(near[part], rows[part, None])
            inner = self._covariance(near[part], near[part]) + noise * np.eye(near.shape[1])
            weights = np.linalg.solve(inner, across)[..., 0]
            mean[part] = np.sum(weights * self.residual_nt[near[part]], axis=1)
            variance[part] = noise - np.sum(weights * across[..., 0], axis=1)
        return mean, np.maximum(variance + np.exp(2 * self.log_figures[1:4]).sum(), noise)


def _waves(yaw: Array) -> Array:
    return np.column_stack([np.ones_like(yaw), np.cos(yaw), np.sin(yaw), np.cos(2 * yaw), np.sin(2 * yaw)])


def _trend(yaw: Array, b: Array) -> Array:
    """Coefficients of the trend, by least squares with Huber's weights, shape (5,)."""
    waves, weight = _waves(yaw), np.ones_like(b)
    for _ in range(10):
        root = np.sqrt(weight)
        trend = np.linalg.lstsq(waves * root[:, None], b * root, rcond=None)[0]
        size = np.abs(b - waves @ trend)
        weight = 1 / np.maximum(1, size / (1.345 * 1.4826 * np.median(size) + np.finfo(float).tiny))
    return np.asarray(trend)


def deviation(values: Array) -> float:
    """Standard deviation of a normal distribution with the median absolute deviation of `values`."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))
