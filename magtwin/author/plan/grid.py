"""Occupancy maps of ROS: the floor and the walls of a picture of cells and its YAML."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.author.plan.drawing import Array
from magtwin.author.plan.floor import area, as_bar, outline, section
from magtwin.errors import InputError
from magtwin.files.budget import check_count
from magtwin.files.file import existing, read_text
from magtwin.files.settings import yaml_loader

SPECK_M = 0.1
"""A hole in the free floor that is smaller each way is noise [m]."""

WALL_M = 0.05
"""Thickness of the walls around a hole in the free floor [m]."""

FEW_M2 = 1.0
"""Least free floor of a map [m2]."""


def read_grid(
    path: Path, scale: float | None
) -> tuple[tuple[Any, ...], list[tuple[Array, float]], list[str]]:
    """Corners of the largest free floor, walls in it with their thickness, and notes.

    Args:
        path: The picture, or the YAML of map_server that names it.
        scale: Metres per cell; None takes `resolution` of the YAML.

    Raises:
        InputError: A file is missing or invalid, the map has no scale, or nothing in it is free.
    """
    yaml_file = path if path.suffix.lower() in (".yaml", ".yml") else path.with_suffix(".yaml")
    table = _yaml(yaml_file) if yaml_file.exists() else {}
    if not table and scale is None:
        way = "give that file, or `scale=M`, metres per cell"
        text = f"a map without a scale: no {yaml_file.name} is beside it; {way}"
        raise InputError(f"{path}: {text}", parameter="scale")
    picture = yaml_file.parent / str(table["image"]) if path == yaml_file else path
    cells = _picture(existing(picture, "picture of a map"))
    step = scale or _number(table, "resolution", yaml_file)
    x, y, yaw = (float(n) for n in [*table.get("origin", []), 0.0, 0.0, 0.0][:3])
    lightness = cells / 255.0
    occupied = lightness if table.get("negate") else 1.0 - lightness
    free = occupied < _number(table, "free_thresh", yaml_file, 0.196)
    shape, whole = _free_floor(free[::-1], step)
    if shape is None:
        raise InputError(f"{picture}: less than {FEW_M2:g} m2 of it are free, with {step:g} m a cell")
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])

    def placed(p: Array) -> Array:
        return np.round(p @ turn.T + (x, y), 3)

    floor = placed(outline(shape))
    borders = [np.asarray(p) for p in shape.to_polygons()]
    bars = [bar for p in borders if area(p) < 0 for bar in _island(p[::-1])]
    notes = [
        f"{step:g} m a cell; the floor is the largest free part of the map, of {shape.area():.1f} m2",
        f"x and y are those of the map, whose lower left corner is ({x:g}, {y:g})",
    ]
    if whole - shape.area() > FEW_M2:
        notes.append(f"{whole - shape.area():.1f} m2 of free cells are left out: not connected with it")
    return tuple(map(tuple, floor.tolist())), [(placed(p), thick) for p, thick in bars], notes


def _yaml(file: Path) -> dict[str, Any]:
    """The table of a YAML of map_server."""
    import yaml

    try:
        table = yaml.load(read_text(file, "map of map_server", "YAML"), Loader=yaml_loader())
    except yaml.YAMLError as error:
        raise InputError(f"{file}: not YAML: {error}".replace("\n", " ")) from error
    if not isinstance(table, dict) or not {"image", "resolution"} <= table.keys():
        raise InputError(f"{file}: not a map of map_server: it has no image and resolution")
    origin = table.get("origin", [0, 0, 0])
    listed = isinstance(origin, list) and len(origin) in (2, 3)
    if not (listed and all(isinstance(n, int | float) for n in origin)):
        raise InputError(f"{file}: origin must be [x, y, yaw], got {origin!r}")
    return table


def _number(table: dict[str, Any], key: str, file: Path, default: float | None = None) -> float:
    value = table.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < math.inf:
        raise InputError(f"{file}: {key} must be a number above 0, got {value!r}")
    return float(value)


def _picture(file: Path) -> NDArray[np.float64]:
    """Lightness of a picture's pixels, 0 to 255, shape (rows, columns), the first row on top."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(file) as opened:
            check_count(file, "image", opened.width * opened.height, "pixels")
            grey = np.array(opened.convert("LA") if "A" in opened.getbands() else opened.convert("L"), float)
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError) as error:
        raise InputError(f"{file}: not a picture that is read: {error}") from error
    if grey.ndim == 3:  # what is transparent is unknown
        return np.where(grey[..., 1] > 0, grey[..., 0], 205.0)
    return grey


def _free_floor(free: NDArray[np.bool_], step: float) -> tuple[Any, float]:
    """The largest free part of rows of cells, without specks, as a section, and the area of all [m2]."""
    from scipy import ndimage

    opened = ndimage.binary_opening(free, np.ones((2, 2)))
    labels, count = ndimage.label(opened)
    sizes = np.bincount(labels.ravel(), minlength=2)[1:]
    if not count or sizes.max() * step**2 < FEW_M2:
        return None, 0.0
    part = labels == int(np.argmax(sizes)) + 1
    runs = list[Array]()
    for j, row in enumerate(part):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], row.view(np.int8), [0]]))).reshape(-1, 2)
        runs += [np.array([[a, j], [b, j], [b, j + 1], [a, j + 1]], float) for a, b in edges]
    shape = section(runs).simplify(1.5)
    rough = [np.asarray(p) * step for p in shape.to_polygons()]
    kept = [p for p in rough if area(p) > 0 or np.ptp(p, axis=0).max() > SPECK_M]
    from manifold3d import CrossSection, FillRule

    return CrossSection(kept, FillRule.Positive), float(sizes.sum()) * step**2


def _island(p: Array) -> list[tuple[Array, float]]:
    """Walls of what stands in the floor, a polygon that runs counter-clockwise: one bar, or its sides."""
    bar = as_bar(p) if len(p) == 4 else None
    if bar is not None:
        return [bar]
    size = np.ptp(p, axis=0)
    if size.min() < 2 * WALL_M or (area(p) > 0.85 * size.prod() and size.min() < 0.6):
        middle, along = (p.min(axis=0) + p.max(axis=0)) / 2, int(size[1] > size[0])
        half = np.zeros(2)
        half[along] = size[along] / 2
        return [(np.array([middle - half, middle + half]), float(max(size[1 - along], 0.01)))]
    walls = []
    for a, b in zip(p, np.roll(p, -1, axis=0), strict=True):
        if (length := math.dist(a, b)) > 0.02:
            inward = np.array([a[1] - b[1], b[0] - a[0]]) / length * WALL_M / 2
            walls.append((np.array([a + inward, b + inward]), WALL_M))
    return walls
