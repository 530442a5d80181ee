"""Plot: a run, a map or a scene as a matplotlib figure, for `magtwin.plot` and the methods `plot`."""

import math
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from magtwin.errors import InputError, MismatchWarning
from magtwin.field.maps.map import AnomalyMap
from magtwin.figures.canvas import label, legend_above, new_figure, plain_text, render
from magtwin.figures.maps import FloorPlan, draw_map, draw_mean
from magtwin.figures.runs import draw_run
from magtwin.figures.style import BOUND, INK, styled
from magtwin.run.run import Run
from magtwin.spec.scene import Scene
from magtwin.twin import Twin, open_twin, scene_of
from magtwin.twin.opening import open_unwritten
from magtwin.twin.twin import Place, recent, scene_in

LEVEL_NT = 20.0
"""A map that varies less is drawn as a bare floor [nT]."""

MOST_LABELS = 40
"""Pieces of furniture that are labelled with their names."""


def plot(
    what: Run | AnomalyMap | Twin | Place,
    *,
    anomaly_map: AnomalyMap | None = None,
    scene: Twin | Place | None = None,
    quantity: str = "overview",
    headings: Sequence[float] | None = None,
) -> Figure:
    """Draw a run, a map or a scene.

    A run: the path over map, walls and furniture, coloured by the reading less the map, and against time what
    the map lacks, the error of the prediction, the field, speed and battery, of those columns that it has. A
    map: filled contours of its mean, heading effect, standard deviation and gradient. A scene: the room from
    above with its robots, over the mean of its map.

    Args:
        what: A `Run`, an `AnomalyMap`, a twin, or a scene as for `open_twin`.
        anomaly_map: For a run: the map to draw below the path, as the mean over its headings. Default: that
            of the scene.
        scene: For a run: its scene. Default: what `simulate` drove in this process, else that of its
            metadata, if it is there and has not changed; otherwise the floor is bare.
        quantity: For a map: "overview", "field", "gradient", "variance", "mask" or "headings"; see
            `magtwin.figures.maps.draw_map`.
        headings: For a map: headings to show [rad]. None shows the map's own, or about four of more than
            eight.

    Returns:
        A matplotlib figure without pyplot state. A notebook shows it; `savefig` writes it.

    Raises:
        InputError: `what` is none of these, or has nothing that can be drawn.
    """
    if isinstance(what, Run):
        twin = _scene_of(what) if scene is None else _opened(scene)
        plan = None if twin is None else FloorPlan.of(twin.scene, twin.obstacles)
        under = twin.field if anomaly_map is None and twin is not None else anomaly_map
        figure = draw_run(what, under, plan=plan)
    elif isinstance(what, AnomalyMap):
        figure = draw_map(what, what=quantity, headings=headings)
    else:
        figure = draw_scene(_opened(what))
    plain_text(figure)
    figure._repr_png_ = partial(render, figure, ".png")  # type: ignore[attr-defined]  # notebooks call this
    return figure


@styled
def draw_scene(twin: Twin) -> Figure:
    """Draw the room of a twin from above: its map, walls, doors, furniture and robots."""
    scene, plan = twin.scene, FloorPlan.of(twin.scene, twin.obstacles)
    x0, x1, y0, y1 = scene.lab.extent_m
    tall = min(max((y1 - y0) / (x1 - x0), 0.3), 1.5)
    figure = new_figure(8.0, 6.6 * tall + 1.6)
    ax = figure.subplots()
    known = twin.field.values_nt[twin.field.valid]
    level = known.size == 0 or np.ptp(known) < LEVEL_NT
    if level:  # its noise would fill the scale
        ax.set(xlim=(x0 - 0.2, x1 + 0.2), ylim=(y0 - 0.2, y1 + 0.2))
        plan = replace(plan, floor=None)
    else:
        draw_mean(ax, twin.field)
    ax.set_aspect("equal")
    plan.draw(ax)
    for piece in scene.furniture[:MOST_LABELS]:
        box = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.7}
        middle: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8, "zorder": 6}
        ax.text(*piece.p_world[:2], piece.name, bbox=box, **middle)
    for source in scene.sources[:MOST_LABELS]:
        ax.plot(*source.p_world[:2], marker="x", ms=6, mec=BOUND, ls="", zorder=5)
    for placed in scene.robots:
        x, y, yaw = placed.start
        radius = placed.robot.footprint_radius_m
        nose = [x, x + radius * math.cos(yaw)], [y, y + radius * math.sin(yaw)]
        turn = [k * math.tau / 60 for k in range(61)]
        ring = [x + radius * math.cos(a) for a in turn], [y + radius * math.sin(a) for a in turn]
        ax.fill(*ring, fc="white", ec=INK, lw=1.2, zorder=6)
        ax.plot(*nose, color=INK, lw=1.6, zorder=7)
        below: dict[str, Any] = {"textcoords": "offset points", "ha": "center", "va": "top", "zorder": 7}
        ax.annotate(placed.robot.name, (x, y - radius), (0, -4), fontsize=8, **below)
    same = f"; the map is {known.mean():,.0f} nT everywhere" if level and known.size else ""
    label(ax, "x [m]", "y [m]", title=f"{scene.name}, from above{same}")
    if handles := plan.keys():
        ax.set_title(ax.get_title(loc="left"), pad=22)
        legend_above(ax, 3, handles=[*handles.values()], labels=[*handles])
    return figure


def _opened(scene: Twin | Place) -> Twin:
    """The twin of what is to be drawn, whatever its map."""
    if isinstance(scene, Twin):
        return scene
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MismatchWarning)
        scene = scene_in(scene, "what must be a Run, an AnomalyMap,")
        if isinstance(scene, Scene):
            return open_unwritten(scene, {}, network="none")
        return open_twin(scene, network="none")


def _scene_of(run: Run) -> Twin | None:
    """The twin of a run's scene if it is there, and is as it was."""
    if (driven := recent(run.metadata.get("scene_sha256"))) is not None:
        return driven
    if "scene_file" not in run.metadata:
        return None
    with suppress(InputError):
        twin = _opened(scene_of(run))
        if twin.metadata.get("scene_sha256") == run.metadata.get("scene_sha256"):
            return twin
    return None
