"""Changes of the scene between runs: places where two runs of a survey contradict each other."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from magtwin.field.survey.readings import Readings

Array = NDArray[np.float64]

TOUCH_M = 0.1  # Largest distance between readings of two runs that are compared [m]
TOUCH_RAD = 0.5  # Largest difference of their headings [rad]
CELL_M = 0.25  # Side of the squares in which differences are averaged [m]
LEAST_PAIRS = 5  # Fewest compared readings in a square
LEAST_CELLS = 10  # Fewest squares that two runs share
MOST_ROWS = 20_000  # Most readings of a run that are compared
# Difference that counts as a change, in robust standard deviations of all squares of all pairs of runs: with
# normal errors, one square of half a billion
CHANGED = 6.0
MAD = 1.4826  # Standard deviation of normal errors over their median absolute deviation


@dataclass(frozen=True)
class Change:
    """A place where two runs contradict each other most."""

    runs: tuple[str, str]  # Names of the runs
    p_xy: tuple[float, float]  # Centre of the square with the largest difference [m]
    nt: float  # Difference of the means there [nT]: of the vectors if there are any, else of the magnitudes
    cells: int  # Squares in which the runs contradict each other
    shared: int  # Squares that both runs passed
    usual_nt: float  # Usual difference of two runs in a square [nT]

    def __str__(self) -> str:
        x, y = self.p_xy
        one, other = self.runs
        return (
            f"the scene changed between runs {one} and {other}: by {self.nt:,.0f} nT at x {x:.2f}, "
            f"y {y:.2f} m, in {self.cells} of {self.shared} shared squares of {CELL_M:g} m "
            f"(usual difference {self.usual_nt:,.0f} nT)"
        )


def scene_changes(readings: Readings) -> list[Change]:
    """Pairs of runs that contradict each other, the largest difference first.

    Readings of two runs are compared where they lie within `TOUCH_M` and `TOUCH_RAD`, and their differences
    averaged in squares. The usual difference, from pose errors and gradients, is the robust spread over all
    squares of all pairs. A square is changed if its difference exceeds `CHANGED` times that.
    """
    from scipy.spatial import cKDTree

    good = readings.good
    field = readings.b_nt[:, None] if readings.b_body_nt is None else readings.b_body_nt
    rows = [np.flatnonzero(good & (readings.run == k)) for k in range(len(readings.runs))]
    rows = [r[np.unique(np.linspace(0, len(r) - 1, min(len(r), MOST_ROWS)).astype(int))] for r in rows]
    runs = [k for k, r in enumerate(rows) if len(r)]
    trees = {k: cKDTree(readings.p_xy[rows[k]]) for k in runs} if len(runs) > 1 else {}
    compared = []
    for a, b in combinations(runs, 2):
        far, near = trees[a].query(readings.p_xy[rows[b]], distance_upper_bound=TOUCH_M)
        met = np.isfinite(far)
        one, other = rows[a][near[met]], rows[b][met]
        turned = np.angle(np.exp(1j * (readings.yaw[other] - readings.yaw[one])))
        alike = np.abs(turned) < TOUCH_RAD
        one, other = one[alike], other[alike]
        square = np.floor(readings.p_xy[other] / CELL_M).astype(np.int64)
        squares, index, count = np.unique(square, axis=0, return_inverse=True, return_counts=True)
        away = field[other] - field[one]
        mean = np.column_stack([np.bincount(index.ravel(), part, len(count)) for part in away.T])
        kept = count >= LEAST_PAIRS
        if np.count_nonzero(kept) >= LEAST_CELLS:
            compared.append((a, b, squares[kept], mean[kept] / count[kept, None]))
    if not compared:
        return []
    usual = MAD * np.median(np.abs(np.concatenate([mean for *_, mean in compared])), axis=0)
    found = []
    for a, b, squares, difference in compared:
        size = np.linalg.norm(difference, axis=1)
        changed = (np.abs(difference) > CHANGED * usual).any(axis=1)
        if changed.any():
            most = int(np.argmax(np.where(changed, size, 0)))
            x, y = (CELL_M * (squares[most] + 0.5)).tolist()
            names = (readings.runs[a] or str(a + 1), readings.runs[b] or str(b + 1))
            many, nt, least = int(changed.sum()), float(size[most]), float(np.linalg.norm(usual))
            found.append(Change(names, (x, y), nt, many, len(size), least))
    return sorted(found, key=lambda change: -change.nt)


def changes_line(readings: Readings) -> str:
    """The largest change between runs in one line, with the number of pairs; "" if there is none."""
    found = scene_changes(readings)
    if not found:
        return ""
    others = f"; pairs of runs that differ: {len(found)}" if len(found) > 1 else ""
    return f"{found[0]}{others}; leave out the runs that no longer hold"
