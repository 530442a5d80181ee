"""Colours of a field: which values the two ends of a scale stand for, on paper as on a stage's floor."""

import numpy as np
from numpy.typing import ArrayLike

COLOUR_MAP = "viridis"
"""Name of the scale that fields are shown in."""

OUTER_PERCENT = 0.5
"""Share of the nodes at either end that a scale leaves out: a few beside a source would flatten the rest."""


def colour_limits(values: ArrayLike, outer_percent: float = OUTER_PERCENT) -> tuple[float, float]:
    """Values at the ends of a scale.

    Args:
        values: What is shown, any shape; what is not finite does not count.
        outer_percent: Share of them that is left out at either end [%].

    Returns:
        The least and the greatest of the rest; 0 and 1 where no value is finite.
    """
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (outer_percent, 100 - outer_percent))
    return float(low), float(high)
