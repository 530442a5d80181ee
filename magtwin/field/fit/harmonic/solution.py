"""Solution of a harmonic fit: Gauss-Newton steps, learning of hyperparameters, and the resulting model."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.field.fit.harmonic.forward import SOFT, Reading
from magtwin.field.fit.harmonic.layers import Layers
from magtwin.field.fit.harmonic.model import HarmonicModel, between, surveyed, widened
from magtwin.field.fit.harmonic.posterior import Posterior
from magtwin.field.fit.harmonic.problem import Hyperparameters, Problem
from magtwin.field.fit.roughness import tail_of
from magtwin.field.survey.readings import Readings
from magtwin.report.verdict import Z_90

Array = NDArray[np.float64]

DRAWN = 0.005  # Weight of the layer's strength relative to that of the dipoles around
TAILS = np.geomspace(4.0, 48.0, 13)  # Degrees of freedom of Student's t that are tried
SETTLED = 0.2  # Gain of the log posterior below which Gauss-Newton has converged
STEPS = 30  # Most steps until then
LEAST_NOISE_NT = 0.1  # Below it, the prior of the uniform field leaves double precision [nT]
FIRST_STEPS = 4  # Gauss-Newton steps before learning begins
# Logarithms of the widths that are tried, as factors of the posterior's variances
WIDTHS = np.linspace(-np.log(16), np.log(16), 161)
NOISES = np.geomspace(1.0, 16.0, 25)  # Factors of the noise's variance that are tried for a drive
WIDTH_SD = np.log(2)  # Prior standard deviation of the logarithm of the width about 0


@dataclass(frozen=True, eq=False)
class Solution:
    """Unknowns, their predictions, and the hyperparameters."""

    problem: Problem
    figures: Hyperparameters
    unknowns: Array
    reading: Reading

    @classmethod
    def start(cls, problem: Problem, figures: Hyperparameters, uniform: Array) -> "Solution":
        """Start from a uniform field; the first step weights all readings equally and weakly."""
        unknowns = problem.mean.copy()
        count = 3 * len(figures.strength)
        unknowns[count : count + 3] = uniform
        state = cls(problem, figures, unknowns, problem.at(unknowns))._coarse()
        for _ in range(FIRST_STEPS):
            state = state.step()
        return state

    @classmethod
    def resumed(
        cls, problem: Problem, known: Layers, figures: Hyperparameters, unknowns: Array
    ) -> "Solution":
        """Start from a fit to other readings of the survey, or with fewer layers.

        Dipoles take the strength per area of the nearest one of their layer. Moments are kept if the layers
        are the same.
        """
        from scipy.spatial import cKDTree

        layers, strength = problem.layers, problem.first().strength.copy()
        moments, old_moments = np.zeros((len(strength), 3)), unknowns[: 3 * len(known.layer)].reshape(-1, 3)
        same = True
        for k in range(min(len(layers.depths), len(known.depths))):
            own, old = np.flatnonzero(layers.layer == k), np.flatnonzero(known.layer == k)
            p, q = layers.p_world_dipole[own], known.p_world_dipole[old]
            nearest = old[cKDTree(q[:, :2]).query(p[:, :2])[1]]
            strength[own] = figures.strength[nearest] * np.sqrt(layers.area_m2[own] / known.area_m2[nearest])
            same = same and p.shape == q.shape and np.allclose(p, q)
            if same:
                moments[own] = old_moments[old]
        rest = unknowns[3 * len(known.layer) :]
        rest = np.where(problem.rest_sd > 0, rest, problem.mean[moments.size :])
        unknowns = np.append(moments if same else np.zeros_like(moments), rest)
        figures = replace(figures, strength=strength)
        state = cls(problem, figures, unknowns, problem.at(unknowns))
        return state.step() if same else state._coarse().step()

    def _coarse(self) -> "Solution":
        """A step that weights all readings equally and weakly."""
        off = self.off
        coarse = np.full(off.shape, max(float(np.mean(off**2)) / 100, self.figures.noise_nt**2))
        return self._moved(self._towards(self._posterior(1 / coarse), 1 / coarse), 1.0)

    @property
    def uniform(self) -> Array:
        """The uniform part of the field [nT]."""
        count = 3 * len(self.figures.strength)
        return self.unknowns[count : count + 3]

    @property
    def prior_sd(self) -> Array:
        """Prior standard deviations of the unknowns, shape (P,)."""
        return np.concatenate([np.repeat(self.figures.strength, 3), self.problem.rest_sd])

    @property
    def off(self) -> Array:
        """Residuals (N, C)."""
        return self.problem.read_nt - self.reading.values_nt

    @cached_property
    def variance(self) -> Array:
        """Squared scales of the readings [nT^2], (N, C)."""
        return self.figures.variance(self.reading)

    @cached_property
    def precision(self) -> Array:
        """Precisions of the readings [1/nT^2], (N, C)."""
        return np.asarray(self.weights(self.variance)[:, None] / self.variance)

    def weights(self, variance: Array) -> Array:
        """Expected relative precision of each reading under Student's t, (N,)."""
        freedom, parts = self.figures.freedom, variance.shape[1]
        return np.asarray((freedom + parts) / (freedom + np.sum(self.off**2 / variance, axis=1)))

    def objective(self, variance: Array) -> float:
        """Negative log posterior for fixed scales, without a constant."""
        freedom, parts = self.figures.freedom, variance.shape[1]
        surprise = np.log1p(np.sum(self.off**2 / variance, axis=1) / freedom)
        moved = self._scaled()
        return float((freedom + parts) / 2 * surprise.sum() + moved @ moved / 2)

    @cached_property
    def posterior(self) -> Posterior:
        """Posterior of the unknowns, in units of their priors, linearised here."""
        return self._posterior(self.precision)

    def _posterior(self, precision: Array) -> Posterior:
        rows = self.reading.jacobian.reshape(-1, self.reading.jacobian.shape[-1]) * self.prior_sd
        rows *= np.sqrt(precision).reshape(-1, 1)
        return Posterior.of(rows)

    def _scaled(self) -> Array:
        """Unknowns minus their priors' means, in prior standard deviations; 0 for fixed ones."""
        sd = self.prior_sd
        return np.divide(self.unknowns - self.problem.mean, sd, out=np.zeros_like(sd), where=sd > 0)

    def _towards(self, posterior: Posterior, precision: Array) -> Array:
        """Unknowns that solve the linearised problem."""
        best = posterior.mean(self._target(posterior, precision))
        return np.asarray(self.problem.mean + self.prior_sd * best)

    def _target(self, posterior: Posterior, precision: Array) -> Array:
        """Readings of the linearised problem, (R,)."""
        return np.sqrt(precision).ravel() * self.off.ravel() + posterior.rows @ self._scaled()

    def _moved(self, towards: Array, part: float) -> "Solution":
        unknowns = self.unknowns + part * (towards - self.unknowns)
        return Solution(self.problem, self.figures, unknowns, self.problem.at(unknowns))

    def _stepped(self) -> tuple["Solution", float]:
        towards = self._towards(self.posterior, self.precision)
        before, part = self.objective(self.variance), 1.0
        while part > 0.05:
            after = self._moved(towards, part)
            gain = before - after.objective(self.variance)
            if gain >= 0:
                return after, gain
            part /= 2
        return self, 0.0

    def step(self) -> "Solution":
        """One Gauss-Newton step, halved until the posterior grows."""
        return self._stepped()[0]

    def settle(self) -> "Solution":
        """Step until nothing is gained."""
        state = self
        for _ in range(STEPS):
            state, gain = state._stepped()
            if gain < SETTLED:
                break
        return state

    def learnt(self, shares: list[Array] | None, *, step: bool = True) -> "Solution":
        """One Gauss-Newton step, and hyperparameters that are more likely after it.

        The step and the learning share one factorisation, that of the problem linearised before the step.
        Without `step`, the unknowns stay.
        """
        from scipy.special import gammaln, psi

        after, posterior = self.step() if step else self, self.posterior
        figures, layers, variance = self.figures, self.problem.layers, after.variance
        weights = after.weights(variance)
        count = len(figures.strength)
        known = posterior.known()[: 3 * count].reshape(count, 3).mean(axis=1)
        known = np.clip(known, 1e-9, 1)
        square = np.mean(after.unknowns[: 3 * count].reshape(count, 3) ** 2, axis=1) / layers.area_m2
        density = figures.strength**2 / layers.area_m2
        new = np.empty(count)
        for k in range(len(layers.depths)):
            own = layers.layer == k
            whole = square[own].sum() / known[own].sum()
            new[own] = whole
            if shares is not None:
                drawn = DRAWN * shares[k].sum(axis=1).mean() * known[own].mean()
                new[own] = (shares[k] @ square[own] + drawn * whole) / (shares[k] @ known[own] + drawn)
        new = np.clip(new, 0.3 * density, 3 * density)
        left = posterior.fitted().reshape(variance.shape) / self.precision
        size = (after.off**2 + left) * weights[:, None] / variance
        share = figures.terms(after.reading) / variance[..., None]
        whole_share = np.maximum(np.sum(share, axis=(0, 1)), np.finfo(float).tiny)  # 0 for what is held at 0
        scale = np.sqrt(np.sum(share * size[..., None], axis=(0, 1)) / whole_share)
        parts = variance.shape[1]
        old = (figures.freedom + parts) / 2
        tail = np.mean(np.log(weights) - weights) + psi(old) - np.log(old)
        half = TAILS / 2
        freedom = float(TAILS[np.argmax(half * np.log(half) - gammaln(half) + half * tail)])
        learnt = Hyperparameters(
            noise_nt=max(float(figures.noise_nt * scale[0]), LEAST_NOISE_NT),
            position_m=float(figures.position_m * scale[1]),
            heading_rad=float(figures.heading_rad * scale[2]),
            freedom=freedom,
            strength=np.sqrt(new * layers.area_m2),
        )
        return Solution(self.problem, learnt, after.unknowns, after.reading)

    def evidence(self) -> float:
        """Log evidence by Laplace's approximation (Rasmussen & Williams 2006, eq. 3.32)."""
        from scipy.special import gammaln

        variance = self.variance
        freedom, parts = self.figures.freedom, variance.shape[1]
        constant = gammaln((freedom + parts) / 2) - gammaln(freedom / 2) - parts / 2 * np.log(freedom * np.pi)
        fit = len(variance) * constant - np.log(variance).sum() / 2 - self.objective(variance)
        return float(fit - self.posterior.half_log_det())

    def model(self, good: Readings) -> HarmonicModel:
        """The fitted model."""
        figures, problem, precision = self.figures, self.problem, self.precision
        posterior = self.posterior
        learnt, (louder, width) = posterior.directions(), self._calibrated(posterior, precision)
        headings, turned = self._turned(posterior, precision)
        field = problem.forward.field(self.unknowns)
        slopes = problem.forward.read(
            self.unknowns, problem.p_xy, problem.yaw, problem.signals, vectors=False
        )
        wide = figures.freedom / (figures.freedom - 2)
        noise = louder * wide * float(np.mean(figures.variance(slopes)))
        each = self.unknowns[len(self.unknowns) - 3 * len(good.signal_names) :].reshape(-1, 3)
        own = 0.0 if good.signals is None else good.signals @ each
        off = good.b_nt - field.magnitude_nt(good.p_xy, good.yaw, own_nt=own)
        within = off - (np.bincount(problem.cell, off) / np.bincount(problem.cell))[problem.cell]
        noise += float(np.mean(within**2))
        parameters = self._parameters(learnt, width, len(good))
        if problem.untold:
            parameters["vector field"] = problem.untold
        parameters["added between headings [nT/rad^2]"] = round(float(np.sqrt(turned)), 2)
        if louder != 1:
            parameters["factor of the noise along a drive"] = round(float(np.sqrt(louder)), 3)
        return HarmonicModel(
            field=field,
            parameters=parameters,
            noise_nt2=noise,
            figures=figures,
            forward=problem.forward,
            layers=problem.layers,
            unknowns=self.unknowns,
            prior_sd=self.prior_sd,
            learnt=learnt,
            spread=self._jackknife(posterior, precision),
            width=width,
            headings_rad=headings,
            turned=turned,
            signals=good.signal_names,
            untold=problem.untold,
        )

    def _calibrated(self, posterior: Posterior, precision: Array) -> tuple[float, float]:
        """Likeliest factors of the noise's and of the field's variance, from readings left out in turn.

        Each place counts once. Consecutive readings of a drive share errors from motors, battery and LiDAR,
        so whole passes are left out, and predicted where another pass is near. The noise grows by what a pass
        shares. Passes are few, so the intervals of a drive are never narrowed.
        """
        root, problem = np.sqrt(precision).ravel(), self.problem
        places, (passes, near) = problem.places(), problem.met()
        off, field = posterior.left_out(self._target(posterior, precision), passes or places)
        share = np.empty(len(root))
        for rows in places:
            share[rows] = 1 / len(rows)
        if passes:
            share *= near
        noise, freedom = self.variance.ravel(), self.figures.freedom
        square, field = (off / root) ** 2, field / root**2
        best = np.inf, 1.0, 1.0
        widths = WIDTHS if problem.passes is None else WIDTHS[WIDTHS >= 0]
        for factor in NOISES if passes else NOISES[:1]:
            scale = widened(field, factor * noise, np.exp(widths)[:, None]) + factor * noise
            surprise = (freedom + 1) / 2 * np.log1p(square / (freedom * scale)) + np.log(scale) / 2
            loss = surprise @ share + (widths / WIDTH_SD) ** 2 / 2
            k = int(np.argmin(loss))
            best = min(best, (float(loss[k]), float(factor), float(np.exp(widths[k]))))
        _, louder, width = best
        if not passes:
            return louder, width
        variance = widened(field, louder * noise, width) + louder * noise * freedom / (freedom - 2)
        wider = max(tail_of(square[near] / variance[near], share[near]), 1.0)
        return louder * wider, width * wider

    def _jackknife(self, posterior: Posterior, precision: Array) -> Array:
        """See `HarmonicModel.spread`."""
        groups = self.problem.stretches() if self.problem.signals is not None else []
        changes = posterior.changes(self._target(posterior, precision), groups)
        share = np.sqrt((len(groups) - 1) / len(groups)) if groups else 0.0
        return np.asarray(share * (changes - changes.mean(axis=1, keepdims=True) if groups else changes))

    def _turned(self, posterior: Posterior, precision: Array) -> tuple[Array, float]:
        """See `HarmonicModel.headings_rad` and `HarmonicModel.turned`."""
        from scipy.special import stdtrit

        heading, group = surveyed(self.problem.yaw)
        if not len(heading) or not np.any(self.problem.rest_sd[3:]):
            return np.empty(0), 0.0
        root = np.sqrt(precision).ravel()
        rows = np.arange(len(root)).reshape(precision.shape)
        groups = [rows[group == h].ravel() for h in range(len(heading))]
        off, field = posterior.left_out(self._target(posterior, precision), groups)
        beyond, away = 0.0, 0.0
        for h, part in enumerate(groups):
            beyond += float(np.sum((off[part] ** 2 - field[part] - 1) / root[part] ** 2))
            away += len(part) * float(between(np.delete(heading, h), heading[h : h + 1])[0])
        few = float(stdtrit(len(heading), 0.95)) / Z_90  # so many headings tell it: Student's t
        return heading, max(beyond / away, 0.0) * few**2

    def _parameters(self, learnt: Array, width: float, count: int) -> dict[str, Any]:
        figures, problem = self.figures, self.problem
        last = learnt[-len(problem.rest_sd) :]
        sd = problem.rest_sd * np.sqrt(np.maximum(1 - np.sum(last**2, axis=1), 0))
        field = problem.forward.field(self.unknowns)
        uniform, hard, _, lever, _ = np.split(self.unknowns[-len(problem.rest_sd) :], [3, 6, 14, 16])
        layers = problem.layers
        square = figures.strength**2 / layers.area_m2
        density = [float(np.sqrt(square[layers.layer == k].mean())) for k in range(len(layers.depths))]
        return {
            "readings": count,
            "means of readings": len(problem.p_xy),
            "parts of a reading": "vector" if problem.vectors else "magnitude",
            "dipoles": len(figures.strength),
            "depths below the sensor [m]": [round(d, 4) for d in layers.depths],
            "strengths of the layers [A m^2/m]": [round(d, 4) for d in density],
            "noise [nT]": round(figures.noise_nt, 3),
            "error of places [m]": round(figures.position_m, 5),
            "error of headings [rad]": round(figures.heading_rad, 5),
            "degrees of freedom": round(figures.freedom, 2),
            "uniform field [nT]": np.round(uniform, 1).tolist(),
            "uniform field, sd [nT]": np.round(sd[:3], 1).tolist(),
            "hard iron [nT]": np.round(hard, 1).tolist(),
            "hard iron, sd [nT]": np.round(sd[3:6], 1).tolist(),
            "soft iron": np.round(field.soft_iron.ravel(), 5).tolist(),
            "soft iron, sd": np.round(np.sqrt(np.tensordot(sd[6:14] ** 2, SOFT**2, 1)).ravel(), 5).tolist(),
            "lever arm [m]": np.round(lever, 5).tolist(),
            "lever arm, sd [m]": np.round(sd[14:16], 5).tolist(),
            "width of variances": round(width, 4),
            "log evidence": round(self.evidence(), 2),
        }
