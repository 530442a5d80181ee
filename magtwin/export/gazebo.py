"""World of Gazebo: a lab as SDF, with its floor, walls, furniture and the Earth's field."""

import math
import os
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.files.outputs import output
from magtwin.usd.lab.obstacles import ROBOT_HEIGHT_M
from magtwin.usd.scene import open_scene

SYSTEMS = {
    "gz-sim-physics-system": "gz::sim::systems::Physics",
    "gz-sim-user-commands-system": "gz::sim::systems::UserCommands",
    "gz-sim-scene-broadcaster-system": "gz::sim::systems::SceneBroadcaster",
    "gz-sim-sensors-system": "gz::sim::systems::Sensors",
    "gz-sim-imu-system": "gz::sim::systems::Imu",
}
"""Systems of Gazebo that a world with a robot needs, by file name."""

RIGHT = 1e-6
"""Largest cosine between the sides of a corner that counts as a right angle."""

Array = NDArray[np.float64]


def export_world(
    scene_file: str | os.PathLike[str], out: str | os.PathLike[str], *, force: bool = False
) -> Path:
    """Write a lab as a world of Gazebo (gz-sim), without robots.

    Walls and furniture are the outlines at which simulated robots stop, `ROBOT_HEIGHT_M` high. World axes,
    and so the poses in them, are those of the lab. The field of the world is the Earth's, in tesla.

    Args:
        scene_file: A scene.
        out: The world to write (.sdf).
        force: Whether to replace an existing file.

    Raises:
        InputError: The scene cannot be read, or `out` is not a .sdf file or exists.
    """
    if Path(out).suffix.lower() != ".sdf":
        raise InputError(f"{out}: a world of Gazebo is a .sdf file", parameter="out")
    opened = open_scene(scene_file)
    scene = opened.scene
    root = Element("sdf", version="1.9")
    world = _add(root, "world", name=scene.name)
    for file, name in SYSTEMS.items():
        plugin = _add(world, "plugin", filename=file, name=name)
        if name.endswith("Sensors"):
            _add(plugin, "render_engine", "ogre2")
    _add(world, "gravity", "0 0 -9.80665")
    if scene.earth is not None:
        _add(world, "magnetic_field", _numbers(np.asarray(scene.earth.b_world_nt) * 1e-9))
    sun = _add(world, "light", type="directional", name="sun")
    _add(sun, "direction", "-0.3 0.2 -0.9")
    floor = _link(_model(world, "floor"), "floor")
    for part in ("collision", "visual"):
        plane = _add(_add(_add(floor, part, name=part), "geometry"), "plane")
        _add(plane, "normal", "0 0 1")
        _add(plane, "size", _numbers(np.asarray(scene.lab.floor_m) + 2 * scene.lab.apron_m))
    standing = _model(world, "obstacles")
    obstacles = opened.obstacles
    for k, (name, outline) in enumerate(zip(obstacles.names, obstacles.outlines, strict=True)):
        _stand(_link(standing, f"{k}_{'_'.join(name.split('/')[-2:])}"), outline)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"
    with output(out, force=force) as aside:
        aside.write_text(text, encoding="utf-8")
    return Path(out)


def _stand(link: Element, outline: Array) -> None:
    """A box or a prism over an outline, in a link."""
    box = _box(outline)
    middle = (0.0, 0.0, 0.0, 0.0) if box is None else box
    z = 0.0 if box is None else ROBOT_HEIGHT_M / 2
    _add(link, "pose", _numbers([middle[0], middle[1], z, 0, 0, _turn(outline) if box else 0.0]))
    for part in ("collision", "visual"):
        geometry = _add(_add(link, part, name=part), "geometry")
        if box is not None:
            _add(_add(geometry, "box"), "size", _numbers([box[2], box[3], ROBOT_HEIGHT_M]))
            continue
        prism = _add(geometry, "polyline")
        for corner in outline:
            _add(prism, "point", _numbers(corner))
        _add(prism, "height", _numbers([ROBOT_HEIGHT_M]))


def _box(outline: Array) -> tuple[float, float, float, float] | None:
    """Centre x, y and lengths of the first and second side of a rectangle [m]; None for another shape."""
    sides = np.roll(outline, -1, axis=0) - outline
    if len(outline) != 4:
        return None
    lengths = np.hypot(*sides.T)
    cosines = np.abs(np.sum(sides * np.roll(sides, -1, axis=0), axis=1)) / (lengths * np.roll(lengths, -1))
    if cosines.max() > RIGHT:
        return None
    x, y = outline.mean(axis=0).tolist()
    return x, y, float(lengths[0]), float(lengths[1])


def _turn(outline: Array) -> float:
    """Heading of the first side of an outline [rad]."""
    x, y = outline[1] - outline[0]
    return math.atan2(y, x)


def _model(world: Element, name: str) -> Element:
    model = _add(world, "model", name=name)
    _add(model, "static", "true")
    return model


def _link(model: Element, name: str) -> Element:
    return _add(model, "link", name=name)


def _add(parent: Element, tag: str, text: str | None = None, **attributes: str) -> Element:
    child = ElementTree.SubElement(parent, tag, attributes)
    child.text = text
    return child


def _numbers(values: object) -> str:
    return " ".join(f"{float(value):.9g}" for value in np.asarray(values).ravel())
