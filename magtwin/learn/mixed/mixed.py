"""Mixed: a linear model whose coefficients differ between sessions, calibrated by a short labelled drive.

    y = phi' beta_s + e,   beta_s ~ N(mu, Lambda),   Var e = s^2 r(x),   phi = (1, (x - mean) / scale)

y is the measured field minus the map. mu is fitted to the nominal plant by ridge regression; Lambda and s^2
by EM to all sessions, those of other plants included; r is the shape of the ridge's spread. Before a drive in
the session the model predicts phi' mu, afterwards phi' m with the posterior N(m, V) of its effects.
"""

import math
from collections.abc import Container, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import InputError
from magtwin.learn.data.features import FEATURES
from magtwin.learn.data.inputs import Array, inputs_from, scaler_tensors
from magtwin.learn.mixed.effects import Effects, effects_of_drive
from magtwin.learn.models.calibration import Spread, spread_from, spread_like
from magtwin.learn.models.predictor import Predictor
from magtwin.learn.models.weights import Weights
from magtwin.report.report import Figure

Intervals = Literal["nominal", "unknown", "calibrated"]
"""What standard deviations hold for: the nominal plant, any plant, or the session of a drive."""

FACTORS = ("calibrated", "online")
"""Ways of use that have a factor of the standard deviation, at least 1."""

TOLD = 0.5
"""Share of the errors within a session from which a hidden field is told."""


@dataclass(kw_only=True, repr=False)
class Mixed(Predictor):
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

    hidden_nt2: float = 0.0
    """Variance of a field in the session's drive that no signal explains [nT^2]."""

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

    @property
    def ways(self) -> tuple[int, ...]:
        """Columns of the regressors that fields fixed to the robot follow: the constant, and the
        heading's.
        """
        return (0, *(1 + k for k, name in enumerate(self.features) if name in ("yaw_cos", "yaw_sin")))

    def noise_nt2(self, phi: Array) -> Array:
        """Variances s^2 r(x) of errors within a session [nT^2], shape (N,)."""
        return np.asarray(self.noise.sd_nt(phi[:, 1:]) ** 2)

    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and standard deviations of their errors [nT], each (N,), from features (N, F).

        The standard deviation is the spread on nominal sessions; of an unknown plant
        sqrt(s^2 r(x) + K phi' Lambda phi) with K = `families`; after a drive c z sqrt(s^2 r(x) + phi' V phi +
        h), h the variance of a field that no signal explains.
        """
        phi = self.regressors(x)
        mean, variance = self.session.predict(phi)
        factor, share = self.interval_factors
        if not share:
            return mean, self.spread.sd_nt(phi[:, 1:])
        return mean, factor * np.sqrt(self.noise_nt2(phi) + share * variance + self.hidden_nt2)

    def wide_sd_nt(self, x: ArrayLike) -> Array | None:
        """Standard deviations on plants other than the nominal one [nT], (N,); None after a drive."""
        return self.open_loop(unknown_plant=True).predict(x)[1] if self.intervals == "nominal" else None

    @property
    def interval_factors(self) -> tuple[float, float]:
        """Factor of the standard deviation, and of the variance of the effects; (1, 0) if nominal."""
        return {
            "nominal": (1.0, 0.0),
            "unknown": (1.0, float(self.families)),
            "calibrated": (self.factors["calibrated"] * self.widening, 1.0),
        }[self.intervals]

    def reading(self, columns: Container[str]) -> "Mixed":
        """The model without the features that a robot's columns lack.

        Their effects count as errors, by what training has shown of them.
        """
        wanted = [set(FEATURES[name].columns) for name in self.features]
        kept = np.array([all(column in columns for column in of) for of in wanted])
        if kept.all():
            return self
        at, lost = np.append(0, 1 + np.flatnonzero(kept)), 1 + np.flatnonzero(~kept)
        floors = np.array([FEATURES[name].session_sd_nt for name in self.features]) * self.inputs.scale
        means = self.prior.mean[lost] ** 2
        shown = np.maximum(np.diag(self.prior.covariance)[lost] - floors[~kept] ** 2, 0.0)
        spread = float(np.sum(means + shown))
        return replace(
            self,
            inputs=self.inputs.take(kept),
            prior=self.prior.take(at),
            session=self.session.take(at),
            spread=Spread(self.spread.floor_nt2 + float(means.sum()), self.spread.slopes_nt2[kept]),
            noise=Spread(self.noise.floor_nt2 + spread, self.noise.slopes_nt2[kept]),
            metadata=dict(self.metadata),
        )

    def open_loop(self, *, unknown_plant: bool = False) -> "Mixed":
        """The model without a drive.

        Args:
            unknown_plant: Whether intervals hold on plants other than the nominal one; they are wider.
        """
        intervals: Intervals = "unknown" if unknown_plant else "nominal"
        return replace(
            self,
            session=self.prior,
            intervals=intervals,
            widening=1.0,
            hidden_nt2=0.0,
            metadata=dict(self.metadata),
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
        drive = effects_of_drive(self.prior, phi, y, variance, t, ways=self.ways)
        of_parent = ("residual_", "validation_", "test_")  # errors before the drive
        kept = {name: value for name, value in self.metadata.items() if not name.startswith(of_parent)}
        if not math.isnan(drive.period_s):
            kept["hidden_period_s"] = drive.period_s
        return replace(
            self,
            session=drive.effects,
            intervals="calibrated",
            widening=drive.widening,
            hidden_nt2=drive.hidden_nt2,
            residual_sd_nt=drive.left_out_nt,
            metadata=kept,
        )

    def tensors(self) -> dict[str, Array]:
        """Scaler, ranges, effects and spreads, float64."""
        return {
            **self.inputs.tensors(),
            **{
                f"{name}_{part}": value
                for name, effects in (("prior", self.prior), ("session", self.session))
                for part, value in (("mean_nt", effects.mean), ("covariance_nt2", effects.covariance))
            },
            **self.spread.tensors("spread"),
            **self.noise.tensors("noise"),
        }

    def settings(self) -> dict[str, Any]:
        """What intervals hold for, and their factors."""
        return {
            "intervals": self.intervals,
            "widening": self.widening,
            "hidden_nt2": self.hidden_nt2,
            "penalty": self.penalty,
            "families": self.families,
            **{f"factor_{name}": self.factors[name] for name in FACTORS},
        }

    def figures(self) -> list[Figure]:
        """The constant, its spread between sessions, and the spreads of errors."""
        (before, between), (constant, left) = (
            (float(effects.mean[0]), math.sqrt(float(effects.covariance[0, 0])))
            for effects in (self.prior, self.session)
        )
        figures = [
            Figure("intervals", self.intervals, note="the plants, or the session, that they hold for"),
            Figure("constant", before, "nT", between, "at the means; between sessions"),
            Figure("sd within a session", self.noise.mean_nt, "nT", note="of training rows"),
            Figure("sd, nominal plant", self.spread.mean_nt, "nT", note="of training rows"),
            *(Figure(f"interval factor, {name}", self.factors[name]) for name in FACTORS),
            Figure("ridge penalty", self.penalty),
        ]
        if self.intervals == "calibrated":
            figures[1:1] = [
                Figure("constant of the session", constant, "nT", left),
                Figure("interval factor of the drive", self.widening),
            ]
            hidden = math.sqrt(self.hidden_nt2)
            if hidden > TOLD * self.noise.mean_nt:
                period = self.metadata.get("hidden_period_s")
                every = f", about every {period:.0f} s" if isinstance(period, float) else ""
                figures.append(Figure("a source that no signal explains", hidden, "nT", note=f"sd{every}"))
        return figures


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
            f"{name}_{part}": np.ones(shape)
            for name in ("prior", "session")
            for part, shape in shapes.items()
        },
        **spread_like("spread", count),
        **spread_like("noise", count),
    }
    held = weights.fit(like)
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

    return Mixed(
        inputs=inputs_from(weights.features, held, weights.path),
        prior=effects("prior"),
        session=effects("session"),
        spread=spread_from(held, "spread", weights.path),
        noise=spread_from(held, "noise", weights.path),
        intervals=intervals,  # type: ignore[arg-type]
        factors={name: weights.number(f"factor_{name}", above=0.0) for name in FACTORS},
        widening=weights.number("widening", above=0.0),
        hidden_nt2=weights.number("hidden_nt2", above=-1e-300) if "hidden_nt2" in weights.about else 0.0,
        families=int(weights.number("families", above=0.0)),
        penalty=weights.number("penalty"),
    )
