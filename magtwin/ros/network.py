"""A network that reads rows as they come."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magtwin.run.run import Run

if TYPE_CHECKING:
    from magtwin.learn.magnetometer import NeuralMagnetometer


class Following:
    """A neural magnetometer that keeps the previous rows that its predictor needs as context."""

    def __init__(self, magnetometer: "NeuralMagnetometer") -> None:
        """Start without context."""
        self._magnetometer = magnetometer
        self._before: Run | None = None

    def __call__(self, run: Run) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_] | None]:
        """Disturbances and their standard deviations [nT], and whether inputs left the training range.

        Args:
            run: The next rows.
        """
        context = self._magnetometer.net.context
        if not run.rows:
            return np.zeros(0), np.zeros(0), np.zeros(0, bool)
        columns = run.select("t", *sorted(self._magnetometer.columns - {"t"}))
        whole = columns if self._before is None else Run.concat([self._before, columns])
        (read,) = self._magnetometer.read([whole])
        if context:
            self._before = whole.take(slice(max(whole.rows - context, 0), whole.rows))
        new = slice(whole.rows - run.rows, whole.rows)
        outside = None if read.outside is None else read.outside[new]
        return read.disturbance_nt[new], read.sd_nt[new], outside
