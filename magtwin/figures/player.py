"""Player: what plays runs on a page: the lab in 3D, its map and charts, in one file that asks no host.

`player.js` draws it with WebGL 2 and SVG. It reads one block: a JSON head, then arrays of integers. A value
that the page shows is stored as an integer of its last digit, so that it equals that of the run.
"""

import base64
import gzip
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import colour_limits, heading_harmonics
from magtwin.figures.bodies import Array, Integers, bodies_of, integers
from magtwin.frames import yaw_from_quat
from magtwin.report.verdict import Z_90, Tally
from magtwin.run.compare import HEADINGS, POSITIONS
from magtwin.run.figures import prediction_nt
from magtwin.run.run import Run
from magtwin.run.thinning import rows_shown

MOST_ROWS = 8_000
"""Most readings of a page. Longer runs are cut into stretches: the page has the first reading of each and
that with the largest step."""

MOST_HARMONICS, ENOUGH_NT = 4, 5.0
"""Most harmonics of the heading by which the floor shows a map, and the RMS error that needs no more [nT]."""

MOST_NODES = 40_000
"""Most nodes of the floor."""

R_90 = math.sqrt(-2 * math.log(1 - 0.9))
"""Half an axis of the 90 % ellipse of a normal distribution in the plane, in standard deviations along it."""

CHARTS: tuple[dict[str, Any], ...] = (
    {"title": "Field", "unit": "µT", "scale": 0.01, "digits": 2, "lines": ("reading", "map")},
    {
        "title": "Robot's own field",
        "unit": "nT",
        "scale": 1,
        "digits": 0,
        "lines": ("own", "predicted by the network"),
    },
    {"title": "Error", "unit": "nT", "scale": 1, "digits": 0, "lines": ("error",), "band": "band"},
    {"title": "Position error", "unit": "m", "scale": 0.001, "digits": 3, "lines": ("off", "est_a")},
)
"""Charts by their columns. `scale` times an integer is in `unit`; `band` is half the width of a band at 0."""


@dataclass(frozen=True)
class Player:
    """What plays a run on a page."""

    block: str
    figures: Sequence[tuple[str, str]]
    """The run in at most six figures, each with its name."""

    alt: str
    still: bytes = b""
    """Picture (PNG) for where the lab cannot be drawn."""

    lab: bool = True
    """Whether there is a place to draw; else the page has charts alone."""

    plays: bool = True
    """Whether there is a run to play."""

    note: str = ""
    style = (Path(__file__).parent / "player.css").read_text(encoding="utf-8")
    script = (Path(__file__).parent / "player.js").read_text(encoding="utf-8")

    @property
    def script_hash(self) -> str:
        """Source of the script in the page's content security policy: no other script runs."""
        return "sha256-" + base64.b64encode(hashlib.sha256(self.script.encode()).digest()).decode()


def player_of(
    runs: Sequence[Run], field: AnomalyMap | None, stage: Path | None, *, still: bytes = b""
) -> Player:
    """What plays runs in their lab; the same for the same arguments, to the byte.

    Args:
        runs: One run; one for each robot of a scene that drove together; or none, to show the lab alone.
        field: The map, or None.
        stage: The scene, or None. A scene that cannot be shown is left out, and the page says why.
        still: Picture (PNG) for where the lab cannot be drawn.
    """
    arrays: dict[str, Array] = {}
    robots, notes, rows = [], list[str](), 0
    start_s = min((float(run["t"][0]) for run in runs), default=0.0)
    for k, run in enumerate(runs):
        shown = rows_shown(run, MOST_ROWS // len(runs))
        rows += len(shown)
        columns, names = columns_of(run, shown, start_s)
        arrays |= {f"{k}/{name}": values for name, values in columns.items()}
        charts = []
        for chart in CHARTS:
            lines = [{"name": names.get(n, n), "column": n} for n in chart["lines"] if n in columns]
            band = chart.get("band", "") * (chart.get("band") in columns)
            charts += [{**chart, "lines": lines, "band": band}] if lines else []
        robots.append({"name": str(run.metadata.get("robot", f"robot {k + 1}")), "charts": charts})
    every = sum(run.rows for run in runs)
    notes += [f"{rows:,} of {every:,} readings are shown."] if rows < every else []
    head: dict[str, Any] = {"robots": robots, "map": None, "bodies": []}
    if field is not None:
        head["map"], arrays["floor"], arrays["known"] = floor_of(field)
    if stage is not None:
        try:
            head["bodies"], left_out = bodies_of(arrays, stage, runs)
            notes += [f"{left_out:,} small shapes of the scene are left out."] if left_out else []
        except InputError as error:
            notes.insert(0, f"The scene is not shown: {error}.")
    place = "The lab" if head["bodies"] else "The floor"
    place += f" with {len(runs)} robots and their paths" * (len(runs) > 1)
    place += " with the robot and its path" * (len(runs) == 1)
    alt = f"{place} on the map of the field." if field else f"{place}."
    lab = bool(head["bodies"]) or field is not None or any(name.endswith("/x") for name in arrays)
    return Player(packed(head, arrays), figures_of(runs), alt, still, lab, bool(runs), " ".join(notes))


def figures_of(runs: Sequence[Run]) -> list[tuple[str, str]]:
    """Runs of robots that drove together in at most six figures, as text; none without a run."""
    if not runs:
        return []
    found = [{figure.name: figure.value for figure in run.report().figures} for run in runs]
    tally, driven = Tally(), sum(float(figures.get("distance driven", 0)) for figures in found)
    words = [("duration", f"{max(float(figures['duration']) for figures in found):,.1f} s")]
    words += [("driven", f"{driven:,.1f} m")] if driven else []
    off = [error for error in map(off_m, runs) if error is not None]
    rms = math.sqrt(np.nanmean(np.concatenate(off) ** 2)) if off else math.nan
    every = f"{sum(run.rows for run in runs):,}"
    words.append(("position error, RMS", f"{rms:.3f} m") if off else ("readings", every))
    for run in runs:
        run.add_to(tally)
    if tally.readings:
        error, naive = tally.error_nt / tally.readings, tally.naive_nt / tally.readings
        words += [("mean error", f"{error:,.0f} nT"), ("of map + mean", f"{naive:,.0f} nT")]
    if tally.with_sd:
        words.append(("in 90 % band", f"{100 * tally.within / tally.with_sd:.0f} %"))
    return words


def off_m(run: Run) -> Array | None:
    """Distance of the estimated from the best known position [m], shape (N,); None if one is unknown."""
    true = next((name for name in POSITIONS[:2] if name in run and np.isfinite(run[name]).any()), None)
    if true is None or "est_p_world_base" not in run:
        return None
    off = np.hypot(*(run["est_p_world_base"] - run[true])[:, :2].T)
    return off if np.isfinite(off).any() else None


def columns_of(run: Run, rows: Any, start_s: float) -> tuple[dict[str, Array], dict[str, str]]:
    """Columns of a page, and the names of those that are drawn.

    Times are in 10 ms from `start_s`, places in mm, headings in tenths of a degree, angles of wheels in
    10 mrad, fields in nT; the fields that are shown in uT with two digits are in 10 nT.
    """
    arrays: dict[str, Array] = {}

    def get(name: str) -> Array | None:
        return run[name][rows] if name in run and np.isfinite(run[name]).any() else None

    def add(name: str, values: Array | None, scale: float = 1.0) -> None:
        if values is not None and np.isfinite(values).any():
            arrays[name] = integers(values, scale)

    add("t", run["t"][rows] - start_s, 100)
    place = next((name for name in POSITIONS if get(name) is not None), "")
    p, q, wheels = get(place), get(HEADINGS.get(place, "")), get("wheel_angle")
    yaw = get("yaw") if q is None else yaw_from_quat(q)
    for k, axis in enumerate("xyz" if p is not None and np.nan_to_num(p[:, 2]).any() else "xy"):
        add(axis, None if p is None else p[:, k], 1000)
    if yaw is not None:
        good = np.isfinite(yaw)
        turned = np.full(len(yaw), np.nan)
        turned[good] = np.unwrap(yaw[good])
        add("yaw", np.degrees(turned), 10)
    for k, side in enumerate(("left", "right")):
        add(side, None if wheels is None else wheels[:, k], 100)
    add("lidar", None if "lidar_on" not in run else run["lidar_on"][rows].astype(float))
    field, truth, sd = get("b_map_nt"), get("b_truth_nt"), get("b_sd_nt")
    reading = get("b_measured_nt") if "b_measured_nt" in run else get("b_total_nt")
    judge, name = (truth, "exact") if truth is not None else (reading, "reading")
    names = {"own": f"{name} \u2212 map", "error": f"prediction \u2212 {name}", "off": "estimate \u2212 true"}
    names["off"] = names["off"] if place == POSITIONS[0] else "estimate \u2212 motion capture"
    names["est_a"] = "90 % ellipse"
    add("reading", reading, 0.1)
    add("map", field, 0.1)
    if field is not None and judge is not None and reading is not None:
        add("trail", reading - field)
        add("own", judge - field)
        predicted = prediction_nt(run)[rows] if "b_total_nt" in run else judge
        if np.any(np.nan_to_num(predicted - field)) and np.any(np.nan_to_num(predicted - judge)):
            add("predicted by the network", predicted - field)
            add("error", predicted - judge)
            add("band", None if sd is None else Z_90 * sd)
    estimate, off = get("est_p_world_base"), off_m(run)
    if estimate is not None and "est_covariance" in run:
        xx, xy, yy = run["est_covariance"][rows][:, [0, 1, 3]].T
        mean, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)  # half axes of the ellipse, and its direction
        add("est_x", estimate[:, 0], 1000)
        add("est_y", estimate[:, 1], 1000)
        add("est_a", R_90 * np.sqrt(mean + half), 1000)
        add("est_b", R_90 * np.sqrt(np.maximum(mean - half, 0)), 1000)
        add("est_turn", np.arctan2(2 * xy, xx - yy) / 2, 1000)
        add("off", None if off is None else off[rows], 1000)
    return arrays, names


def floor_of(field: AnomalyMap) -> tuple[dict[str, Any], Integers, Integers]:
    """A map as `heading_harmonics`, of a large one every second node or third, and so on.

    Returns:
        Its place, colours and the RMS error of the harmonics [nT]; the coefficients [nT], shape (K, Y, X);
        and whether each node is known, shape (Y, X).
    """
    every = math.ceil(math.sqrt(field.valid[0].size / MOST_NODES))
    parts, rms = heading_harmonics(field, MOST_HARMONICS, ENOUGH_NT)
    known = np.logical_and.reduce(np.asarray(field.valid), axis=0)
    low, high = colour_limits(np.where(known, field.values_nt, np.nan))
    known, parts = known[::every, ::every], parts[:, ::every, ::every]
    (x, y), (dx, dy) = field.origin_m, np.multiply(field.cell_m, every)
    place = {"x": float(x), "y": float(y), "nx": known.shape[1], "ny": known.shape[0]}
    size = {"dx": float(dx), "dy": float(dy), "waves": len(parts)}
    colours = {"low": round(low), "high": max(round(high), round(low) + 1), "rms": round(rms)}
    return place | size | colours, integers(parts, 1), np.asarray(known, np.int32)


def packed(head: Mapping[str, Any], arrays: Mapping[str, Array]) -> str:
    """A JSON head and arrays of integers as text: base64 of a gzip file.

    An array is stored as differences along its last axis, modulo 2^16 if its values fit and else 2^32: first
    the low bytes of all, then the next ones, which gzip packs best.
    """
    table, blocks, at = {}, [], 0
    for name, values in arrays.items():
        flat = values.reshape(-1, values.shape[-1]).astype(np.int64)
        least, most = int(flat.min(initial=0)), int(flat.max(initial=0))
        width = 2 if (least >= -(2**15) and most < 2**15) or (least >= 0 and most < 2**16) else 4
        steps = np.diff(flat, axis=1, prepend=0)
        blocks += [((steps >> (8 * k)) & 255).astype(np.uint8).tobytes() for k in range(width)]
        table[name] = {"shape": list(values.shape), "width": width, "signed": least < 0, "at": at}
        at += width * flat.size
    text = json.dumps({**head, "arrays": table}, separators=(",", ":"), ensure_ascii=False).encode()
    content = len(text).to_bytes(4, "little") + text + b"".join(blocks)
    return base64.b64encode(gzip.compress(content, 9, mtime=0)).decode("ascii")
