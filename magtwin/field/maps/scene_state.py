"""Scene state: what a map of a scene is made from, and what has changed in the scene since."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from magtwin.field.maps.made_from import MadeFrom
from magtwin.frames import canonical
from magtwin.report.summary import listed
from magtwin.spec.base import Vec3
from magtwin.spec.furniture import FurnitureSpec, steel_of
from magtwin.spec.magnetics import SourceSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.spec.walls import Door, Wall, Window

DECIMALS = 9
"""Decimal places of the numbers in a checksum: a value that passed through a transform keeps its checksum."""

DIGITS = 16
"""Characters of a checksum that are kept."""

SAME_NT = 0.05
"""Earth fields that differ by less are the same [nT]; a computed one has steps of 0.1 nT."""

SAME_M = 1e-4
"""Places of a sensor that differ by less are the same [m]."""


def made_from(scene: Scene, *, height_m: float | None = None) -> MadeFrom:
    """What a map of a scene is made from.

    Its robot is as it surveys; its map is not read. `height_m` is that of the magnetometer above the floor,
    by default the robot's.
    """
    x, y, z = _sensor_m(scene.robot)
    return MadeFrom(
        earth_nt=None if scene.earth is None else scene.earth.b_world_nt,
        sensor_m=(x, y, z if height_m is None else height_m),
        platform=_platform(scene.robot),
        bodies=_bodies(scene),
    )


def _bodies(scene: Scene) -> dict[str, str]:
    """Checksum of each source and of each wall, door and piece of furniture with steel, by name."""
    things: list[SourceSpec | FurnitureSpec | Wall | Door | Window] = list(scene.sources)
    things += [piece for piece in scene.furniture if steel_of(piece)]
    things += scene.lab.structure.magnetic()
    found: dict[str, str] = {}
    for thing in things:
        name = thing.name if thing.name not in found else f"{thing.name} "  # a piece named like a source
        found[name] = _checksum(
            getattr(thing, f.name) if not f.name.startswith("q_") else canonical(getattr(thing, f.name))
            for f in fields(thing)
            if f.name != "name"
        )
    return found


def _sensor_m(robot: RobotSpec) -> Vec3:
    x, y, z = robot.p_base_magnetometer
    return (x, y, z + robot.base_height_m)


def _platform(robot: RobotSpec) -> str:
    return _checksum((robot.platform.hard_iron_nt, robot.platform.soft_iron))


def _checksum(values: Any) -> str:
    """Start of the SHA-256 of texts, numbers and nested tuples, with numbers rounded."""
    return hashlib.sha256(_text(tuple(values)).encode()).hexdigest()[:DIGITS]


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        value = tuple(value.tolist())
    if isinstance(value, tuple):
        return f"({','.join(map(_text, value))})"
    if isinstance(value, int | float) and not isinstance(value, bool):
        return repr(round(float(value), DECIMALS) + 0.0)
    return repr(value)


def changes_since(made: MadeFrom, scene: Scene) -> list[str]:
    """What has changed in a scene since a map was made from it.

    One text each; empty if nothing has. Robots of the scene are as they were surveyed: in no session.
    """
    texts, now = list[str](), _bodies(scene)
    if scene.earth is not None or now:  # else the map alone is the field
        texts += _bodies_changed(made, now)
        texts += _earth_changed(made, None if scene.earth is None else scene.earth.b_world_nt)
    for placed in scene.robots:
        texts += _robot_changed(made, placed.robot)
    return texts


def _bodies_changed(made: MadeFrom, now: Mapping[str, str]) -> list[str]:
    moved = [name for name in made.bodies if name in now and now[name] != made.bodies[name]]
    gone = [name for name in made.bodies if name not in now]
    new = [name for name in now if name not in made.bodies]
    if sorted(made.bodies.values()) == sorted(now.values()):
        return []  # only names differ
    texts = [(moved, "moved, or has another magnetization"), (gone, "gone"), (new, "new")]
    return [
        f"{listed([name.strip() for name in names])} {'are' if len(names) > 1 else 'is'} {what}"
        for names, what in texts
        if names
    ]


def _earth_changed(made: MadeFrom, now: Vec3 | None) -> list[str]:
    if now is None or made.earth_nt is None:
        if now == made.earth_nt:
            return []
        return ["the Earth's field is " + ("not known any more" if now is None else "known now")]
    off = math.dist(now, made.earth_nt)
    return [f"the Earth's field differs by {off:,.1f} nT"] if off > SAME_NT else []


def _robot_changed(made: MadeFrom, robot: RobotSpec) -> list[str]:
    texts = []
    now = _sensor_m(robot)
    if math.dist(now, made.sensor_m) > SAME_M:
        seen, was = (", ".join(f"{x:.3f}" for x in place) for place in (now, made.sensor_m))
        texts.append(f"the magnetometer of {robot.name} is at ({seen}) m, not ({was}) m")
    if _platform(robot) != made.platform:
        texts.append(f"the hard or soft iron of {robot.name} is not that of the survey")
    return texts
