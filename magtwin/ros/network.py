"""The network of a live node: a neural magnetometer that reads rows as they arrive."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtwin.run.run import Run

if TYPE_CHECKING:
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer


def read_rows(
    magnetometer: "NeuralMagnetometer", run: Run
) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_] | None]:
    """Disturbances, their standard deviations [nT], and whether the rows are outside the training range."""
    if not run.rows:
        return np.zeros(0), np.zeros(0), np.zeros(0, bool)
    (read,) = magnetometer.read([run.select("t", *sorted(magnetometer.columns - {"t"}))])
    return read.disturbance_nt, read.sd_nt, read.outside
