"""Linear: a disturbance as a weighted sum of features, by ridge regression.

With heading harmonics, current, LiDAR, speed and turning as features (the set "circular") it is the scalar
form of Tolles and Lawson's compensation: hard iron varies with the heading, soft iron with twice the heading.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.learn.data.features import FEATURES
from magtwin.learn.data.inputs import Array, Inputs, inputs_from, inputs_of, scaler_tensors
from magtwin.learn.models.calibration import (
    Spread,
    few_groups_factor,
    fit_spread,
    quantile_factor,
    spread_from,
    spread_like,
)
from magtwin.learn.models.predictor import Predictor
from magtwin.learn.models.weights import Weights
from magtwin.report.report import Figure

PENALTIES = tuple(float(p) for p in np.logspace(-8, 1, 19))  # Penalties that cross-validation chooses from
FALLBACK_PENALTY = 1e-3  # Penalty if there is one group of recordings, so that cross-validation is impossible
MOST_FOLDS = 10  # Most folds of the cross-validation; with fewer groups, each group is a fold

Weighting = Literal["auto", "label_sd", "none"]


@dataclass(kw_only=True, repr=False)
class Linear(Predictor):
    """A disturbance constant + sum_j c_j z_j with z = (x - mean) / scale, and the spread of its errors."""

    constant_nt: float
    """Disturbance at the means of the inputs [nT]."""

    coefficients_nt: Array
    """Disturbance per scale of each input [nT], shape (F,)."""

    spread: Spread
    """Spread of errors on recordings left out."""

    penalty: float
    """Ridge penalty, relative to the curvature of the rows."""

    weighted: bool = False
    """Whether rows were weighted by how well the map is known there."""

    kind = "linear"

    @property
    def layers_text(self) -> str:
        """Number of terms."""
        return f"linear in {len(self.features)}"

    @property
    def parameters_count(self) -> int:
        """Coefficients and the constant."""
        return len(self.features) + 1

    def mean_nt(self, z: Array) -> Array:
        """Disturbances [nT], shape (N,), from scaled inputs, shape (N, F)."""
        mean = np.full(len(z), self.constant_nt)
        for j, value in enumerate(self.coefficients_nt):  # by column, so that no row depends on others
            mean += value * z[:, j]
        return mean

    def predict(self, x: ArrayLike) -> tuple[Array, Array]:
        """Disturbances and standard deviations of their errors [nT], each (N,), from features (N, F)."""
        z = self.inputs.scaled(self.inputs.checked(x))
        return self.mean_nt(z), self.spread.sd_nt(z)

    def tensors(self) -> dict[str, Array]:
        """Scaler, ranges, coefficients and spread, float64."""
        return {
            **self.inputs.tensors(),
            "constant_nt": np.array(self.constant_nt),
            "coefficients_nt": self.coefficients_nt,
            **self.spread.tensors("spread"),
        }

    def settings(self) -> dict[str, Any]:
        """Penalty and weighting."""
        return {"penalty": self.penalty, "weighted": self.weighted}

    def figures(self) -> list[Figure]:
        """Terms, and the spread of errors."""
        constant = Figure("constant", self.constant_nt, "nT", note="at the means")
        return [constant, *self.terms(), Figure("sd at the means", math.sqrt(self.spread.floor_nt2), "nT")]

    def terms(self) -> list[Figure]:
        """Coefficients per unit of the features, and the penalty."""
        figures = []
        for name, value, scale in zip(self.features, self.coefficients_nt, self.inputs.scale, strict=True):
            unit = FEATURES[name].unit
            per = f"nT per {unit}" if unit else "nT"
            note = f"{value:+.3g} nT a standard deviation"
            figures.append(Figure(name, float(value / scale), per, note=note))
        note = "rows weighted by how well the map is known" if self.weighted else ""
        return [*figures, Figure("ridge penalty", self.penalty, note=note)]


class FittedLinear(NamedTuple):
    """A linear model, and predictions of the rows by fits without them."""

    model: Linear

    held_out_nt: Array
    """Disturbance at each row by a fit without its group [nT], shape (N,)."""

    groups: NDArray[np.intp]
    """Group of each row, shape (N,)."""

    weight: Array | None = None
    """Weight of each row, shape (N,); None if all are equal."""


def fit_linear(
    x: ArrayLike,
    y: ArrayLike,
    groups: NDArray[np.intp],
    *,
    features: str | Sequence[str],
    sd: ArrayLike | None = None,
    penalty: float | None = None,
    weighting: Weighting = "auto",
    start: Linear | None = None,
    inputs: Inputs | None = None,
) -> FittedLinear:
    """Fit labels by ridge regression on features.

    The penalty is chosen by cross-validation over groups, because rows of one recording are correlated. The
    intercept has no penalty. The errors of fits on the groups that they left out give `Linear.spread`, which
    includes offsets between sessions.

    Args:
        x: Features, shape (N, F), without nan.
        y: Labels [nT], shape (N,).
        groups: Session, recording or path of each row, shape (N,).
        features: Names of the columns of `x`, or the name of a set.
        sd: Standard deviation of the map at each row [nT], shape (N,). None: unknown.
        penalty: Ridge penalty, relative to the curvature of the rows. None: chosen from `PENALTIES`.
        weighting: "label_sd" weighs rows by 1 / (s0^2 + sd^2), s0 the error that remains if the map is known
            exactly; "none" weighs all alike; "auto" uses the better of the two on groups left out.
        start: A model of the same features; coefficients are shrunk towards its own instead of 0, and its
            scaler is kept.
        inputs: Scaler and ranges. Default: those of the rows.

    Raises:
        InputError: All labels are the same, or `start` has other features.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if y.std() < 1e-9:
        raise InputError(f"the label is {y[0]:g} nT in every training row; there is nothing to learn")
    inputs = inputs or inputs_of(x, features)
    if start is not None:
        inputs = start.inputs.grown(inputs)
    z = np.column_stack([inputs.scaled(x), np.ones(len(x))])
    towards = np.zeros(z.shape[1]) if start is None else np.append(start.coefficients_nt, start.constant_nt)
    groups = np.unique(groups, return_inverse=True)[1].astype(np.intp)
    label_sd = np.zeros(len(y)) if sd is None else np.asarray(sd, float)
    solve = _Ridge(z, y, groups % MOST_FOLDS, towards, penalty)
    best, weight = solve(np.ones(len(y))), None
    if weighting != "none" and label_sd.any():
        left = float(np.mean((best.held_out - y) ** 2))
        s0_squared = max(left - float(np.mean(label_sd**2)), 0.05 * left)
        weight = s0_squared / (s0_squared + label_sd**2)
        other = solve(weight)
        plain, weighted = (np.abs(each.held_out - y).mean() for each in (best, other))
        if weighting == "label_sd" or weighted < plain:
            best = other._replace(weighted=True)
    error = best.held_out - y
    spread = fit_spread(z[:, :-1], error)
    factor = quantile_factor(error, spread.sd_nt(z[:, :-1]), groups) * few_groups_factor(error, groups)
    model = Linear(
        inputs=inputs,
        constant_nt=float(best.beta[-1]),
        coefficients_nt=best.beta[:-1].copy(),
        spread=spread.scaled(factor),
        penalty=best.penalty,
        weighted=best.weighted,
    )
    return FittedLinear(model, best.held_out, groups, weight if best.weighted else None)


def linear_of(weights: Weights) -> Linear:
    """The linear model of a weights file."""
    return linear_from(weights, weights.fit(like(len(weights.features))))


def linear_from(weights: Weights, tensors: Mapping[str, NDArray[Any]]) -> Linear:
    """A linear model from tensors, with the settings of a weights file."""
    return Linear(
        inputs=inputs_from(weights.features, tensors, weights.path),
        constant_nt=float(tensors["constant_nt"]),
        coefficients_nt=tensors["coefficients_nt"],
        spread=spread_from(tensors, "spread", weights.path),
        penalty=weights.number("penalty"),
        weighted=weights.expect("weighted", bool),
    )


def like(count: int) -> dict[str, Array]:
    """Tensors with the names, shapes and types of a linear model of `count` features."""
    return {
        **scaler_tensors(count),
        "coefficients_nt": np.ones(count),
        "constant_nt": np.array(1.0),
        **spread_like("spread", count),
    }


class _Solved(NamedTuple):
    """Coefficients with the intercept last, and predictions by fits without each row's fold."""

    beta: Array
    penalty: float
    held_out: Array
    weighted: bool = False


class _Ridge:
    """Solves (Z'WZ + p tr D)(beta - towards) = Z'W (y - Z towards) with and without each fold."""

    def __init__(
        self, z: Array, y: Array, folds: NDArray[np.intp], towards: Array, penalty: float | None
    ) -> None:
        self.z, self.y, self.folds, self.towards, self.penalty = z, y, folds, towards, penalty
        self.rows = [np.flatnonzero(folds == k) for k in range(int(folds.max()) + 1)]

    def __call__(self, weight: Array) -> _Solved:
        """Solve with weights of rows, shape (N,)."""
        curved, sloped, squares = [], [], []
        for rows in self.rows:
            z, w = self.z[rows], weight[rows]
            left = self.y[rows] - z @ self.towards
            curved.append(z.T @ (w[:, None] * z))
            sloped.append(z.T @ (w * left))
            squares.append(float(w @ left**2))
        whole, slope = np.sum(curved, axis=0), np.sum(sloped, axis=0)
        if len(self.rows) == 1:
            penalty = FALLBACK_PENALTY if self.penalty is None else self.penalty
            beta = self._solve(whole, slope, penalty)
            return _Solved(beta, penalty, self.z @ beta)
        parts = list(zip(curved, sloped, squares, strict=True))

        def loss(penalty: float) -> float:
            total = 0.0
            for a, b, c in parts:
                step = self._solve(whole - a, slope - b, penalty) - self.towards
                total += c - 2 * float(step @ b) + float(step @ a @ step)
            return total

        penalty = min(PENALTIES, key=loss) if self.penalty is None else self.penalty
        held_out = np.empty(len(self.y))
        for rows, (a, b, _) in zip(self.rows, parts, strict=True):
            held_out[rows] = self.z[rows] @ self._solve(whole - a, slope - b, penalty)
        return _Solved(self._solve(whole, slope, penalty), penalty, held_out)

    def _solve(self, curved: Array, sloped: Array, penalty: float) -> Array:
        """Coefficients; the intercept, last, has no penalty."""
        # the entry of the intercept is the sum of all weights, and z has unit variance
        ridge = np.full(len(curved), penalty * curved[-1, -1])
        ridge[-1] = 0.0
        return self.towards + np.linalg.lstsq(curved + np.diag(ridge), sloped, rcond=None)[0]
