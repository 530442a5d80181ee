"""Statistics of a map, heading by heading."""

from dataclasses import dataclass

import numpy as np

from magtwin.field.maps.map import AnomalyMap


@dataclass(frozen=True, kw_only=True)
class HeadingStatistics:
    """One heading of a map, over its valid nodes; figures are nan where there is none."""

    heading_deg: float
    """The heading [deg]."""

    nodes: int
    """Nodes of the heading."""

    masked: int
    """Nodes that are not valid."""

    mean_nt: float
    """Mean [nT]."""

    sd_nt: float
    """Standard deviation over the nodes [nT]."""

    least_nt: float
    """Smallest value [nT]."""

    greatest_nt: float
    """Largest value [nT]."""

    median_gradient_nt_m: float
    """Median slope of the magnitude along the floor, by central differences [nT/m]."""

    greatest_gradient_nt_m: float
    """Largest slope [nT/m]."""

    median_error_nt: float
    """Median standard deviation of a value, the root of the map's variance [nT]; nan where unknown."""


def statistics(field: AnomalyMap) -> tuple[HeadingStatistics, ...]:
    """The statistics of each heading of a map, in the order of its layers."""
    found = []
    for h, heading in enumerate(np.degrees(field.headings_rad)):
        valid = field.valid[h]
        values = np.where(valid, field.values_nt[h], np.nan)
        slope = np.hypot(*np.gradient(values, *field.cell_m[::-1]))
        slope, known = slope[np.isfinite(slope)], values[valid]
        errors = np.empty(0) if field.variance_nt2 is None else np.sqrt(field.variance_nt2[h][valid])
        found.append(
            HeadingStatistics(
                heading_deg=float(heading),
                nodes=valid.size,
                masked=int(np.count_nonzero(~valid)),
                mean_nt=float(known.mean()) if known.size else np.nan,
                sd_nt=float(known.std()) if known.size else np.nan,
                least_nt=float(known.min()) if known.size else np.nan,
                greatest_nt=float(known.max()) if known.size else np.nan,
                median_gradient_nt_m=float(np.median(slope)) if slope.size else np.nan,
                greatest_gradient_nt_m=float(slope.max()) if slope.size else np.nan,
                median_error_nt=float(np.median(errors)) if errors.size else np.nan,
            )
        )
    return tuple(found)
