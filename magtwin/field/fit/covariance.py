"""Covariance of a field over position and heading, and the likelihood of readings under it."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Kernel = Literal["matern", "poisson"]

ROOT5 = np.sqrt(5.0)

ARM_M = 1 / 30  # Unit of the sensor's position in the hyperparameters [m], chosen for the optimiser's scale
UNLIKELY = 1e25  # Loss if the covariance is not positive definite: finite, so that a line search steps back
DOUBT = 3.0  # Prior standard deviation of every logarithm about its first guess: a factor of 20 either way
UNEVEN = 0.25  # Prior standard deviation of the logarithm of the field's local strength, about 0
OVERLAP = 0.7  # Width of a patch (one standard deviation), as a share of the distance between patches


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of two readings, from their positions, headings and runs.

        k = sum over h of cos(h (yaw - yaw')) (s_h^2 a_h a_h' k_h(|x - x'|) + u_h^2)
            + r^2 k_r(|x - x'|) [same run],
        x = p + R(yaw) l,

    with h = 0, 1, 2 (only 0 if all headings are equal): the field, the effect of hard iron on its magnitude,
    and that of soft iron. Each has a part that varies over the floor and a constant one. x is the sensor's
    position, at l from base_link; r is the disagreement of runs. Sources are unevenly distributed: log a_0 is
    a weighted mean over patches of the floor, with normal weights (a_h is 1 for other h). k_h is Matern's
    function of order 5/2 (Rasmussen & Williams 2006, eq. 4.17), or the Poisson kernel (1 + (d /
    reach)^2)^(-3/2): the covariance of a harmonic field above uncorrelated sources at depth reach / 2 (the
    upward continuation of white noise; Blakely 1995, eq. 12.6).
    """

    kernel: Kernel  # Function of distance
    harmonics: int  # Number of terms in h: 3, or 1 if all headings are equal
    runs: bool  # Whether runs may disagree
    # Centres of patches of the floor [m], shape (B, 2); empty for uniform strength
    patches: Array = field(default_factory=lambda: np.empty((0, 2)))
    apart_m: float = 1.0  # Distance between patches [m]

    @property
    def size(self) -> int:
        """Number of hyperparameters.

        Log s_h, reach_h, u_h, noise; if any, log r and its reach, log a_0 of the patches, the arm's x and y.
        """
        return self._even + len(self.patches) + 2 * (self.harmonics > 1)

    @property
    def _even(self) -> int:
        return 3 * self.harmonics + 1 + 2 * self.runs

    @property
    def of_patches(self) -> slice:
        """Indices of the patches' hyperparameters."""
        return slice(self._even, self._even + len(self.patches))

    def prior_sd(self) -> Array:
        """Prior standard deviations of the hyperparameters about their first guesses, shape (size,)."""
        arm = [np.inf] * (2 * (self.harmonics > 1))
        return np.array([DOUBT] * self._even + [UNEVEN] * len(self.patches) + arm)

    def noise_nt2(self, figures: Array) -> float:
        """Variance of a reading about the field and its run [nT^2]."""
        return float(np.exp(2 * figures[3 * self.harmonics]))

    def run_nt2(self, figures: Array) -> float:
        """Variance of a run about the field [nT^2]."""
        return float(np.exp(2 * figures[3 * self.harmonics + 1])) if self.runs else 0.0

    def arm_m(self, figures: Array) -> Array:
        """Sensor position from base_link, forward and left [m], shape (2,)."""
        return np.asarray(ARM_M * figures[-2:] if self.harmonics > 1 else np.zeros(2))

    def variance_nt2(self, figures: Array, p_xy: Array) -> Array:
        """Variance of the field at positions of base_link [nT^2], shape (N,)."""
        h = self.harmonics
        even = np.exp(2 * figures[1:h]).sum() + np.exp(2 * figures[2 * h : 3 * h]).sum()
        return np.asarray(np.exp(2 * figures[0]) * self._strength(figures, p_xy) ** 2 + even)

    def _strength(self, figures: Array, p_xy: Array) -> Array:
        """a_0 at positions of base_link, shape (N,)."""
        return np.asarray(np.exp(self._shares(p_xy) @ figures[self.of_patches]))

    def _shares(self, p_xy: Array) -> Array:
        """Weights of the patches at positions, shape (N, B)."""
        if not len(self.patches):
            return np.empty((len(p_xy), 0))
        near = -((_distance(p_xy, self.patches) / (OVERLAP * self.apart_m)) ** 2) / 2
        weight = np.exp(near - near.max(axis=1, keepdims=True))
        return np.asarray(weight / weight.sum(axis=1, keepdims=True))

    def places(self, figures: Array, p_xy: Array, yaw: Array) -> Array:
        """Sensor positions [m], shape (N, 2)."""
        x, y = self.arm_m(figures)
        c, s = np.cos(yaw), np.sin(yaw)
        return p_xy + np.column_stack([c * x - s * y, s * x + c * y])

    def within_runs(self, figures: Array, place: Array, run: NDArray[np.intp]) -> Array:
        """Covariance of readings of one run beside the field [nT^2], shape (N, N)."""
        reach = float(np.exp(figures[3 * self.harmonics + 2]))
        same = run[:, None] == run[None, :]
        return self.run_nt2(figures) * _value(self.kernel, _distance(place, place), reach) * same

    def between(self, figures: Array, a: tuple[Array, Array], b: tuple[Array, Array]) -> Array:
        """Covariance of the field at poses `a` and `b`, each positions and headings [nT^2], shape (A, B)."""
        h = self.harmonics
        place_a, place_b = (self.places(figures, *pose) for pose in (a, b))
        r = _distance(place_a, place_b)
        out = np.zeros_like(r)
        for k, wave in enumerate(self._waves(a[1], b[1])):
            part = _value(self.kernel, r, float(np.exp(figures[h + k])))
            if k == 0 and len(self.patches):
                part *= np.exp(2 * figures[k]) * self._strength(figures, a[0])[:, None]
                part *= self._strength(figures, b[0])
            else:
                part *= np.exp(2 * figures[k])
            part += np.exp(2 * figures[2 * h + k])
            out += part if k == 0 else np.multiply(part, wave, out=part)
        return out

    def _waves(self, a: Array, b: Array) -> list[Array]:
        """cos(h (yaw - yaw')) of every pair, for each h; one product, since cosines of pairs are slow."""
        ones = np.ones((len(a), len(b)))
        if self.harmonics == 1:
            return [ones]
        turned = np.column_stack([np.cos(a), np.sin(a)]) @ np.vstack([np.cos(b), np.sin(b)])
        return [ones, turned, 2 * turned * turned - 1]

    def loss(
        self, figures: Array, guess: Array, p_xy: Array, yaw: Array, run: NDArray[np.intp], b_nt: Array
    ) -> tuple[float, Array]:
        """Negative logarithm of marginal likelihood and prior, and its gradient by `figures`, shape (size,).

        b K^-1 b / 2 + log |K| / 2 (Rasmussen & Williams 2006, eq. 5.8, 5.9, without a constant), plus (value
        - guess)^2 / (2 sd^2) for every hyperparameter with a prior. `b_nt` is the readings minus a constant.
        The value is `UNLIKELY` if the covariance is not positive definite.
        """
        from scipy.linalg import cho_solve
        from scipy.linalg.lapack import dpotrf, dpotri

        h = self.harmonics
        place = self.places(figures, p_xy, yaw)
        r = _distance(place, place)
        waves, strength = self._waves(yaw, yaw), self._strength(figures, p_xy)
        total, slope, parts = np.zeros_like(r), np.zeros_like(r), []
        for k in range(h):
            value, by_reach, by_r = _with_slopes(self.kernel, r, float(np.exp(figures[h + k])))
            scale = np.exp(2 * figures[k]) * waves[k]
            if k == 0 and len(self.patches):
                scale *= strength[:, None]
                scale *= strength
            for array in (value, by_reach, by_r):
                array *= scale
            total += value + np.exp(2 * figures[2 * h + k]) * waves[k]
            slope += by_r
            parts.append((value, by_reach))
        apart: tuple[Array, ...] = ()
        if self.runs:
            apart = _with_slopes(self.kernel, r, float(np.exp(figures[3 * h + 2])))
            same = self.run_nt2(figures) * (run[:, None] == run[None, :])
            for array in apart:
                array *= same
            total += apart[0]
            slope += apart[2]
        total[np.diag_indices_from(total)] += self.noise_nt2(figures)
        lower, failed = dpotrf(total, lower=1)
        if failed:
            return UNLIKELY, np.zeros(self.size)
        alpha = cho_solve((lower, True), b_nt)
        inverse = np.tril(dpotri(lower, lower=1)[0])
        inverse += np.tril(inverse, -1).T
        weight = inverse - np.outer(alpha, alpha)  # d loss / d K, twice
        gradient = [np.vdot(weight, value) for value, _ in parts]
        gradient += [np.vdot(weight, by_reach) / 2 for _, by_reach in parts]
        gradient += [np.exp(2 * figures[2 * h + k]) * np.vdot(weight, waves[k]) for k in range(h)]
        gradient.append(self.noise_nt2(figures) * np.trace(weight))
        if apart:
            gradient += [np.vdot(weight, apart[0]), np.vdot(weight, apart[1]) / 2]
        if len(self.patches):
            gradient += list(np.sum(weight * parts[0][0], axis=1) @ self._shares(p_xy))
        if h > 1:
            weight *= slope
            c, s = np.cos(yaw), np.sin(yaw)
            for column in (np.column_stack([c, s]), np.column_stack([-s, c])):
                # sum over pairs of weight (x - x') . (column - column'), without making the N x N x 2 array
                moved = 2 * np.vdot(weight.sum(axis=1), np.sum(place * column, axis=1))
                moved -= 2 * np.vdot(weight @ column, place)
                gradient.append(ARM_M * moved / 2)
        value = b_nt @ alpha / 2 + np.log(np.diag(lower)).sum()
        off = (figures - guess) / self.prior_sd()
        return float(value + off @ off / 2), np.array(gradient, float) + off / self.prior_sd()


def _distance(a: Array, b: Array) -> Array:
    dx, dy = a[:, :1] - b[:, 0], a[:, 1:] - b[:, 1]
    return np.asarray(np.sqrt(dx * dx + dy * dy))


def _value(kernel: Kernel, r: Array, reach: float) -> Array:
    if kernel == "matern":
        a = (ROOT5 / reach) * r
        value = a / 3  # the arrays are large: in place, each step takes half the time
        value += 1
        value *= a
        value += 1
        value *= np.exp(np.negative(a, out=a), out=a)
        return np.asarray(value)
    q = r / reach
    q *= q
    q += 1
    root = np.sqrt(q)
    root *= q
    return np.asarray(np.divide(1, root, out=root))


def _with_slopes(kernel: Kernel, r: Array, reach: float) -> tuple[Array, Array, Array]:
    """The function of distance, its derivative by log reach, and that by r over r."""
    if kernel == "matern":
        a = ROOT5 / reach * r
        fall = np.exp(-a)
        slope = (1 + a) * fall / 3
        return (1 + a + a * a / 3) * fall, a * a * slope, -5 / reach**2 * slope
    q = 1 + (r / reach) ** 2
    value = 1 / (q * np.sqrt(q))
    slope = 3 * value / q
    return value, (q - 1) * slope, -slope / reach**2
