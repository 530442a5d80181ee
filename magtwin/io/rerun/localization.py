"""Localization: an estimated pose beside the true one in a Rerun recording."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.outputs import output
from magtwin.frames import wrap_angle
from magtwin.io.rerun.layout import UP_TO_NOW, bare, plot_view, time_axis
from magtwin.io.rerun.recording import ROOM, content_id, send_whole, size_of, stream, title_of
from magtwin.io.rerun.series import Array, send, send_clouds
from magtwin.io.rerun.world import UPWARDS, Scale, heading_of, send_map
from magtwin.run.arrow import without_pandas
from magtwin.run.run import Run

FLOOR, PATHS = "floor", "floor/paths"

MOST_PARTICLES = 300  # Particles drawn at a time, each of the same weight
ARROW_M = 0.25  # Length of the arrows that show the headings [m]

TRUTH, ESTIMATE, DEAD = (235, 235, 235), (255, 130, 50), (86, 156, 255)
BOUND, BAND, PARTICLES = (92, 200, 120), (255, 205, 150), (230, 60, 110)


@without_pandas()
def write_localization(
    run: Run,
    path: str | os.PathLike[str],
    *,
    anomaly_map: AnomalyMap | None = None,
    truth: Array | None = None,
    dead_reckoning: Array | None = None,
    bound_m: Array | None = None,
    particles: Sequence[Array] = (),
    force: bool = False,
) -> None:
    """Write a localized run as a recording: the map from above with the poses, and errors against time.

    The columns of the run, which has those of `magtwin.localization.track.EST_COLUMNS`, are stored as by
    `magtwin.io.rerun.file.write_rrd`, and can be read back. `truth` and `dead_reckoning` are x, y [m] and yaw
    [rad], shape (N, 3); `bound_m` is the least standard deviation of the position [m], shape (N,);
    `particles` are samples at each reading, shapes (P, 4): x, y, yaw, weight, or () to draw ellipses.
    """
    if not run.rows or "est_p_world_base" not in run:
        raise InputError(f"{path}: the run has no estimates to record; run `magtwin localize` on it first")
    series = _series(run, truth, dead_reckoning, bound_m)
    views = _layout(run, series, anomaly_map, truth)
    name = ", ".join([*([title] if (title := title_of(run)) else []), str(run.metadata.get("localizer", ""))])
    name = name or Path(path).stem
    room = 2 * ROOM + 2 * size_of(run) + run.rows * (2400 + 16 * MOST_PARTICLES)
    room += 0 if anomaly_map is None else 8 * 1024**2
    with (
        output(path, force=force) as aside,
        stream(content_id(run), name, views, file=aside, final=Path(path), room=room) as rec,
    ):
        send_whole(rec, run)
        if anomaly_map is None:
            rec.log(PATHS, rr.Transform3D(mat3x3=UPWARDS), static=True)
        else:
            scale = Scale.over(anomaly_map, np.empty(0))
            send_map(rec, anomaly_map, scale, heading_of(anomaly_map, run))
        _send_path(rec, run, truth, dead_reckoning)
        _send_spread(rec, run, particles)
        for lines in series.values():
            for entity, (label, colour, width, values) in lines.items():
                style = rr.SeriesLines(names=[label], colors=[colour], widths=[width])
                rec.log(entity, style, static=True)
                send(rec, entity, run["t"], rr.Scalars, scalars=values)


Line = tuple[str, tuple[int, int, int], float, Array]


def _series(
    run: Run, truth: Array | None, dead_reckoning: Array | None, bound_m: Array | None
) -> dict[str, dict[str, Line]]:
    """The lines of each plot by entity: name, colour, width and values; plots without a line are left out."""
    p, yaw, covariance = run["est_p_world_base"][:, :2], run["est_yaw"], run["est_covariance"]
    sd, yaw_sd = np.sqrt(covariance[:, 0] + covariance[:, 3]), np.degrees(np.sqrt(covariance[:, 5]))
    position: dict[str, Line] = {"position/two_sigma": ("2 sigma", BAND, 1.5, 2 * sd)}
    heading: dict[str, Line] = {
        "heading/upper": ("2 sigma", BAND, 1.5, 2 * yaw_sd),
        "heading/lower": ("2 sigma", BAND, 1.5, -2 * yaw_sd),
    }
    if truth is not None:
        error = np.hypot(*(p - truth[:, :2]).T)
        position["position/error"] = ("estimate", ESTIMATE, 2.0, error)
        heading["heading/error"] = ("estimate", ESTIMATE, 2.0, np.degrees(wrap_angle(yaw - truth[:, 2])))
        if dead_reckoning is not None:
            away = np.hypot(*(dead_reckoning - truth)[:, :2].T)
            position["position/dead_reckoning"] = ("dead reckoning", DEAD, 1.5, away)
    if bound_m is not None:
        position["position/bound"] = ("bound, 1 sigma", BOUND, 2.0, bound_m)
    offset = ("offset of the magnetometer", ESTIMATE, 2.0, run["est_bias_nt"])
    plots = {"Position error [m]": position, "Heading error [deg]": heading}
    plots["Offset [nT]"] = {"offset/estimate": offset}
    if run["est_lost"].any():
        lost = ("flagged lost", DEAD, 2.0, run["est_lost"].astype(float))
        plots["Flagged lost [0, 1]"] = {"lost/flag": lost}
    for title, lines in plots.items():
        plots[title] = {entity: line for entity, line in lines.items() if np.isfinite(line[3]).any()}
    return {title: lines for title, lines in plots.items() if lines}


def _layout(
    run: Run, series: dict[str, dict[str, Line]], field: AnomalyMap | None, truth: Array | None
) -> rrb.Blueprint:
    axis = time_axis([run])
    views = []
    for title, lines in series.items():
        values, shown = np.concatenate([line[3] for line in lines.values()]), [f"/{e}" for e in lines]
        views.append(plot_view(title, shown, values, axis, legend=len(lines) > 1))
    if field is not None:
        x0, x1, y0, y1 = field.extent
    else:
        p = np.concatenate([run["est_p_world_base"][:, :2], *([] if truth is None else [truth[:, :2]])])
        (x0, y0), (x1, y1) = np.nanmin(p, axis=0), np.nanmax(p, axis=0)
    room = 0.06 * max(x1 - x0, y1 - y0)
    floor = rrb.Spatial2DView(
        origin=FLOOR,
        name="Map, true pose (white), estimate (orange), dead reckoning (blue)",
        background=(24, 26, 31),
        visual_bounds=rrb.VisualBounds2D(x_range=(x0 - room, x1 + room), y_range=(-y1 - room, -y0 + room)),
        overrides={f"{PATHS}/estimate": UP_TO_NOW},
    )
    page = rrb.TextDocumentView(origin="metadata", name="Run")
    left = rrb.Vertical(floor, page, row_shares=[4.0, 1.0])
    shares = [2.0, *[1.0] * (len(views) - 1)]
    return bare(rrb.Horizontal(left, rrb.Vertical(*views, row_shares=shares), column_shares=[3.0, 2.0]))


def _send_path(rec: rr.RecordingStream, run: Run, truth: Array | None, dead_reckoning: Array | None) -> None:
    """The paths, and an arrow at the estimated and at the true pose."""
    t = run["t"]
    for name, pose, colour in (("dead_reckoning", dead_reckoning, DEAD), ("truth", truth, TRUTH)):
        if pose is not None:
            known = pose[np.isfinite(pose).all(axis=1), :2]
            line = rr.LineStrips2D([known], radii=0.008, colors=colour, draw_order=1.0)
            rec.log(f"{PATHS}/{name}", line, static=True)
    p = run["est_p_world_base"][:, :2].astype(np.float32)
    line = rr.LineStrips2D.from_fields(radii=[0.012], draw_order=2.0, colors=[ESTIMATE])
    rec.log(f"{PATHS}/estimate", line, static=True)
    strips = np.stack([p[np.maximum(np.arange(len(p)) - 1, 0)], p], axis=1)
    send(rec, f"{PATHS}/estimate", t, rr.LineStrips2D, strips=strips)
    estimated = np.column_stack([p, run["est_yaw"]])
    for name, pose, colour, order in (("estimated", estimated, ESTIMATE, 5.0), ("true", truth, TRUTH, 4.0)):
        if pose is None:
            continue
        look = rr.Arrows2D.from_fields(radii=[0.03], colors=[colour], draw_order=order)
        rec.log(f"{PATHS}/robot/{name}", look, static=True)
        ahead = ARROW_M * np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
        arrow = {"origins": pose[:, :2].astype(np.float32), "vectors": ahead.astype(np.float32)}
        send(rec, f"{PATHS}/robot/{name}", t, rr.Arrows2D, **arrow)


def _send_spread(rec: rr.RecordingStream, run: Run, particles: Sequence[Array]) -> None:
    """The particles at each reading, at most `MOST_PARTICLES`, and the 2-sigma ellipse."""
    t, covariance = run["t"], run["est_covariance"]
    if len(particles) == run.rows:
        entity = f"{PATHS}/particles"
        look = rr.Points2D.from_fields(radii=[0.009], colors=[PARTICLES], draw_order=1.5)
        rec.log(entity, look, static=True)
        send_clouds(rec, entity, t, [_decimated(cloud) for cloud in particles], rr.Points2D)
    known = np.isfinite(covariance).all(axis=1)
    if known.any():
        line = rr.LineStrips2D.from_fields(radii=[0.008], colors=[BAND], draw_order=3.0)
        rec.log(f"{PATHS}/ellipse", line, static=True)
        p = run["est_p_world_base"][known, :2]
        strips = _ellipses(p, covariance[known][:, [0, 1, 3]]).astype(np.float32)
        send(rec, f"{PATHS}/ellipse", t[known], rr.LineStrips2D, strips=strips)


def _decimated(cloud: Array) -> Array:
    """Positions of at most `MOST_PARTICLES` particles, drawn evenly by their weight, shape (M, 2)."""
    total = np.cumsum(cloud[:, 3])
    count = min(MOST_PARTICLES, len(cloud))
    if not (len(cloud) and np.isfinite(total[-1]) and total[-1] > 0):
        return cloud[:count, :2]
    rows = np.searchsorted(total, (np.arange(count) + 0.5) / count * total[-1])
    return np.asarray(cloud[np.minimum(rows, len(cloud) - 1), :2])


def _ellipses(p: Array, covariance: Array) -> Array:
    """2-sigma ellipses of covariances xx, xy, yy [m^2], shape (N, 3), about p (N, 2); shape (N, 33, 2)."""
    values, axes = np.linalg.eigh(covariance[:, [[0, 1], [1, 2]]])
    angle = np.linspace(0, 2 * np.pi, 33)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    scaled = 2 * circle[None] * np.sqrt(np.maximum(values, 0.0))[:, None]
    return np.asarray(p[:, None] + np.einsum("nki,nji->nkj", scaled, axes))
