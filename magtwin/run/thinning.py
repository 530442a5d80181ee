"""Thinning: rows of a recording at a lower rate, without losing readings to dropouts."""

import numpy as np
from numpy.typing import NDArray

from magtwin.run.run import Run

Rows = NDArray[np.intp]


def field_known(run: Run) -> NDArray[np.bool_]:
    """Readings that hold a measured field and whose magnetometer had lock, shape (N,)."""
    known = np.isfinite(run.get("b_measured_nt", np.zeros(run.rows)))
    return known & ~run["flag_lost_lock"] if "flag_lost_lock" in run else known


def newest(ends: Rows, good: NDArray[np.bool_]) -> Rows:
    """The newest good row of each stretch of rows; its last row if none is good.

    Returns:
        Shape (M,).
    """
    latest = np.maximum.accumulate(np.where(good, np.arange(len(good)), -1))[ends]
    begins = np.concatenate([[0], ends[:-1] + 1])
    return np.where(latest >= begins, latest, ends)
