"""MapDifference: compare two surveys of one floor, and find what changed and where."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.grid import Grid
from magtwin.field.maps.map import AnomalyMap
from magtwin.report.report import Figure, Report
from magtwin.report.summary import Summarized, Summary

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

FALSE_SHARE = 0.05  # False-discovery rate: expected share of the nodes called changed that did not change
SD_PER_MAD = 1.4826  # Standard deviation of a normal distribution per median absolute deviation
GRAIN_M = 1e-3  # Heights that differ by less are equal: 5 nT in a steep field
LISTED = 20  # Most regions in a report, those of the greatest z first


@dataclass(frozen=True, kw_only=True)
class Region:
    """Adjacent nodes, also diagonally, whose field changed at some heading."""

    centre_m: tuple[float, float]  # World x and y of its centre, weighted by change [m]
    extent_m: tuple[float, float, float, float]  # Least x, greatest x, least y, greatest y of its nodes [m]
    nodes: int  # Number of nodes
    peak_nt: float  # Local change at the greatest |z| [nT]
    peak_sd_nt: float  # Standard deviation of that change if the field did not change [nT]
    peak_z: float  # z at that node
    peak_m: tuple[float, float]  # World x and y of that node [m]
    peak_heading_rad: float  # Heading of that node [rad]

    def text(self) -> str:
        """Place and significance, as text."""
        (x, y), (x0, x1, y0, y1) = self.centre_m, self.extent_m
        return (
            f"z {self.peak_z:.3g}, about ({x:.2f}, {y:.2f}) m, x {x0:g}..{x1:g}, y {y0:g}..{y1:g} m, "
            f"{self.nodes} node{'s' * (self.nodes > 1)}"
        )


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class MapDifference(Summarized):
    """Field of a later survey minus that of an earlier one, on their common nodes.

    Arrays are nan where one of the surveys is masked.
    """

    names: tuple[str, str]  # Names of the surveys, the earlier first
    days: tuple[str, str]  # Their days, "" if unknown
    grid: Grid  # Nodes of the comparison
    change_nt: Array  # Later minus earlier field [nT], shape (H, Y, X)
    bias_nt: Array  # Change common to all nodes of a heading, their median [nT], shape (H,)
    sd_nt: Array  # Standard deviation of a change if the field did not change [nT], shape (H, Y, X)
    # Whether `sd_nt` comes from the maps' variances, or else from the spread of the changes
    from_variance: bool
    z: Array  # Local change in standard deviations, shape (H, Y, X)
    threshold_z: float  # Least |z| of a changed node
    regions: tuple[Region, ...]  # Changed regions, the greatest |z| first
    cautions: tuple[str, ...] = ()  # Reasons to doubt that the surveys are comparable

    @property
    def local_nt(self) -> Array:
        """Change minus the bias of its heading [nT], shape (H, Y, X)."""
        return self.change_nt - self.bias_nt[:, None, None]

    @property
    def changed(self) -> Flags:
        """Nodes whose field changed, shape (H, Y, X)."""
        return np.abs(self.z) >= self.threshold_z  # false for nan

    def report(self) -> Report:
        """What changed, where, and how significantly."""
        known = np.isfinite(self.z)
        local = self.local_nt[known]
        count, changed = int(known.sum()), int(self.changed.sum())
        robust = "a map has no variance: from the robust spread"
        source = "from both maps' variances" if self.from_variance else robust
        h, j, i = np.unravel_index(np.nanargmax(np.abs(self.z)), self.z.shape)
        mean, spread = float(self.bias_nt.mean()), float(self.bias_nt.std())
        surest, sd = float(self.local_nt[h, j, i]), float(self.sd_nt[h, j, i])
        x, y, heading = self.grid.x_m[i], self.grid.y_m[j], np.degrees(self.grid.headings_rad[h])
        where = f"z {self.z[h, j, i]:.3g}, at ({x:g}, {y:g}) m, heading {heading:g} deg"
        figures = [
            Figure("compared nodes", count, note="over all headings"),
            Figure("common bias", mean, "nT", spread, "mean and spread over headings"),
            Figure("spread of local changes", _robust_sd(local), "nT", note="robust"),
            Figure("expected spread", float(np.sqrt(np.mean(self.sd_nt[known] ** 2))), "nT", note=source),
        ]
        if self.from_variance:
            note = "robust; 1 if the variances are right and little changed"
            figures.append(Figure("spread of z", _robust_sd(self.z[known]), note=note))
        rate = f"|z|, for a false-discovery rate of {FALSE_SHARE:.0%}"
        figures += [
            Figure("surest local change", surest, "nT", sd, where),
            Figure("threshold", self.threshold_z, note=rate),
            Figure("changed nodes", changed, note=f"{changed / count:.1%} of those compared"),
            Figure("regions", len(self.regions)),
        ]
        for number, region in enumerate(self.regions[:LISTED], 1):
            figures.append(Figure(f"region {number}", region.peak_nt, "nT", region.peak_sd_nt, region.text()))
        metadata: dict[str, Any] = dict(zip(("from", "to"), self._surveys, strict=True))
        if self.cautions:
            metadata["caution"] = list(self.cautions)
        return Report(f"difference {self.names[0]} to {self.names[1]}", tuple(figures), metadata)

    @property
    def _surveys(self) -> list[str]:
        """Name and day of each survey."""
        return [" ".join(text for text in pair if text) for pair in zip(self.names, self.days, strict=True)]

    def _summary(self) -> Summary:
        before, after = self._surveys
        known, changed = (int(a.any(axis=0).sum()) for a in (np.isfinite(self.z), self.changed))
        return Summary(
            f"MapDifference: {before} to {after}",
            (
                ("nodes", f"{changed:,} of {known:,} changed (|z| >= {self.threshold_z:.2f})"),
                ("bias", f"{self.bias_nt.mean():+.3g} nT, mean over {len(self.bias_nt)} headings"),
                ("regions", f"{len(self.regions)}" + (f"; first: {self.regions[0]}" if self.regions else "")),
                ("caution", "; ".join(self.cautions)),
            ),
        )


def difference(a: AnomalyMap, b: AnomalyMap) -> MapDifference:
    """Compare two surveys of one floor.

    They are compared at the nodes of the coarser grid and the headings of the map with fewer, where both are
    valid; the other map is interpolated there, and its variance holds the error of interpolation if it is
    known: fit surveys on one grid to compare them closely.

    A node's change is b - a. The median over a heading is the bias common to all nodes, such as the day's
    Earth field and the sensor's offset; the rest is local. If both maps have variances, the standard
    deviation of a change is sqrt(V_a + V_b). Otherwise it is one value for all nodes, 1.4826 times their
    median absolute deviation, which is robust to changes on less than half of the floor. It is at least one
    step of single precision, the precision of map layers.

    A node has changed if |z| reaches the threshold of Benjamini and Hochberg (J. R. Statist. Soc. B 57, 289,
    1995): with two-sided normal p-values in ascending order, the last p_k <= k q / m. The false-discovery
    rate is q = 5 %, for independent or positively dependent errors.

    `a` is the earlier survey, `b` the later one. Maps without a common node, or that differ in frame, datum
    or height, are refused. If one of these is unknown, the report has a caution.
    """
    a, b = a.relative(), b.relative()
    cautions = _compared(a, b)
    grid = _common(a, b)
    p, yaw = grid.poses()
    from_variance = a.variance_nt2 is not None and b.variance_nt2 is not None
    if from_variance:
        (earlier, sd_a), (later, sd_b) = (each.lookup_with_sd(p, yaw) for each in (a, b))
    else:
        earlier, later = (each.lookup(p, yaw) for each in (a, b))
    change = later - earlier
    known = np.isfinite(change)
    if not known.any():
        raise InputError(f"maps {a.name!r} and {b.name!r} have no valid node in common")
    seen = known.any(axis=(1, 2))
    bias = np.zeros(len(change))
    bias[seen] = np.nanmedian(change[seen], axis=(1, 2))
    local = change - bias[:, None, None]
    floor = float(np.spacing(np.float32(np.abs(b.values_nt[b.valid]).max())))
    sd = np.hypot(sd_a, sd_b) if from_variance else np.where(known, _robust_sd(local[known]), np.nan)
    sd = np.maximum(sd, floor)
    z = local / sd
    threshold = _threshold(np.abs(z[known]))
    return MapDifference(
        names=(a.name, b.name),
        days=(a.created, b.created),
        grid=grid,
        change_nt=change,
        bias_nt=bias,
        sd_nt=sd,
        from_variance=from_variance,
        z=z,
        threshold_z=threshold,
        regions=_regions(grid, local, z, threshold),
        cautions=cautions,
    )


def _compared(a: AnomalyMap, b: AnomalyMap) -> tuple[str, ...]:
    """Cautions about comparing two maps; refuses maps whose nodes are different places."""
    for name in ("frame", "datum"):
        first, second = getattr(a, name), getattr(b, name)
        if first != second and first and second:
            raise InputError(
                f"map {a.name!r} has the {name} {first!r} and {b.name!r} {second!r}, so that one x and y are "
                "two places; bring the readings of one into the other's before its map is made, or, where "
                f"both mean the same, make both with one --{name}"
            )
    if a.height_m is not None and b.height_m is not None and abs(a.height_m - b.height_m) > GRAIN_M:
        raise InputError(
            f"map {a.name!r} is of {a.height_m:g} m above the floor and {b.name!r} of {b.height_m:g} m; take "
            "one to the other's height first (magtwin map upward)"
        )
    cautions = []
    names = {"frame": "frame", "datum": "datum", "height_m": "height"}
    unknown = {text: sum(getattr(m, name) in ("", None) for m in (a, b)) for name, text in names.items()}
    for count, which in ((1, "one map"), (2, "both maps")):
        if some := [name for name, maps in unknown.items() if maps == count]:
            cautions.append(f"{', '.join(some)} unknown in {which}; assumed equal")
    return tuple(cautions)


def _common(a: AnomalyMap, b: AnomalyMap) -> Grid:
    """Nodes of the comparison."""
    coarse = b if np.prod(b.cell_m) > np.prod(a.cell_m) * (1 + 1e-9) else a
    few = b if len(b.headings_rad) < len(a.headings_rad) else a
    return replace(coarse.grid, headings_rad=few.grid.headings_rad)


def _robust_sd(values: Array) -> float:
    return SD_PER_MAD * float(np.median(np.abs(values - np.median(values))))


def _threshold(size: Array) -> float:
    """|z| with the two-sided p-value q k / m; k is the number of nodes called changed, at least 1."""
    from scipy.special import erfc, erfcinv

    p = np.sort(erfc(size / np.sqrt(2)))
    called = np.flatnonzero(p <= FALSE_SHARE * np.arange(1, len(p) + 1) / len(p))
    count = called[-1] + 1 if len(called) else 1
    return float(np.sqrt(2) * erfcinv(FALSE_SHARE * count / len(p)))


def _regions(grid: Grid, local: Array, z: Array, threshold: float) -> tuple[Region, ...]:
    """Connected nodes of the floor that changed at some heading."""
    from scipy.ndimage import find_objects, label

    size = np.nan_to_num(np.abs(z))
    labels, _ = label((size >= threshold).any(axis=0), structure=np.ones((3, 3)))
    most = np.nan_to_num(np.abs(local)).max(axis=0)
    regions = []
    for number, box in enumerate(find_objects(labels), 1):
        rows, columns = box
        j, i = np.nonzero(labels[box] == number)
        j, i = j + rows.start, i + columns.start
        x, y, weight = grid.x_m[i], grid.y_m[j], most[j, i]
        h, k = np.unravel_index(np.argmax(size[:, j, i]), (len(z), len(j)))
        regions.append(
            Region(
                centre_m=(float(np.average(x, weights=weight)), float(np.average(y, weights=weight))),
                extent_m=(float(x.min()), float(x.max()), float(y.min()), float(y.max())),
                nodes=len(j),
                peak_nt=float(local[h, j[k], i[k]]),
                peak_sd_nt=float(local[h, j[k], i[k]] / z[h, j[k], i[k]]),
                peak_z=float(z[h, j[k], i[k]]),
                peak_m=(float(x[k]), float(y[k])),
                peak_heading_rad=float(grid.headings_rad[h]),
            )
        )
    return tuple(sorted(regions, key=lambda r: -abs(r.peak_z)))
