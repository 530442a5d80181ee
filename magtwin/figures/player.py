"""Player: what plays a run on a page: the lab in 3D, its map and charts, in one file that asks no host.

`player.js` draws it with WebGL 2 and SVG. It reads one block: a JSON head, then arrays of integers. A value
that the page shows is stored as an integer of its last digit, so that it equals that of the run.
"""

import base64
import gzip
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.statistics import colour_limits
from magtwin.figures.scenery import links_of, sides_of
from magtwin.frames import matrix_from_quat, yaw_from_quat
from magtwin.report.verdict import Z_90, Tally
from magtwin.run.compare import HEADINGS, POSITIONS
from magtwin.run.figures import prediction_nt
from magtwin.run.run import Run
from magtwin.usd.geometry import Shape, read_links, read_shapes, srgb_from_linear
from magtwin.usd.scene import open_scene

Array = NDArray[Any]
Integers = NDArray[np.int32]

MOST_ROWS = 8_000
"""Most readings of a page. A longer run is cut into stretches: the page has the first reading and that
with the largest step."""

MOST_TRIANGLES = 60_000
"""Most triangles of a page. Shapes of more than a tenth are simplified, and the smallest are left out."""

MOST_HARMONICS, ENOUGH_NT = 4, 5.0
"""Most harmonics of the heading by which the floor shows a map, and the RMS error that needs no more [nT]."""

MAP_PRIM = "/AnomalyMap"
"""Part of the paths of prims that the page draws itself, as its floor."""

CHARTS: tuple[dict[str, Any], ...] = (
    {"title": "Field", "unit": "µT", "scale": 0.01, "digits": 2, "lines": ("reading", "map")},
    {"title": "Robot's own field", "unit": "nT", "scale": 1, "digits": 0, "lines": ("own", "predicted")},
    {"title": "Error", "unit": "nT", "scale": 1, "digits": 0, "lines": ("error",), "band": "band"},
    {"title": "Position error", "unit": "m", "scale": 0.001, "digits": 3, "lines": ("off", "off_band")},
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

    scene: str = "lab"
    """"none" for charts alone."""

    note: str = ""
    style = (Path(__file__).parent / "player.css").read_text(encoding="utf-8")
    script = (Path(__file__).parent / "player.js").read_text(encoding="utf-8")

    @property
    def script_hash(self) -> str:
        """Source of the script in the page's content security policy: no other script runs."""
        return "sha256-" + base64.b64encode(hashlib.sha256(self.script.encode()).digest()).decode()


def player_of(run: Run, field: AnomalyMap | None, stage: Path | None, *, still: bytes = b"") -> Player:
    """What plays a run in its lab; the same for the same arguments, to the byte.

    Args:
        run: The run, with t.
        field: Its map, or None.
        stage: Its scene, or None: the map alone is shown.
        still: Picture (PNG) for where the lab cannot be drawn.
    """
    rows = rows_shown(run)
    arrays, names = columns_of(run, rows)
    charts = []
    for chart in CHARTS:
        lines = [{"name": names.get(line, line), "column": line} for line in chart["lines"] if line in arrays]
        if lines:
            charts.append(
                {**chart, "lines": lines, "band": chart.get("band", "") * (chart.get("band") in arrays)}
            )
    head: dict[str, Any] = {"charts": charts, "map": None, "scene": None}
    notes = [f"{len(rows):,} of {run.rows:,} readings are shown."] if len(rows) < run.rows else []
    if field is not None:
        head["map"], arrays["floor"], arrays["known"] = floor_of(field)
    if stage is not None:
        head["scene"], left_out = scene_of(arrays, stage, run)
        notes += [f"{left_out:,} small shapes of the scene are left out."] if left_out else []
    place = "The lab with the robot and the driven path" if stage else "The driven path"
    alt = f"{place} on the map of the field." if field else f"{place}."
    shown = "lab" if "x" in arrays else "none"
    return Player(packed(head, arrays), figures_of(run), alt, still, shown, " ".join(notes))


def figures_of(run: Run) -> list[tuple[str, str]]:
    """A run in six figures, as text."""
    found = {figure.name: figure.value for figure in run.report().figures}
    words = [("duration", f"{found['duration']:,.1f} s"), ("readings", f"{run.rows:,}")]
    if "distance driven" in found:
        words.insert(1, ("driven", f"{found['distance driven']:,.1f} m"))
    tally = Tally()
    run.add_to(tally)
    if tally.readings:
        error, naive = tally.error_nt / tally.readings, tally.naive_nt / tally.readings
        words += [("mean error", f"{error:,.0f} nT"), ("of map + mean", f"{naive:,.0f} nT")]
    if tally.with_sd:
        words.append(("in 90 % band", f"{100 * tally.within / tally.with_sd:.0f} %"))
    return words


def rows_shown(run: Run) -> NDArray[np.intp]:
    """Rows that a page has: all, or of each stretch the first and that with the largest step."""
    if run.rows <= MOST_ROWS:
        return np.arange(run.rows)
    name = next((name for name in ("b_measured_nt", "b_total_nt", "t") if name in run), "t")
    step = np.abs(np.convolve(np.nan_to_num(run[name]), [-0.5, 1, -0.5], "same"))
    edges = np.linspace(0, run.rows, MOST_ROWS // 2 + 1).astype(int)
    worst = [a + int(np.argmax(step[a:b])) for a, b in pairwise(edges)]
    return np.unique([*edges[:-1], *worst, run.rows - 1])


def columns_of(run: Run, rows: Any) -> tuple[dict[str, Array], dict[str, str]]:
    """Columns of a page, and the names of those that are drawn.

    Times are in 10 ms, places in mm, headings in tenths of a degree, angles of wheels in 10 mrad, fields in
    nT; the fields that are shown in uT with two digits are in 10 nT. The least integer is an unknown value.
    """
    arrays: dict[str, Array] = {}

    def get(name: str) -> Array | None:
        return run[name][rows] if name in run and np.isfinite(run[name]).any() else None

    def add(name: str, values: Array | None, scale: float = 1.0) -> None:
        if values is not None and np.isfinite(values).any():
            arrays[name] = integers(values, scale)

    add("t", run["t"][rows] - run["t"][0], 100)
    place = next((name for name in POSITIONS if get(name) is not None), "")
    p, q, wheels, estimate = (
        get(place),
        get(HEADINGS.get(place, "")),
        get("wheel_angle"),
        get("est_p_world_base"),
    )
    yaw = get("yaw") if q is None else yaw_from_quat(q)
    if p is not None:
        add("x", p[:, 0], 1000)
        add("y", p[:, 1], 1000)
    if yaw is not None:
        good = np.isfinite(yaw)
        turned = np.full(len(yaw), np.nan)
        turned[good] = np.unwrap(yaw[good])
        add("yaw", np.degrees(turned), 10)
    if wheels is not None:
        add("left", wheels[:, 0], 100)
        add("right", wheels[:, 1], 100)
    add("lidar", None if "lidar_on" not in run else run["lidar_on"][rows].astype(float))
    field, truth, sd = get("b_map_nt"), get("b_truth_nt"), get("b_sd_nt")
    reading = get("b_measured_nt") if "b_measured_nt" in run else get("b_total_nt")
    judge, name = (truth, "exact") if truth is not None else (reading, "reading")
    names = {"own": f"{name} \u2212 map", "error": f"prediction \u2212 {name}", "off": "estimate \u2212 true"}
    names["off_band"] = "90 % by the filter"
    add("reading", reading, 0.1)
    add("map", field, 0.1)
    if field is not None and judge is not None and reading is not None:
        add("trail", reading - field)
        add("own", judge - field)
        predicted = prediction_nt(run)[rows] if "b_total_nt" in run else judge
        if np.any(np.nan_to_num(predicted - field)) and np.any(np.nan_to_num(predicted - judge)):
            add("predicted", predicted - field)
            add("error", predicted - judge)
            add("band", None if sd is None else Z_90 * sd)
    if estimate is not None:
        xx, xy, yy = run["est_covariance"][rows][:, [0, 1, 3]].T
        mean, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)  # half axes of the ellipse, and its direction
        add("est_x", estimate[:, 0], 1000)
        add("est_y", estimate[:, 1], 1000)
        add("est_a", np.sqrt(mean + half), 1000)
        add("est_b", np.sqrt(np.maximum(mean - half, 0)), 1000)
        add("est_turn", np.arctan2(2 * xy, xx - yy) / 2, 1000)
        if place == "p_world_base" and p is not None:
            add("off", np.hypot(*(estimate - p)[:, :2].T), 1000)
            add("off_band", Z_90 * np.sqrt(xx + yy), 1000)
    return arrays, names


def integers(values: ArrayLike, scale: float) -> Integers:
    """Values times a scale, rounded; the least integer where they are not finite."""
    values = np.asarray(values, float) * scale
    good = np.isfinite(values)
    return np.where(good, np.round(np.where(good, values, 0)), np.iinfo(np.int32).min).astype(np.int32)


def floor_of(field: AnomalyMap) -> tuple[dict[str, Any], Integers, Integers]:
    """A map as harmonics of the heading, B = c0 + sum_k ck cos(k h) + sk sin(k h).

    Returns:
        Its place, colours and the RMS error of the harmonics [nT]; the coefficients [nT], shape (K, Y, X);
        and whether each node is known, shape (Y, X).
    """
    known, turns = field.valid.all(axis=0), field.headings_rad
    values = np.where(known, field.values_nt, 0)
    for order in range(MOST_HARMONICS + 1):
        waves = [f(k * turns) for k in range(order + 1) for f in ((np.cos, np.sin) if k else (np.cos,))]
        basis = np.stack(waves, axis=1)
        parts = np.tensordot(np.linalg.pinv(basis), values, 1)
        rms = (
            float(np.sqrt(np.mean((np.tensordot(basis, parts, 1) - values)[:, known] ** 2)))
            if known.any()
            else 0.0
        )
        if rms < ENOUGH_NT or 2 * order + 1 >= len(turns):
            break
    low, high = colour_limits(np.where(known, field.values_nt, np.nan))
    place = {
        "x": float(field.origin_m[0]),
        "y": float(field.origin_m[1]),
        "nx": known.shape[1],
        "ny": known.shape[0],
    }
    size = {"dx": float(field.cell_m[0]), "dy": float(field.cell_m[1]), "waves": len(parts)}
    colours = {"low": round(low), "high": max(round(high), round(low) + 1), "rms": round(rms)}
    return place | size | colours, integers(parts, 1), np.asarray(known, np.int32)


def scene_of(arrays: dict[str, Array], stage: Path, run: Run) -> tuple[dict[str, Any], int]:
    """The bodies of a scene: what stands still, the robot, and each of its wheels.

    Adds the points of each body to `arrays`, in 1/65535 of its box, its faces and colours.

    Returns:
        The bodies with boxes, poses and axes; and the number of shapes that are left out.
    """
    opened = open_scene(stage, check_network=False, lab=str(run.metadata.get("lab", "")))
    links = read_links(opened.stage)
    moving = links_of(links, [placed.robot.name for placed in opened.scene.robots], run)
    sides = sides_of(opened.scene, run)
    bodies: dict[str, list[Any]] = {}
    about: dict[str, dict[str, Any]] = {"lab": {"moves": False}, "robot": {"moves": True}}
    shapes = [s for s in read_shapes(opened.stage) if MAP_PRIM not in s.prim and len(s.faces)]
    room, left_out = MOST_TRIANGLES, 0
    for shape in sorted(shapes, key=lambda shape: -float(np.ptp(shape.vertices, axis=0).max())):
        points, faces = simplified(shape.vertices.astype(float), shape.faces, MOST_TRIANGLES // 10)
        room -= len(faces)
        if room < 0:
            left_out += 1
            continue
        link, name = links.get(shape.link), "lab"
        if link is not None and shape.link not in moving:
            points = points @ np.asarray(matrix_from_quat(link.q_world_link_xyzw)).T + link.p_world_link
        elif link is not None and link.joint in sides and link.rolling_axis is not None:
            name, side = shape.link, ("left", "right")[sides[link.joint]]
            pose = {"p": link.p_base_link, "q": link.q_base_link_xyzw, "axis": link.rolling_axis}
            about[name] = {"moves": True, "side": side, **pose}
        elif link is not None:
            name = "robot"
            points = points @ np.asarray(matrix_from_quat(link.q_base_link_xyzw)).T + link.p_base_link
        bodies.setdefault(name, []).append((shape, points, faces))
    made = [{"name": name, **about[name], **pack_body(arrays, name, parts)} for name, parts in bodies.items()]
    return {"bodies": made}, left_out


def pack_body(
    arrays: dict[str, Array], name: str, parts: Sequence[tuple[Shape, Array, Array]]
) -> dict[str, Any]:
    """Add points, faces and colours of a body to `arrays`; returns its box."""
    points = np.concatenate([points for _, points, _ in parts])
    low, size = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-6)
    first = np.cumsum([0, *(len(points) for _, points, _ in parts)])
    colours = [(*srgb_from_linear(shape.colour[:3]), shape.colour[3]) for shape, _, _ in parts]
    arrays[f"{name}.points"] = integers(((points - low) / size).T, 65535)
    arrays[f"{name}.faces"] = np.concatenate(
        [f + at for (_, _, f), at in zip(parts, first, strict=False)]
    ).ravel()
    arrays[f"{name}.colours"] = integers(np.ravel(colours), 255)
    arrays[f"{name}.ends"] = np.cumsum([len(faces) for _, _, faces in parts])
    return {"low": low.round(6).tolist(), "size": size.round(6).tolist()}


def simplified(points: Array, faces: Array, most: int) -> tuple[Array, Array]:
    """A mesh of at most `most` triangles: its vertices are joined in cells that double until it is."""
    cell, kept, first = float(np.ptp(points, axis=0).max()) / 256, faces, np.arange(len(points))
    while len(kept) > most:
        _, first, joined = np.unique(np.round(points / cell), axis=0, return_index=True, return_inverse=True)
        kept = joined.reshape(-1)[faces]
        kept = kept[(kept != np.roll(kept, 1, axis=1)).all(axis=1)]
        cell *= 2
    return points[first], kept


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
