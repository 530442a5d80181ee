"""Methods that fit readings: the protocols, and where a method gets its name.

A new method is a function that takes `Readings` and returns a `FieldModel`. Its options are keyword-only:

    @map_method("mean")
    def fit_mean(readings: Readings, *, floor_nt: float = 0.0) -> FieldModel: ...

An installed package announces its methods as entry points of the group `magtwin.map_methods`. Then
`magtwin map fit --method mean` and `fit(readings, "mean")` find it.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.extend import Registry
from magtwin.field.survey.axes import WORLD, SurveyAxes
from magtwin.field.survey.readings import Readings
from magtwin.report.summary import Summarized, Summary, printable

Array = NDArray[np.float64]
Method = TypeVar("Method", bound=Callable[..., Any])
Model = TypeVar("Model", bound="FittedModel")


class FieldModel(Protocol):
    """A fit's total field over a floor, and how certain it is. It may have three more members.

    `predict_nodes(p_xy, yaw)`, with the arguments and results of `predict`, is used for the nodes of a map.
    `predict_values(p_xy, yaw)`, the field of `predict` alone, is used where no variance is needed.
    `field`, a `HarmonicField`, becomes the map's.
    """

    @property
    def method(self) -> str:
        """Name of the method."""

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Fitted or chosen parameters by name with unit: numbers, texts, lists of them."""

    @property
    def noise_nt2(self) -> float:
        """Variance of a reading about the field [nT^2]; not part of the variance of `predict`."""

    def predict(self, p_xy: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array]:
        """Field and its variance at poses.

        Args:
            p_xy: Positions of base_link in world [m], shape (..., 2).
            yaw: Headings [rad], shape (...); the two shapes are broadcast.

        Returns:
            Field magnitude [nT] and its variance [nT^2], each of shape (...); nan where unknown.
        """


class MapMethod(Protocol):
    """A function that fits readings. Every other parameter is an option, keyword-only.

    If it has an option `progress`, that is called as progress(done, total, what).
    """

    def __call__(self, readings: Readings, /, **options: Any) -> FieldModel:
        """Fit the good readings of a survey; raise `InputError` if they make no map."""


# Map methods by name
METHODS: Registry[MapMethod] = Registry(
    "method",
    "map_methods",
    {
        "trilinear": "magtwin.field.fit.interpolation:fit_trilinear",
        "cubic": "magtwin.field.fit.interpolation:fit_cubic",
        "gp": "magtwin.field.fit.gp:fit_gp",
        "harmonic": "magtwin.field.fit.harmonic.inversion:fit_harmonic",
        "auto": "magtwin.field.fit.choice:fit_auto",
    },
)
map_method = METHODS.register  # Decorator that names a map method


def in_own_axes(method: Method) -> Method:
    """Decorate a map method that `fit` gives the survey in its own axes (`SurveyAxes`).

    Its models are `FittedModel`, and `FittedModel.placed` takes them into the world.
    """
    method.own_axes = True  # type: ignore[attr-defined]
    return method


class FittedModel(Summarized):
    """A built-in method's model: axes, and a summary of method, parameters and noise."""

    method: Any
    parameters: Any
    noise_nt2: Any
    axes: SurveyAxes = WORLD  # Axes in which it was fitted

    def placed(self: Model, axes: SurveyAxes) -> Model:
        """The model for poses in world, if it was fitted in `axes`."""
        return replace(self, axes=axes)  # type: ignore[type-var, return-value]

    def own_poses(self, p_xy: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array, tuple[int, ...]]:
        """Rows of poses in the model's axes, and the shape of the poses; see `flat_poses`."""
        p, angle, shape = flat_poses(p_xy, yaw)
        return *self.axes.own_poses(p, angle), shape

    def _summary(self) -> Summary:
        figures = [f"{name} {value}" for name, value in self.parameters.items()]
        return Summary(
            f"{type(self).__name__}: {self.method}, noise sd {math.sqrt(self.noise_nt2):.3g} nT",
            (("figures", printable(", ".join(figures))),),
            ("parameter", "value"),
            [(name, str(value)) for name, value in self.parameters.items()],
        )


def values_of(model: FieldModel, p_xy: ArrayLike, yaw: ArrayLike) -> Array:
    """Field at poses [nT], without its variance where the model can leave that out."""
    fast = getattr(model, "predict_values", None)
    return np.asarray(model.predict(p_xy, yaw)[0] if fast is None else fast(p_xy, yaw))


def flat_poses(p_xy: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array, tuple[int, ...]]:
    """Broadcast poses to rows; also returns their shape."""
    p, angle = np.asarray(p_xy, float), np.asarray(yaw, float)
    if p.ndim == 0 or p.shape[-1] != 2:
        raise InputError(f"p_xy must have shape (..., 2), got {p.shape}")
    shape = np.broadcast_shapes(p.shape[:-1], angle.shape)
    return np.broadcast_to(p, (*shape, 2)).reshape(-1, 2), np.broadcast_to(angle, shape).reshape(-1), shape
