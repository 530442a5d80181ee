"""What is known about a map: statistics per heading, metadata, colour limits."""

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.report.report import Figure, Report
from magtwin.report.summary import span

Array = NDArray[np.float64]


def statistics(field: AnomalyMap, heading: int) -> dict[str, float]:
    """Statistics of one heading over its valid nodes, by name with unit.

    A figure is nan if there is no such node. Errors are standard deviations, gradients are those of the
    magnitude along the floor, by central differences.
    """
    valid = field.valid[heading]
    values = np.where(valid, field.values_nt[heading], np.nan)
    slope = np.hypot(*np.gradient(values, *field.cell_m[::-1]))
    slope, known = slope[np.isfinite(slope)], values[valid]
    errors = np.empty(0) if field.variance_nt2 is None else np.sqrt(field.variance_nt2[heading][valid])

    def of(figure: Callable[[Array], Any], values: Array) -> float:
        return float(figure(values)) if values.size else np.nan

    return {
        "heading_deg": float(np.degrees(field.headings_rad[heading])),
        "nodes": valid.size,
        "masked": int(np.count_nonzero(~valid)),
        "mean_nt": of(np.mean, known),
        "sd_nt": of(np.std, known),
        "least_nt": of(np.min, known),
        "greatest_nt": of(np.max, known),
        "median_gradient_nt_m": of(np.median, slope),
        "greatest_gradient_nt_m": of(np.max, slope),
        "median_error_nt": of(np.median, errors),
    }


_FILE = re.compile(r"(?P<name>.+?) sha256:(?P<sha256>[0-9a-f]{64})")

_TEXTS = ("method", "frame", "datum", "created", "licence")


def map_metadata(field: AnomalyMap) -> Report:
    """All that is known about a map: statistics, uncertainty, method and source.

    Unknown entries are "unknown".
    """
    figures = [*field.report().figures]
    share = 100 * field.known.nodes / math.prod(field.grid.shape)
    figures.append(Figure("valid share", round(share, 2), "%", note="of the nodes, over all headings"))
    x0, x1, y0, y1 = field.extent
    dx, dy = field.cell_m
    extent = f"x {x0:g}..{x1:g}, y {y0:g}..{y1:g}"
    figures.append(Figure("extent", extent, "m", note=f"cells {dx:g} x {dy:g} m"))
    known = np.empty(0) if field.variance_nt2 is None else field.variance_nt2[field.valid]
    if not known.size:
        figures.append(Figure("standard deviation", "unknown"))
    else:
        low, middle, high = np.sqrt(np.percentile(known, (0, 50, 100)))
        note = f"median; from {low:.3g} to {high:.3g} nT"
        figures.append(Figure("standard deviation", float(middle), "nT", note=note))
    figures += offset_figures(field)
    if field.height_m is None:
        figures.append(Figure("height", "unknown"))
    else:
        figures.append(Figure("height", field.height_m, "m", note="of the sensor above the floor"))
    figures += _headings(field)
    if field.harmonic is not None:
        figures += _harmonic(field.harmonic, "sensor" if field.height_m is None else "floor")
    metadata: dict[str, Any] = {"headings deg": ", ".join(f"{h:.6g}" for h in np.degrees(field.headings_rad))}
    metadata |= {name: getattr(field, name) or "unknown" for name in _TEXTS}
    if field.parameters:
        metadata["parameters"] = dict(field.parameters)
    files = source_files(field.source)
    metadata |= {"files": files} if files else {"source": field.source or "unknown"}
    return Report(f"map {field.name}", tuple(figures), metadata)


def offset_figures(field: AnomalyMap) -> list[Figure]:
    """The noise of readings about a map, and the offset that a map of one drive leaves open, if known."""
    noise = []
    if field.noise_nt2:
        note = "of a reading about the map; not part of the standard deviation"
        noise.append(Figure("noise", round(field.noise_nt2**0.5, 1), "nT", note=note))
    if not field.offset_sd_nt:
        return noise
    note = "part of it: one drive cannot tell what its robot adds alike throughout from the room's field"
    return [*noise, Figure("offset sd", field.offset_sd_nt, "nT", note=note)]


def source_files(source: str) -> dict[str, str]:
    """Source files of a map with their SHA-256, by name; empty if the source has another format.

    Different files of one name are numbered: "name (2)".
    """
    files: dict[str, str] = {}
    for part in source.split("; "):
        match = _FILE.fullmatch(part)
        if match is None:
            return {}
        name, count = match["name"], 1
        while files.get(name, match["sha256"]) != match["sha256"]:
            count += 1
            name = f"{match['name']} ({count})"
        files[name] = match["sha256"]
    return files


def _headings(field: AnomalyMap) -> list[Figure]:
    """Mean and standard deviation of each heading, with its range and masked share."""
    figures = []
    for row in (statistics(field, h) for h in range(len(field.headings_rad))):
        name = f"heading {row['heading_deg']:.6g}"
        if row["masked"] == row["nodes"]:
            figures.append(Figure(name, "no valid node"))
            continue
        extremes = span(row["least_nt"], row["greatest_nt"], "nT")
        note = f"{extremes}; {100 * row['masked'] / row['nodes']:.3g} % masked"
        figures.append(Figure(name, round(row["mean_nt"], 1), "nT", round(row["sd_nt"], 1), note))
    return figures


def _harmonic(harmonic: HarmonicField, above: str) -> list[Figure]:
    """Figures of the sources and of the robot; depths count from `above`."""
    depths = -harmonic.p_world_dipole[:, 2]
    below = f"{depths.min():.3g} to {depths.max():.3g} m below the {above}" if len(depths) else ""
    figures = [Figure("dipoles", len(depths), note=below)]
    for name, vector in (("uniform field", harmonic.b_uniform_nt), ("hard iron", harmonic.hard_iron_nt)):
        note = "(" + ", ".join(f"{c:.5g}" for c in vector) + ")"
        figures.append(Figure(name, float(np.linalg.norm(vector)), "nT", note=note))
    soft = float(np.linalg.norm(harmonic.soft_iron, 2))
    x, y, z = harmonic.p_base_sensor
    return [
        *figures,
        Figure("soft iron", soft, "nT/nT", note="greatest part of a field that it adds"),
        Figure("sensor", f"({x:.4g}, {y:.4g}, {z:.4g})", "m", note="in base_link"),
    ]


COLOUR_MAP = "viridis"  # Name of the colour map for fields
# Share of nodes left out at either end of a colour scale: a few nodes beside a source would flatten the rest
OUTER_PERCENT = 0.5


def colour_limits(values: ArrayLike, outer_percent: float = OUTER_PERCENT) -> tuple[float, float]:
    """Values at the two ends of a colour scale.

    Values that are not finite are ignored; `outer_percent` is left out at either end. 0 and 1 if no value is
    finite.
    """
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, (outer_percent, 100 - outer_percent))
    return float(low), float(high)


def apart(low: float, high: float) -> tuple[float, float]:
    """The ends of a scale, moved apart about their middle if they are one value but for rounding."""
    if high - low > max(1e-5 * max(abs(low), abs(high)), 1e-6):
        return low, high
    middle = (low + high) / 2
    reach = max(abs(middle) / 10, 1.0)
    return middle - reach, middle + reach


def heading_harmonics(field: AnomalyMap, most: int, enough_nt: float) -> tuple[NDArray[np.float64], float]:
    """A map as harmonics of the heading, B = c0 + sum_k ck cos(k h) + sk sin(k h), by least squares.

    Args:
        field: The map.
        most: Most harmonics, K.
        enough_nt: RMS error that needs no more [nT].

    Returns:
        The coefficients c0, c1, s1, ... [nT], shape (1 + 2 K, Y, X), 0 at nodes that some heading lacks; and
        the RMS error at the others [nT].
    """
    known, turns = field.valid.all(axis=0), field.headings_rad
    values, rms = np.where(known, field.values_nt, 0.0), 0.0
    for order in range(most + 1):
        waves = [f(k * turns) for k in range(order + 1) for f in ((np.cos, np.sin) if k else (np.cos,))]
        basis = np.stack(waves, axis=1)
        parts = np.tensordot(np.linalg.pinv(basis), values, 1)
        if known.any():
            rms = float(np.sqrt(np.mean((np.tensordot(basis, parts, 1) - values)[:, known] ** 2)))
        if rms < enough_nt or 2 * order + 1 >= len(turns):
            break
    return parts, rms
