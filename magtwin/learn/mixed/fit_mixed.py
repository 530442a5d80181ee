"""Fit a mixed model to sessions of several plants, and the factors of its intervals to plants left out."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.learn.data.features import FEATURES
from magtwin.learn.data.inputs import Array, inputs_of
from magtwin.learn.data.recording import Rows
from magtwin.learn.mixed.effects import (
    Effects,
    Sums,
    effects_of_drive,
    fit_effects,
    shares,
    sums_of,
    thinned_rows,
)
from magtwin.learn.mixed.followed import DELAY_S, FollowedEffects, followed
from magtwin.learn.mixed.mixed import FACTORS, Mixed, mixed_of
from magtwin.learn.models.calibration import Spread, quantile_factor
from magtwin.learn.models.linear import fit_linear
from magtwin.learn.models.predictor import Fit, FitTask

DRIVE_S = 60.0
"""Length of the drive with which the factor of calibrated models is fitted [s]."""

LEAST_SESSIONS = 4
"""Least number of training sessions: the spread between sessions is unknown with fewer."""

FOLDS = 5
"""Folds of the nominal plant's sessions when factors are fitted; another plant is a fold."""

MOST_JUDGED = 4
"""Most sessions of a fold that factors are fitted to."""


class Mixeds:
    """Linear models with effects of the session."""

    description = "A linear model whose coefficients differ between sessions (a mixed model)"
    options = MappingProxyType({"features": "wheels", "penalty": None, "weighting": "none"})
    load = staticmethod(mixed_of)

    @staticmethod
    def fit(task: FitTask) -> Fit:
        """Fit mu to the nominal plant, Lambda and s^2 to all sessions, and factors to plants left out."""
        if task.init is not None:
            raise InputError("a mixed model is fitted anew; leave out init")
        drives = list(_drives(task))
        learned = [drive for drive in drives if drive.learned]
        nominal = [drive for drive in learned if not drive.plant]
        if len(learned) < LEAST_SESSIONS:
            raise InputError(
                f"{len(learned)} training sessions: a mixed model learns how sessions differ and needs "
                f"{LEAST_SESSIONS}; record more, or train a linear model"
            )
        if not nominal:
            raise InputError(
                "no training session is of the nominal plant, which the mean of a mixed model is fitted to; "
                "add recordings without a plant"
            )
        x, y = (np.concatenate([getattr(drive, part) for drive in nominal]) for part in ("x", "y"))
        groups = np.repeat(np.arange(len(nominal)), [len(drive.y) for drive in nominal])
        every = inputs_of(np.concatenate([drive.x for drive in learned]), task.features)
        ridge = fit_linear(
            x,
            y,
            groups,
            features=task.features,
            sd=np.concatenate([drive.sd for drive in nominal]),
            penalty=task.options["penalty"],
            weighting=task.options["weighting"],
            inputs=every,
        ).model
        rough = ridge.spread.scaled(1 / math.sqrt(_mean_square(ridge.spread, learned, ridge.inputs)))
        model = Mixed(
            inputs=every,
            prior=Effects(
                np.append(ridge.constant_nt, ridge.coefficients_nt), np.eye(len(task.features) + 1)
            ),
            session=Effects(np.zeros(0), np.zeros((0, 0))),
            spread=ridge.spread,
            noise=rough,
            penalty=ridge.penalty,
        )
        fitter = _Fitter(model, drives)
        model = fitter.without(())
        model.families = len({drive.family for drive in learned})
        model.factors = fitter.factors()
        return Fit(model)


@dataclass(frozen=True)
class _Drive:
    """Thinned rows of a session."""

    plant: str
    learned: bool
    """Whether it is of the training part; else it is of validation."""
    x: Array
    y: Array
    sd: Array
    t: Array
    """Time driven in the session [s], ascending."""

    @property
    def family(self) -> str:
        """Family of the plant: "hysteresis" for "hysteresis:3"."""
        return self.plant.partition(":")[0]


class _Fitter:
    """Fits the prior to some sessions, and factors to the others."""

    def __init__(self, model: Mixed, drives: Sequence[_Drive]) -> None:
        self.model, self.drives = model, drives
        self.phi = [model.regressors(drive.x) for drive in drives]
        self.sums = [
            sums_of(phi, drive.y, model.noise_nt2(phi), shares(drive.t))
            for phi, drive in zip(self.phi, drives, strict=True)
        ]
        own = [FEATURES[name].session_sd_nt for name in model.features]
        self.least_nt2 = np.append(0.0, (np.array(own) * model.inputs.scale) ** 2)
        nominal = iter(range(len(drives)))
        self.folds = [drive.family or f"nominal {next(nominal) % FOLDS}" for drive in drives]

    def without(self, left: Sequence[int]) -> Mixed:
        """The model fitted to training sessions other than those left out."""
        chosen = [i for i, drive in enumerate(self.drives) if drive.learned and i not in left]
        sums: list[Sums] = [self.sums[i] for i in chosen]
        start = np.full(len(self.model.prior.mean), self._start_nt2(chosen))
        prior, factor = fit_effects(sums, self.model.prior.mean, start_nt2=start)
        short = np.maximum(self.least_nt2 - np.diag(prior.covariance), 0.0)
        prior = Effects(prior.mean, prior.covariance + np.diag(short))
        noise = self.model.noise.scaled(math.sqrt(factor))
        return replace(self.model, prior=prior, session=prior, noise=noise)

    def factors(self) -> dict[str, float]:
        """Factors of standard deviations, from sessions whose plant was left out of the fit."""
        errors: dict[str, list[tuple[Array, Array]]] = {name: [] for name in FACTORS}
        for fold in dict.fromkeys(self.folds):
            left = [i for i, of in enumerate(self.folds) if of == fold]
            if all(i in left or not drive.learned for i, drive in enumerate(self.drives)):
                continue
            model = self.without(left)
            for i in left[:: math.ceil(len(left) / MOST_JUDGED)]:
                for name, values in _judged(model, self.phi[i], self.drives[i]):
                    errors[name].append(values)
        factors = dict.fromkeys(FACTORS, 1.0)
        for name, pairs in errors.items():
            if pairs:
                error, sd = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
                groups = np.repeat(np.arange(len(pairs)), [len(each) for each, _ in pairs])
                factors[name] = max(quantile_factor(error, sd, groups), 1.0)
        return factors

    def _start_nt2(self, chosen: Sequence[int]) -> float:
        """Variance of an effect to start EM from: a share of the mean square error of mu."""
        mean = self.model.prior.mean
        squares = [float(np.mean((self.phi[i] @ mean - self.drives[i].y) ** 2)) for i in chosen]
        return max(float(np.mean(squares)) / len(mean), 1.0)


def _judged(model: Mixed, phi: Array, drive: _Drive) -> Iterator[tuple[str, tuple[Array, Array]]]:
    """Errors and standard deviations of a session without factor, by way of use [nT]."""
    noise = model.noise_nt2(phi)
    early = drive.t < drive.t[0] + DRIVE_S
    if not early.all():
        readings = phi[early], drive.y[early], noise[early], drive.t[early]
        session = effects_of_drive(model.prior, *readings, ways=model.ways)
        mean, variance = session.effects.predict(phi[~early])
        sd = session.widening * np.sqrt(noise[~early] + variance + session.hidden_nt2)
        yield "calibrated", (mean - drive.y[~early], sd)
    mean, sd = followed(FollowedEffects(model.prior, ways=model.ways), phi, drive.y, noise, drive.t)
    later = drive.t > drive.t[0] + 2 * DELAY_S
    if later.any():
        yield "online", (mean[later] - drive.y[later], sd[later])


def _drives(task: FitTask) -> Iterator[_Drive]:
    """Sessions of training and validation rows, thinned, with the time driven."""
    for rows, learned in ((task.train, True), (task.validation, False)):
        keys = [(task.recordings[name].plant, task.recordings[name].session) for name in rows.names]
        for key in dict.fromkeys(keys):
            parts = [_thinned(rows, k) for k, of in enumerate(keys) if of == key]
            parts = [part for part in parts if len(part)]
            if not parts:
                continue
            t, begin = [], 0.0
            for part in parts:
                t.append(rows.t[part] - rows.t[part[0]] + begin)
                begin = float(t[-1][-1]) + 1.0
            at = np.concatenate(parts)
            yield _Drive(key[0], learned, rows.x[at], rows.y[at], rows.sd[at], np.concatenate(t))


def _thinned(rows: Rows, recording: int) -> NDArray[np.intp]:
    at = np.flatnonzero(rows.recording == recording)
    return at[thinned_rows(rows.t[at])]


def _mean_square(spread: Spread, drives: Sequence[_Drive], inputs: Any) -> float:
    return float(np.mean(np.concatenate([spread.sd_nt(inputs.scaled(drive.x)) ** 2 for drive in drives])))
