"""Mixture: the weighted mean of two fits, where their errors differ."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.fit.methods import FieldModel, FittedModel, values_of
from magtwin.field.survey.axes import SurveyAxes

Array = NDArray[np.float64]


def mixed(
    weights: Sequence[float], values: Sequence[Array], variances: Sequence[Array]
) -> tuple[Array, Array]:
    """Weighted mean of predictions [nT], and its variance [nT^2].

    Standard deviations are averaged too. This is the variance if the errors of the fits are fully correlated;
    it is an upper bound if they are not.
    """
    mean = sum(w * value for w, value in zip(weights, values, strict=True))
    sd = sum(w * np.sqrt(v) for w, v in zip(weights, variances, strict=True))
    return np.asarray(mean), np.asarray(sd**2)


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Mixture(FittedModel):
    """The weighted mean of several fits of one survey."""

    models: tuple[FieldModel, ...]  # The fits
    weights: tuple[float, ...]  # Their weights, of sum 1
    parameters: Mapping[str, Any]  # Those of the fits, by name with unit

    @classmethod
    def of(cls, models: Sequence[FieldModel], weights: Sequence[float]) -> "Mixture":
        """Mix fits. The parameters of all but the first get the method as a prefix."""
        parameters = dict(models[0].parameters)
        for model in models[1:]:
            parameters |= {f"{model.method} {name}": value for name, value in model.parameters.items()}
        parameters["weights"] = [float(w) for w in weights]
        return cls(models=tuple(models), weights=tuple(weights), parameters=parameters)

    def placed(self, axes: SurveyAxes) -> "Mixture":
        """The mixture for poses in world, if its fits were made in `axes`."""
        placed = [model.placed(axes) for model in self.models]  # type: ignore[attr-defined]
        mixture = Mixture.of(placed, self.weights)
        return replace(mixture, parameters={**self.parameters, **mixture.parameters})

    @property
    def method(self) -> str:
        """Names of the methods, joined by a plus."""
        return " + ".join(model.method for model in self.models)

    @property
    def noise_nt2(self) -> float:
        """Variance of a reading about the field [nT^2]."""
        noise = sum(w * np.sqrt(m.noise_nt2) for w, m in zip(self.weights, self.models, strict=True))
        return float(noise**2)

    @property
    def field(self) -> Any:
        """The harmonic field of the first fit that has one, else None; the directions of the map's field."""
        return next((m.field for m in self.models if hasattr(m, "field")), None)

    def predict(self, p_xy: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array]:
        """Field [nT] and its variance [nT^2] at poses; see `FieldModel` and `mixed`."""
        return self._mixed([model.predict(p_xy, yaw) for model in self.models])

    def predict_nodes(self, p_xy: Array, yaw: float) -> tuple[Array, Array]:
        """`predict` on evenly spaced nodes at one heading, shape (Y, X, 2)."""
        return self._mixed([getattr(m, "predict_nodes", m.predict)(p_xy, yaw) for m in self.models])

    def predict_values(self, p_xy: ArrayLike, yaw: ArrayLike) -> Array:
        """The field of `predict` alone [nT]."""
        values = (values_of(model, p_xy, yaw) for model in self.models)
        return np.asarray(sum(w * value for w, value in zip(self.weights, values, strict=True)))

    def _mixed(self, predicted: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
        return mixed(self.weights, [value for value, _ in predicted], [variance for _, variance in predicted])
