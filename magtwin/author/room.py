"""The room of a scene's TOML: its floor, its obstacles, free places for robots, and names."""

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd

from magtwin.author.furniture import LARGEST_M
from magtwin.errors import InputError
from magtwin.files.file import shipped
from magtwin.files.settings import refused_at
from magtwin.spec.furniture import FurnitureSpec
from magtwin.spec.lab import LabSpec, on_polygon
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import PlacedRobot
from magtwin.usd.lab.furniture import FURNITURE, define_furniture
from magtwin.usd.lab.obstacles import read_obstacles
from magtwin.usd.lab.room import define_lab
from magtwin.usd.maps.layer import load_map


def obstacles_in(lab: LabSpec, furniture: Sequence[FurnitureSpec]) -> Obstacles:
    """Obstacles of a room that is not authored yet."""
    stage = Usd.Stage.CreateInMemory()
    define_lab(stage, lab)
    if furniture:
        define_furniture(stage, tuple(furniture))
    return read_obstacles(stage)


def check_start(placed: PlacedRobot, lab: LabSpec, obstacles: Obstacles) -> None:
    """Refuse a robot that starts off the floor or inside furniture.

    Raises:
        InputError: It does; the text has the nearest free place.
    """
    x, y, yaw = placed.start
    radius = placed.robot.footprint_radius_m
    if abs(yaw) > 2 * math.pi + 1e-6:
        raise InputError(
            f"start's yaw must be in radians, at most 2 pi; {yaw:g} deg are {math.radians(yaw):.4f} rad"
        )
    inside = [k for k, name in enumerate(obstacles.names) if lab.built or name.startswith(str(FURNITURE))]
    standing = obstacles.only(inside)
    distance, which = standing.clearance([[x, y]], reach_m=radius)
    corners = np.array(lab.corners)
    half, middle = np.ptp(corners, axis=0) / 2, (corners.max(axis=0) + corners.min(axis=0)) / 2
    if distance[0] < radius:
        piece = standing.names[which[0]].split("/")[-2]
        what = f"in {piece!r}"
    elif not on_polygon(np.array([[x, y]]), lab.corners)[0]:
        what = f"off the floor of {2 * half[0]:g} x {2 * half[1]:g} m"
    else:
        return
    reach, free = half - radius, np.empty((0, 2))
    if min(reach) > 0:  # on a raster of about 5 cm
        steps = [min(400, max(3, int(r / 0.025))) for r in reach]
        axes = [m + np.linspace(-r, r, n) for m, r, n in zip(middle, reach, steps, strict=True)]
        at = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        distance, _ = standing.clearance(at, reach_m=radius + 0.05)
        free = at[(distance >= radius + 0.05) & on_polygon(at, lab.corners)]
    hint = "there is no free place"
    if len(free):
        nearest = free[np.argmin(np.hypot(free[:, 0] - x, free[:, 1] - y))]
        hint = f"start = [{nearest[0]:.2f}, {nearest[1]:.2f}, 0.0] is free"
    raise InputError(f"start ({x:g}, {y:g}) of robot {placed.robot.name!r} is {what}; {hint}")


def lab_of(
    lab: LabSpec, table: Mapping[str, Any], path: str | os.PathLike[str], map_layer: Path | None
) -> LabSpec:
    """The room of a TOML `table` read from `path`. If it has no floor_m, the floor covers the map.

    Raises:
        InputError: A length cannot be in metres.
    """
    if map_layer is not None and not {"floor_m", "floor"} & set(table.get("lab", {})):
        x0, x1, y0, y1 = load_map(map_layer).extent
        floor = 2 * max(abs(x0), abs(x1)), 2 * max(abs(y0), abs(y1))
        lab = replace(lab, floor_m=(round(floor[0], 6), round(floor[1], 6)))
    x0, x1, y0, y1 = lab.extent_m
    if max(x1 - x0, y1 - y0) > LARGEST_M:
        key = "floor" if lab.floor else "floor_m"
        text = f"{key} must be in metres, at most {LARGEST_M:g} each way, got {(x1 - x0, y1 - y0)}"
        raise refused_at(path, key, text, section="lab")
    for key in ("wall_height_m", "wall_thickness_m", "post_height_m", "apron_m"):
        if getattr(lab, key) > LARGEST_M:
            text = f"{key} must be in metres, at most {LARGEST_M:g}, got {getattr(lab, key):g}"
            raise refused_at(path, key, text, section="lab")
    return lab


def asset_named(file: Path, text: str, where: str) -> Path:
    """The USD file of a robot, from a file name or the name of a robot that ships with magtwin.

    Args:
        file: `text` as a file in the TOML's folder.
        text: Value of the key `asset`.
        where: File and table, for error messages.

    Raises:
        InputError: There is no such robot; the text lists the known ones.
    """
    if file.is_file() or Path(text).suffix or Path(text).name != text:
        return file
    folders = sorted(shipped("robots").iterdir())
    known = {f.name: f / f"{f.name}.usda" for f in folders if (f / f"{f.name}.usda").is_file()}
    if text in known:
        return known[text]
    raise InputError(
        f"{where} asset: no robot {text!r}; known: {', '.join(known)}; or give the name of a USD file"
    )


def check_name(name: str) -> None:
    """Refuse a scene name that is not a valid file name on every system, or is special to USD.

    Raises:
        InputError: It is not valid.
    """
    wrong = re.search(r'[\x00-\x1f\x7f/\\:*?"<>|\[\]@]', name)
    if wrong or not name.strip() or name[0] in ". -" or name[-1] in ". " or len(name.encode()) > 200:
        raise InputError(
            f"scene {name!r} cannot name a file; use letters, digits, - and _, up to 200 bytes, and none of "
            '/ \\ : * ? " < > | [ ] @'
        )
