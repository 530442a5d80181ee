"""MadeFrom: the room and the robot that a map was made from, to see later whether they have changed."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.frames import canonical
from magtwin.spec.base import Vec3
from magtwin.spec.furniture import FurnitureSpec, steel_of
from magtwin.spec.magnetics import SourceSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene

DECIMALS = 9
"""Decimal places of the numbers in a checksum: a value that passed through a transform keeps its checksum."""

DIGITS = 16
"""Characters of a checksum that are kept."""

SAME_NT = 0.05
"""Earth fields that differ by less are the same [nT]; a computed one has steps of 0.1 nT."""

SAME_M = 1e-4
"""Places of a sensor that differ by less are the same [m]."""

MOST_NAMES = 3
"""Most things that a text lists by name."""


@dataclass(frozen=True, kw_only=True)
class MadeFrom:
    """The Earth's field, the magnetised things and the robot that a map was made from."""

    earth_nt: Vec3 | None
    """Earth's field in the lab's axes [nT]; None if it was unknown."""

    sensor_m: Vec3
    """Magnetometer: forward and left of base_link, and above the floor [m]."""

    platform: str
    """Checksum of the robot's hard and soft iron."""

    bodies: Mapping[str, str]
    """Checksum of each magnetised thing, by its name."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "bodies", MappingProxyType(dict(self.bodies)))

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "bodies": dict(self.bodies)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({**state, "bodies": MappingProxyType(state["bodies"])})

    def __str__(self) -> str:
        x, y, z = self.sensor_m
        count = len(self.bodies)
        earth = (
            "no Earth's field"
            if self.earth_nt is None
            else f"Earth's field of {math.hypot(*self.earth_nt):,.0f} nT"
        )
        return (
            f"{count} magnetised thing{'s' * (count != 1)}, {earth}, magnetometer {x:.3f} m forward and "
            f"{y:.3f} m left of base_link, {z:.3f} m above the floor"
        )

    def at_height(self, height_m: float) -> "MadeFrom":
        """The same with the magnetometer at another height above the floor [m]."""
        return replace(self, sensor_m=(*self.sensor_m[:2], height_m))

    def table(self) -> dict[str, Any]:
        """The values as plain data for JSON; `from_table` reads them."""
        earth = None if self.earth_nt is None else list(self.earth_nt)
        return {
            "earth_nt": earth,
            "sensor_m": list(self.sensor_m),
            "platform": self.platform,
            "bodies": dict(self.bodies),
        }

    @classmethod
    def from_table(cls, table: Any) -> "MadeFrom":
        """The values of a table.

        Raises:
            InputError: A key is missing, or a value is of another type.
        """
        names = {f.name for f in fields(cls)}
        if not isinstance(table, dict) or set(table) != names:
            raise InputError(f"must have the keys {', '.join(sorted(names))}")
        bodies = table["bodies"]
        if not (isinstance(bodies, dict) and all(isinstance(v, str) for v in bodies.values())):
            raise InputError("bodies must be checksums by name")
        earth = None if table["earth_nt"] is None else _vec3(table["earth_nt"], "earth_nt")
        if not isinstance(table["platform"], str):
            raise InputError("platform must be a checksum")
        return cls(
            earth_nt=earth,
            sensor_m=_vec3(table["sensor_m"], "sensor_m"),
            platform=table["platform"],
            bodies=bodies,
        )

    def changes(self, scene: Scene) -> list[str]:
        """Compare with a scene as it is now.

        Args:
            scene: The scene, its robots as they were surveyed: in no session.

        Returns:
            What has changed since, one text each. Empty if nothing has.
        """
        texts, now = list[str](), _bodies(scene)
        if scene.earth is not None or now:  # else the map alone is the field
            texts += self._bodies_changed(now)
            texts += self._earth_changed(None if scene.earth is None else scene.earth.b_world_nt)
        for placed in scene.robots:
            texts += self._robot_changed(placed.robot)
        return texts

    def _bodies_changed(self, now: Mapping[str, str]) -> list[str]:
        moved = [name for name in self.bodies if name in now and now[name] != self.bodies[name]]
        gone = [name for name in self.bodies if name not in now]
        new = [name for name in now if name not in self.bodies]
        if sorted(self.bodies.values()) == sorted(now.values()):
            return []  # only names differ
        texts = [(moved, "moved, or has another magnetization"), (gone, "gone"), (new, "new")]
        return [
            f"{_listed(names)} {'are' if len(names) > 1 else 'is'} {what}" for names, what in texts if names
        ]

    def _earth_changed(self, now: Vec3 | None) -> list[str]:
        if now is None or self.earth_nt is None:
            if now == self.earth_nt:
                return []
            return ["the Earth's field is " + ("not known any more" if now is None else "known now")]
        off = math.dist(now, self.earth_nt)
        return [f"the Earth's field differs by {off:,.1f} nT"] if off > SAME_NT else []

    def _robot_changed(self, robot: RobotSpec) -> list[str]:
        texts = []
        now = _sensor_m(robot)
        if math.dist(now, self.sensor_m) > SAME_M:
            seen, was = (", ".join(f"{x:.3f}" for x in place) for place in (now, self.sensor_m))
            texts.append(f"the magnetometer of {robot.name} is at ({seen}) m, not ({was}) m")
        if _platform(robot) != self.platform:
            texts.append(f"the hard or soft iron of {robot.name} is not that of the survey")
        return texts


def made_from(scene: Scene, *, height_m: float | None = None) -> MadeFrom:
    """What a map of a scene is made from.

    Args:
        scene: The scene, its robot as it surveys; its map is not read.
        height_m: Height of the magnetometer above the floor [m]. Default: the robot's.
    """
    x, y, z = _sensor_m(scene.robot)
    return MadeFrom(
        earth_nt=None if scene.earth is None else scene.earth.b_world_nt,
        sensor_m=(x, y, z if height_m is None else height_m),
        platform=_platform(scene.robot),
        bodies=_bodies(scene),
    )


def _bodies(scene: Scene) -> dict[str, str]:
    """Checksum of each source and each piece of furniture with steel, by name."""
    things: list[SourceSpec | FurnitureSpec] = list(scene.sources)
    things += [piece for piece in scene.furniture if steel_of(piece)]
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


def _vec3(value: Any, name: str) -> Vec3:
    wanted = isinstance(value, list) and len(value) == 3
    if not (wanted and all(isinstance(x, int | float) and math.isfinite(x) for x in value)):
        raise InputError(f"{name} must be three numbers")
    x, y, z = map(float, value)
    return (x, y, z)


def _listed(names: list[str]) -> str:
    names = [name.strip() for name in names]
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return ", ".join(names[:MOST_NAMES]) + more
