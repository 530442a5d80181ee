"""Following: a neural magnetometer that reads rows as they arrive."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtwin.run.run import Run

if TYPE_CHECKING:
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer


class Following:
    """A neural magnetometer that reads rows as they arrive, in blocks of any length."""

    def __init__(self, magnetometer: "NeuralMagnetometer") -> None:
        self._magnetometer = magnetometer

    def __call__(self, run: Run) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_] | None]:
        """Disturbances, their standard deviations [nT], and whether rows are outside the training range.

        Args:
            run: The next rows.
        """
        if not run.rows:
            return np.zeros(0), np.zeros(0), np.zeros(0, bool)
        (read,) = self._magnetometer.read([run.select("t", *sorted(self._magnetometer.columns - {"t"}))])
        return read.disturbance_nt, read.sd_nt, read.outside
