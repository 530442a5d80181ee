"""MadeFrom: the room and the robot that a map was made from, to see later whether they have changed."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any

from magtwin.errors import InputError

Vec3 = tuple[float, float, float]


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
        """The values of a table."""
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


def _vec3(value: Any, name: str) -> Vec3:
    wanted = isinstance(value, list) and len(value) == 3
    if not (wanted and all(isinstance(x, int | float) and math.isfinite(x) for x in value)):
        raise InputError(f"{name} must be three numbers")
    x, y, z = map(float, value)
    return (x, y, z)
