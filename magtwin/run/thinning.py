"""Thinning: stretches of a recording, and its rows at a lower rate without losing readings to dropouts."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from magtwin.run.run import Run

Rows = NDArray[np.intp]


def field_known(run: Run) -> NDArray[np.bool_]:
    """Readings that hold a measured field and whose magnetometer had lock, shape (N,)."""
    known = np.isfinite(run.get("b_measured_nt", np.zeros(run.rows)))
    return known & ~run["flag_lost_lock"] if "flag_lost_lock" in run else known


def stretches(flags: NDArray[np.bool_]) -> Rows:
    """First row of each stretch in which a flag is set, and the one after its last, shape (K, 2)."""
    return np.flatnonzero(np.diff(flags, prepend=False, append=False)).reshape(-1, 2)


def newest(ends: Rows, good: NDArray[np.bool_]) -> Rows:
    """The newest good row of each stretch of rows, shape (M,); its last row if none is good."""
    latest = np.maximum.accumulate(np.where(good, np.arange(len(good)), -1))[ends]
    begins = np.concatenate([[0], ends[:-1] + 1])
    return np.where(latest >= begins, latest, ends)


def rows_shown(run: Run, most: int) -> Rows:
    """At most about `most` rows to draw: all, or of each stretch the first and that with the largest step."""
    if run.rows <= most:
        return np.arange(run.rows)
    name = next((name for name in ("b_measured_nt", "b_total_nt", "t") if name in run), "t")
    step = np.abs(np.convolve(np.nan_to_num(run[name]), [-0.5, 1, -0.5], "same"))
    edges = np.linspace(0, run.rows, most // 2 + 1).astype(int)
    worst = [a + int(np.argmax(step[a:b])) for a, b in pairwise(edges)]
    return np.unique([*edges[:-1], *worst, run.rows - 1])
