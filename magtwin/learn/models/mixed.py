"""Mixed: a linear model whose coefficients differ between sessions, calibrated by a short labelled drive.

    y = phi' beta_s + e,   beta_s ~ N(mu, Lambda),   Var e = s^2 r(x),   phi = (1, (x - mean) / scale)

y is the measured field minus the map. mu is fitted to the nominal plant by ridge regression; Lambda and s^2
by EM to all sessions, those of other plants included; r is the shape of the ridge's spread. Before a drive in
the session the model predicts phi' mu, afterwards phi' m with the posterior N(m, V) of its effects.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.learn.data.inputs import Array, inputs_from, inputs_of, scaler_tensors
from magtwin.learn.data.recording import Rows
from magtwin.learn.models.calibration import Spread, quantile_factor
from magtwin.learn.models.effects import Effects, Sums, fit_effects, sums_of
from magtwin.learn.models.linear import fit_linear
from magtwin.learn.models.predictor import Fit, FitTask
from magtwin.learn.models.regressor import Regressor
from magtwin.learn.models.session_effects import (
    FollowedEffects,
    effects_of_drive,
    shares,
    thinned_rows,
)
from magtwin.learn.models.weights import Weights
from magtwin.report import Figure

Intervals = Literal["nominal", "unknown", "calibrated"]
"""What standard deviations hold for: the nominal plant, any plant, or the session of a drive."""

FACTORS = ("calibrated", "online")
"""Ways of use that have a factor of the standard deviation, at least 1."""

DRIVE_S = 60.0
"""Length of the drive with which the factor of calibrated models is fitted [s]."""

DELAY_S = 10.0
"""Age of the newest pose with which the factor of online use is fitted [s]."""

LEAST_SESSIONS = 4
"""Least number of training sessions: the spread between sessions is unknown with fewer."""

FOLDS = 5
"""Folds of the nominal plant's sessions when factors are fitted; another plant is a fold."""


MOST_JUDGED = 6
"""Most sessions of a fold that factors are fitted to."""


@dataclass(kw_only=True, repr=False)
class Mixed(Regressor):
    """A linear model with effects of the session, and the spread of its errors."""

    prior: Effects
    """Effects of all sessions: mu and Lambda, shape (F + 1,) and (F + 1, F + 1); the constant is first."""

    session: Effects
    """Effects that predictions use: the prior, or those of the session of a drive."""

    spread: Spread
    """Spread of errors on sessions of the nominal plant left out of the fit."""

    noise: Spread
    """Spread of errors within a session, s^2 r(x)."""

    intervals: Intervals = "nominal"

    families: int = 1
    """Number of families of plants in the training, the nominal one included. An unknown plant may have the
    effects of all at once."""

    factors: Mapping[str, float] = field(default_factory=lambda: dict.fromkeys(FACTORS, 1.0))
    """Factor c of the standard deviation by way of use, from plants left out of the fit."""

    widening: float = 1.0
    """Factor z of the standard deviation from the blocks of the session's drive."""

    penalty: float = 0.0
    """Ridge penalty of mu, relative to the curvature of the rows."""

    kind = "mixed"

    @property
    def judged_on(self) -> str:
        """What `residual_sd_nt` was measured on."""
        return (
            "blocks of its drive that were left out" if self.intervals == "calibrated" else super().judged_on
        )

    @property
    def layers_text(self) -> str:
        """Number of terms and what they hold for."""
        calibrated = ", calibrated" if self.intervals == "calibrated" else ""
        return f"mixed in {len(self.features)}{calibrated}"

    @property
    def parameters_count(self) -> int:
        """Means and covariances of the effects."""
        count = len(self.prior.mean)
        return count + count * (count + 1) // 2

    def regressors(self, x: ArrayLike) -> Array:
        """Rows phi = (1, z), shape (N, F + 1), from features (N, F)."""
        z = self.inputs.scaled(self.inputs.checked(x))
        return np.column_stack([np.ones(len(z)), z])

    def noise_nt2(self, phi: Array) -> Array:
        """Variances s^2 r(x) of errors within a session [nT^2], shape (N,)."""
        return np.asarray(self.noise.sd_nt(phi[:, 1:]) ** 2)

    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and standard deviations of their errors [nT], each (N,), from features (N, F).

        The standard deviation is the spread on nominal sessions; of an unknown plant
        sqrt(s^2 r(x) + K phi' Lambda phi) with K = `families`; after a drive c z sqrt(s^2 r(x) + phi' V phi).
        """
        phi = self.regressors(x)
        mean, variance = self.session.predict(phi)
        factor, share = self.interval_factors
        if not share:
            return mean, self.spread.sd_nt(phi[:, 1:])
        return mean, factor * np.sqrt(self.noise_nt2(phi) + share * variance)

    @property
    def interval_factors(self) -> tuple[float, float]:
        """Factor of the standard deviation, and of the variance of the effects; (1, 0) if nominal."""
        return {
            "nominal": (1.0, 0.0),
            "unknown": (1.0, float(self.families)),
            "calibrated": (self.factors["calibrated"] * self.widening, 1.0),
        }[self.intervals]

    def open_loop(self, *, unknown_plant: bool = False) -> "Mixed":
        """The model without a drive.

        Args:
            unknown_plant: Whether intervals hold on plants other than the nominal one; they are wider.
        """
        intervals: Intervals = "unknown" if unknown_plant else "nominal"
        return replace(
            self, session=self.prior, intervals=intervals, widening=1.0, metadata=dict(self.metadata)
        )

    def calibrated(self, phi: Array, y: Array, t: Array, extra_nt2: Array | float = 0.0) -> "Mixed":
        """The model in the session of a labelled drive.

        Args:
            phi: Regressors of its readings, shape (N, F + 1).
            y: Labels [nT], shape (N,).
            t: Times [s], ascending, shape (N,).
            extra_nt2: Variance of the labels beside `noise`, such as that of the pose [nT^2].
        """
        variance = self.noise_nt2(phi) + extra_nt2
        drive = effects_of_drive(self.prior, phi, y, variance, t)
        of_parent = ("residual_", "validation_", "test_")  # errors before the drive
        kept = {name: value for name, value in self.metadata.items() if not name.startswith(of_parent)}
        return replace(
            self,
            session=drive.effects,
            intervals="calibrated",
            widening=drive.widening,
            residual_sd_nt=drive.left_out_nt,
            metadata=kept,
        )

    def tensors(self) -> dict[str, torch.Tensor]:
        """Scaler, ranges, effects and spreads, float64."""
        return {
            **self.inputs.tensors(),
            **{
                f"{name}_{part}": torch.tensor(value)  # a copy: open loop, the two are one
                for name, effects in (("prior", self.prior), ("session", self.session))
                for part, value in (("mean_nt", effects.mean), ("covariance_nt2", effects.covariance))
            },
            **{
                f"{name}_{part}": torch.tensor(value, dtype=torch.float64)
                for name, spread in (("spread", self.spread), ("noise", self.noise))
                for part, value in (("floor_nt2", spread.floor_nt2), ("slopes_nt2", spread.slopes_nt2))
            },
        }

    def settings(self) -> dict[str, Any]:
        """What intervals hold for, and their factors."""
        return {
            "intervals": self.intervals,
            "widening": self.widening,
            "penalty": self.penalty,
            "families": self.families,
            **{f"factor_{name}": self.factors[name] for name in FACTORS},
        }

    def figures(self) -> list[Figure]:
        """The constant, its spread between sessions, and the spreads of errors."""
        about = {
            "nominal": "of the nominal plant",
            "unknown": "of any plant",
            "calibrated": "of the session of its drive",
        }
        between = math.sqrt(float(self.prior.covariance[0, 0]))
        constant, left = self.session.mean[0], math.sqrt(float(self.session.covariance[0, 0]))
        figures = [
            Figure("intervals", self.intervals, note=about[self.intervals]),
            Figure("constant", float(self.prior.mean[0]), "nT", between, "at the means; between sessions"),
            Figure("sd within a session", self.noise.mean_nt, "nT", note="of training rows"),
            Figure("sd, nominal plant", self.spread.mean_nt, "nT", note="of training rows"),
            *(Figure(f"interval factor, {name}", self.factors[name]) for name in FACTORS),
            Figure("ridge penalty", self.penalty),
        ]
        if self.intervals == "calibrated":
            figures[1:1] = [
                Figure("constant of the session", float(constant), "nT", left),
                Figure("interval factor of the drive", self.widening),
            ]
        return figures


class Mixeds:
    """Linear models with effects of the session."""

    description = "A linear model whose coefficients differ between sessions (a mixed model)"
    options = MappingProxyType({"features": "session", "penalty": None, "weighting": "none"})

    @staticmethod
    def fit(task: FitTask) -> Fit:
        """Fit mu to the nominal plant, Lambda and s^2 to all sessions, and factors to plants left out."""
        if task.resume:
            raise InputError("a mixed model is fitted at once; there is no checkpoint to resume from")
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

    @staticmethod
    def load(weights: Weights) -> Mixed:
        """The mixed model of a weights file."""
        return mixed_of(weights)


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
        nominal = iter(range(len(drives)))
        self.folds = [drive.family or f"nominal {next(nominal) % FOLDS}" for drive in drives]

    def without(self, left: Sequence[int]) -> Mixed:
        """The model fitted to training sessions other than those left out."""
        chosen = [i for i, drive in enumerate(self.drives) if drive.learned and i not in left]
        sums: list[Sums] = [self.sums[i] for i in chosen]
        start = np.full(len(self.model.prior.mean), self._start_nt2(chosen))
        fitted = fit_effects(sums, self.model.prior.mean, start_nt2=start)
        noise = self.model.noise.scaled(math.sqrt(fitted.factor))
        return replace(self.model, prior=fitted.prior, session=fitted.prior, noise=noise)

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
        session = effects_of_drive(model.prior, phi[early], drive.y[early], noise[early], drive.t[early])
        mean, variance = session.effects.predict(phi[~early])
        sd = session.widening * np.sqrt(noise[~early] + variance)
        yield "calibrated", (mean - drive.y[~early], sd)
    mean, sd = followed(FollowedEffects(model.prior, delay_s=DELAY_S), phi, drive.y, noise, drive.t)
    later = drive.t > drive.t[0] + 2 * DELAY_S
    if later.any():
        yield "online", (mean[later] - drive.y[later], sd[later])


def followed(
    effects: FollowedEffects,
    phi: Array,
    y: Array,
    variance_nt2: Array,
    t: Array,
    *,
    predicted_nt2: Array | None = None,
) -> tuple[Array, Array]:
    """Predictions of the rows of a drive whose poses become known `effects.delay_s` later.

    Args:
        effects: Filter to update.
        phi: Regressors, shape (N, P).
        y: Labels [nT], shape (N,); nan if unknown.
        variance_nt2: Variance of the error of each label [nT^2], shape (N,).
        t: Times [s], ascending, shape (N,).
        predicted_nt2: Variance of the errors to predict. Default: `variance_nt2`.

    Returns:
        Disturbances and their standard deviations [nT], with the filter's widening, each (N,).
    """
    noise = variance_nt2 if predicted_nt2 is None else predicted_nt2
    mean, sd, ready = np.empty(len(t)), np.empty(len(t)), 0
    known = np.searchsorted(t, t - effects.delay_s, side="right")
    starts = np.flatnonzero(np.diff(known, prepend=-1)).tolist()
    for start, stop in itertools.pairwise([*starts, len(t)]):
        for k in range(ready, known[start]):
            effects.update(float(t[k]), phi[k], float(y[k]), float(variance_nt2[k]))
        ready = int(known[start])
        mean[start:stop], variance = effects.effects(float(t[start])).predict(phi[start:stop])
        sd[start:stop] = effects.widening * np.sqrt(noise[start:stop] + variance)
    return mean, sd


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


def mixed_of(weights: Weights) -> Mixed:
    """The mixed model of a weights file.

    Raises:
        InputError: Its parts do not fit each other.
    """
    count = len(weights.features)
    shapes = {"mean_nt": (count + 1,), "covariance_nt2": (count + 1, count + 1)}
    like = {
        **scaler_tensors(count),
        **{
            f"{name}_{part}": torch.ones(shape, dtype=torch.float64)
            for name in ("prior", "session")
            for part, shape in shapes.items()
        },
        **{f"{name}_floor_nt2": torch.ones((), dtype=torch.float64) for name in ("spread", "noise")},
        **{f"{name}_slopes_nt2": torch.ones(count, dtype=torch.float64) for name in ("spread", "noise")},
    }
    tensors = weights.fit(like)
    held = {name: value.numpy() for name, value in tensors.items()}
    for name in ("spread", "noise"):
        if held[f"{name}_floor_nt2"] <= 0 or (held[f"{name}_slopes_nt2"] < 0).any():
            raise InputError(f"{weights.path}: a variance of its {name} is below 0")
    for name in ("prior", "session"):
        covariance = held[f"{name}_covariance_nt2"]
        if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance)[0] <= 0:
            raise InputError(f"{weights.path}: the covariance of its {name} is not positive definite")
    intervals = weights.expect("intervals", str)
    if intervals not in get_args(Intervals):
        raise InputError(
            f"{weights.path}: 'intervals' of its metadata must be one of {', '.join(get_args(Intervals))}, "
            f"got {intervals!r}"
        )

    def effects(name: str) -> Effects:
        return Effects(held[f"{name}_mean_nt"], held[f"{name}_covariance_nt2"])

    def spread(name: str) -> Spread:
        return Spread(float(held[f"{name}_floor_nt2"]), held[f"{name}_slopes_nt2"])

    return Mixed(
        inputs=inputs_from(weights.features, tensors, weights.path),
        prior=effects("prior"),
        session=effects("session"),
        spread=spread("spread"),
        noise=spread("noise"),
        intervals=intervals,  # type: ignore[arg-type]
        factors={name: weights.number(f"factor_{name}", above=0.0) for name in FACTORS},
        widening=weights.number("widening", above=0.0),
        families=int(weights.number("families", above=0.0)),
        penalty=weights.number("penalty"),
        residual_sd_nt=weights.residual_sd_nt,
        metadata=dict(weights.about["facts"]),
    )
