"""FieldModel: what fitting readings gives, whatever the method."""

import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.summary import Summarized, Summary, printable

Array = NDArray[np.float64]


class FieldModel(Protocol):
    """The total field over a floor, and how sure of it the readings make one."""

    @property
    def method(self) -> str:
        """Name of the method, as `magtwin map fit --method` takes it."""

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Figures that were fitted or chosen, by name with unit: numbers, texts, lists of them."""

    @property
    def noise_nt2(self) -> float:
        """Variance of a reading about the field [nT^2]: what the variance of `predict` leaves out."""

    def predict(self, p_xy: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array]:
        """Field and its variance at poses.

        Args:
            p_xy: Where base_link is, in world [m], shape (..., 2).
            yaw: Headings [rad], shape (...); the two shapes are broadcast.

        Returns:
            Field magnitude [nT] and variance of it [nT^2], each of shape (...); nan where the method
            knows nothing.
        """


class FittedModel(Summarized):
    """What every method's model shows of itself: method, figures and noise."""

    method: Any
    parameters: Any
    noise_nt2: Any

    def _summary(self) -> Summary:
        figures = [f"{name} {value}" for name, value in self.parameters.items()]
        return Summary(
            f"{type(self).__name__}: {self.method}, noise sd {math.sqrt(self.noise_nt2):.3g} nT",
            (("figures", printable(", ".join(figures))),),
            ("parameter", "value"),
            [(name, str(value)) for name, value in self.parameters.items()],
        )
