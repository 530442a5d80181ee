"""Columns: the meaning and the units of the columns of a table of readings."""

from dataclasses import dataclass
from typing import Literal

from magtwin.errors import InputError
from magtwin.field.units import Unit

Axes = Literal["body", "world"]
HeadingUnit = Literal["rad", "deg"]

HEADINGS = ("heading", "yaw", "theta")
"""Default names of a heading."""

NO_HEADING = "none"
"""Given instead of a heading's column: a sensor carried by hand reads the same at all headings."""

FIELDS = (
    *("field", "b_nt", "scalar_mag", "magnitude", "b_total", "b_total_nt", "b_ut", "b_total_ut", "b"),
    *("b_tot", "btotal", "bt", "|b|", "b_mag", "mag", "total", "total_field", "f"),
)
"""Default names of a magnitude; case does not matter."""

VECTORS = (
    *(("bx", "by", "bz"), ("b_x", "b_y", "b_z"), ("mx", "my", "mz"), ("mag_x", "mag_y", "mag_z")),
    *(("magx", "magy", "magz"), ("field_x", "field_y", "field_z"), ("bx_nt", "by_nt", "bz_nt")),
    *(("bx_ut", "by_ut", "bz_ut"), ("magnetic_field.x", "magnetic_field.y", "magnetic_field.z")),
)
"""Default names of a vector, if there is no magnitude."""

TIMES = ("t", "time", "timestamp", "stamp", "time_s")
"""Default names of time."""


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns to read from a table, by name in the header or by number from 1."""

    x: str = "x"
    """Column of world x [m]."""

    y: str = "y"
    """Column of world y [m]."""

    heading: str = ""
    """Column of the robot's heading, or "none" for a sensor carried by hand. Default: heading, yaw or
    theta."""

    quaternion: str = ""
    """Columns of the robot's orientation in world, qx,qy,qz,qw, instead of a heading."""

    field: str = ""
    """Column of the magnitude of the field. Default: a usual name, such as field, b_total or b_nt."""

    vector: str = ""
    """Columns of the components of the field, bx,by,bz. Default: usual names, if there is no magnitude."""

    axes: Axes | None = None
    """Axes of the vector: body (forward, left, up) or world. Default: body."""

    heading_unit: HeadingUnit | None = None
    """Unit of the heading. Default: rad; headings that are too large for radians are refused."""

    unit: Unit | None = None
    """Unit of the field. Default: detected, as the unit in which the values have the size of the
    Earth's field."""

    scale: float | None = None
    """Factor from the file's values to nT. It replaces the unit, for example for normalised values."""

    time: str = ""
    """Column of time [s]. Default: t, time or timestamp."""

    run_column: str = ""
    """Column that identifies the run of each row, by numbers or text."""

    def __post_init__(self) -> None:
        for name, count in (("quaternion", 4), ("vector", 3)):
            given = getattr(self, name)
            if given and len(self.several(name)) != count:
                raise InputError(f"{name} takes {count} columns with commas between, got {given!r}")
        if self.scale is not None:
            if self.unit is not None:
                raise InputError("give either the unit of the field or its scale, the factor to nT")
            if not (0 < self.scale < float("inf")):
                raise InputError(
                    f"scale, the factor to nT, must be above 0, got {self.scale:g}", parameter="scale"
                )
        if self.heading and self.quaternion:
            raise InputError("give either the heading's column or the quaternion's")

    def several(self, name: str) -> list[str]:
        """The columns that an option names, such as the three of `vector`."""
        return [word.strip() for word in getattr(self, name).split(",") if word.strip()]
