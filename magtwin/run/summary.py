"""The summary of a Run: size, origin, path, range of the field, and flags."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.report.summary import Summary, listed, rectangle, span

Columns = Mapping[str, NDArray[Any]]


def run_summary(
    columns: Columns, metadata: Mapping[str, Any], described: Sequence[tuple[str, ...]]
) -> Summary:
    """The summary of a run."""
    flags = _flags(columns)
    lines = (
        ("from", _origin(metadata)),
        ("path", _driven(columns)),
        ("floor", swept(metadata)),
        ("field", _field_range(columns)),
        ("flags" if flags else "columns", flags or listed(columns)),
    )
    return Summary(_title(columns), lines, ("column", "unit", "frame", "what it is"), described)


def _title(columns: Columns) -> str:
    """Rows, columns, duration and rate."""
    rows = len(next(iter(columns.values()))) if columns else 0
    size = f"Run: {rows:,} rows x {len(columns)} columns"
    t = columns.get("t", np.array([]))
    if t.dtype.kind not in "fiu" or t.ndim != 1 or len(t) < 2:
        return size
    step = float(np.median(np.diff(t)))
    rate = f" at {1 / step:.4g} Hz" if step > 0 else ""
    return f"{size}, {float(t[-1] - t[0]):.4g} s{rate}"


def _origin(metadata: Mapping[str, Any]) -> str:
    """Scene, path, robot and seed, as far as the metadata hold them."""
    names = ("scene", "path", "robot", "seed", "session")
    parts = [f"{name} {metadata[name]}" for name in names if name in metadata]
    if "magnetometer" in metadata:
        parts.append(f"{metadata['magnetometer']} magnetometer")
        if "network" in metadata:
            parts[-1] += f" ({metadata['network']})"
    return ", ".join(parts)


def _driven(columns: Columns) -> str:
    """Length and extent of the drive, by the best position column."""
    for name in ("p_world_base", "mocap_p", "odom_p"):
        p = columns.get(name, np.array([]))
        p = p[np.isfinite(p).all(axis=1)] if p.ndim == 2 else np.empty((0, 3))
        if len(p):
            length = float(np.hypot(*np.diff(p[:, :2], axis=0).T).sum())
            (x0, y0), (x1, y1) = p[:, :2].min(axis=0), p[:, :2].max(axis=0)
            return f"{length:.4g} m in {rectangle(x0, x1, y0, y1)} ({name})"
    return ""


def swept(metadata: Mapping[str, Any]) -> str:
    """How much of the free floor a path sweeps that was planned for or scaled to a room."""
    share = metadata.get("path_swept")
    if not isinstance(share, float):
        return ""
    if "path_placing" not in metadata:
        return f"{share:.1%} of the floor that the robot can reach is within 0.25 m of the path"
    return (
        f"{1 - share:.0%} of the free floor is outside of the path, which was scaled to fit, or behind "
        'closed doors; path "coverage" drives all that can be reached'
    )


def _field_range(columns: Columns) -> str:
    """Range and mean of the reading, or of the best field column."""
    for name in ("b_measured_nt", "b_total_nt", "b_truth_nt", "b_map_nt"):
        values = columns.get(name, np.array([]))
        known = values[np.isfinite(values)]
        if len(known):
            lost = f", {len(values) - len(known):,} nan" if len(known) < len(values) else ""
            return f"{span(known.min(), known.max(), 'nT')}, mean {known.mean():,.0f} nT ({name}{lost})"
    return ""


def _flags(columns: Columns) -> str:
    """Flags that are set, with their number of rows."""
    raised = {
        n: int(v.sum()) for n, v in columns.items() if n.startswith("flag_") and v.dtype == bool and v.any()
    }
    return listed([f"{name} in {count:,} rows" for name, count in raised.items()], 80)
