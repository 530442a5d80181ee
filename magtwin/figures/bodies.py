"""Bodies: a scene packed for a page: what stands still, each robot, and each of its wheels."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.figures.scenery import links_of, placed, sides_of
from magtwin.run.run import Run
from magtwin.usd.geometry import Link, Shape, read_links, read_shapes, srgb_from_linear
from magtwin.usd.layers import open_stage
from magtwin.usd.scene import open_scene

Array = NDArray[Any]
Integers = NDArray[np.int32]

UNKNOWN = np.iinfo(np.int32).min
"""Integer of a value that is not known."""

MOST_TRIANGLES = 60_000
"""Most triangles of a page; of its robots half as many, and of another shape a tenth. A scene with more is
simplified; then the smallest shapes are left out."""

MIN_TRIANGLES = 12
"""Triangles below which no shape is simplified."""

MAP_PRIM = "/AnomalyMap"
"""Part of the paths of prims that the page draws itself, as its floor."""


def bodies_of(arrays: dict[str, Array], stage: Path, runs: Sequence[Run]) -> tuple[list[dict[str, Any]], int]:
    """The bodies of a scene, and the number of shapes that are left out.

    Adds the points of each body to `arrays`, in 1/65535 of its box, its faces and colours. The robots of the
    runs move, in the order of the page.

    Returns:
        Boxes of the bodies; whether it is part of a robot, `solid`; the number of its robot if a body moves;
        and side, pose and axis of a wheel.
    """
    try:
        lab = str(runs[0].metadata.get("lab", "")) if runs else ""
        opened = open_scene(stage, check_network=False, lab=lab)
        shown, scene = opened.stage, opened.scene
    except InputError:
        if runs:
            raise
        shown, scene = open_stage(stage), None
    links, names = read_links(shown), [placed.robot.name for placed in scene.robots] if scene else []
    robots = {link: k for k, run in enumerate(runs) for link in links_of(links, names, run)}
    sides = [sides_of(scene, run) for run in runs if scene is not None]
    bodies: dict[str, list[tuple[Shape, Array, Array]]] = {}
    about: dict[str, dict[str, Any]] = {}
    shapes = [s for s in read_shapes(shown) if MAP_PRIM not in s.prim and len(s.faces)]
    shapes.sort(key=lambda s: (s.link not in robots, -float(np.ptp(s.vertices, axis=0).max())))
    carried = sum(len(s.faces) for s in shapes if s.link in robots)
    others = sum(len(s.faces) for s in shapes) - carried
    share = min(1.0, MOST_TRIANGLES / 2 / max(carried, 1))  # of its triangles that a shape of a robot keeps
    share_of_others = min(1.0, (MOST_TRIANGLES - share * carried) / max(others, 1))
    room, left_out = MOST_TRIANGLES, 0
    for shape in shapes:
        robot = shape.link in robots
        most = max(MIN_TRIANGLES, int((share if robot else share_of_others) * len(shape.faces)))
        most = most if robot else min(most, MOST_TRIANGLES // 10)
        points, faces = shape.vertices.astype(float), shape.faces
        if room >= MIN_TRIANGLES:
            points, faces = simplified(points, faces, most)
        if len(faces) > room:
            left_out += 1
            continue
        room -= len(faces)
        name, of_body = _body_of(shape, links, robots, sides)
        about[name] = of_body
        if "axis" not in of_body and shape.link:
            points = placed(points, links[shape.link], in_base="robot" in of_body)
        bodies.setdefault(name, []).append((shape, points, faces))
    return [{**about[name], **_pack(arrays, name, parts)} for name, parts in bodies.items()], left_out


def _body_of(
    shape: Shape, links: dict[str, Link], robots: dict[str, int], sides: Sequence[Any]
) -> tuple[str, dict[str, Any]]:
    """Name of the body that a shape is a part of, and what is known of the body."""
    if shape.link not in robots:
        bases = {link.base for link in links.values() if link.joint}
        robot = shape.link and links[shape.link].base in bases
        return ("standing", {"name": "standing", "solid": 1}) if robot else ("lab", {"name": "lab"})
    link, k = links[shape.link], robots[shape.link]
    if link.joint in sides[k] and link.rolling_axis is not None:
        side = ("left", "right")[sides[k][link.joint]]
        pose = {"p": link.p_base_link, "q": link.q_base_link_xyzw, "axis": link.rolling_axis}
        return shape.link, {"name": shape.link, "robot": k, "solid": 1, "side": side, **pose}
    return f"{k}/", {"name": f"{k}/", "robot": k, "solid": 1}


def _pack(arrays: dict[str, Array], name: str, parts: Sequence[tuple[Shape, Array, Array]]) -> dict[str, Any]:
    """Add points, faces and colours of a body to `arrays`; returns its box."""
    points = np.concatenate([points for _, points, _ in parts])
    low, size = points.min(axis=0), np.maximum(np.ptp(points, axis=0), 1e-6)
    first = np.cumsum([0, *(len(points) for _, points, _ in parts)])
    faces = [faces + at for (_, _, faces), at in zip(parts, first, strict=False)]
    colours = [(*srgb_from_linear(shape.colour[:3]), shape.colour[3]) for shape, _, _ in parts]
    arrays[f"{name}.points"] = integers(((points - low) / size).T, 65535)
    arrays[f"{name}.faces"] = np.concatenate(faces).ravel()
    arrays[f"{name}.colours"] = integers(np.ravel(colours), 255)
    arrays[f"{name}.ends"] = np.cumsum([len(faces) for _, _, faces in parts])
    return {"low": low.round(6).tolist(), "size": size.round(6).tolist()}


def integers(values: ArrayLike, scale: float) -> Integers:
    """Values times a scale, rounded; `UNKNOWN` where they are not finite."""
    values = np.asarray(values, float) * scale
    good = np.isfinite(values)
    return np.where(good, np.round(np.where(good, values, 0)), UNKNOWN).astype(np.int32)


def simplified(points: Array, faces: Array, most: int) -> tuple[Array, Array]:
    """A mesh of at most `most` triangles: its vertices are joined in cells that double until it is."""
    cell, kept, first = float(np.ptp(points, axis=0).max()) / 256, faces, np.arange(len(points))
    while len(kept) > most:
        _, first, joined = np.unique(np.round(points / cell), axis=0, return_index=True, return_inverse=True)
        kept = joined.reshape(-1)[faces]
        kept = kept[(kept != np.roll(kept, 1, axis=1)).all(axis=1)]
        cell *= 2
    return points[first], kept
