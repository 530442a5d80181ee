"""Columns and About: what a user tells about the files of a survey."""

from dataclasses import dataclass
from typing import Literal

from magtwin.errors import InputError
from magtwin.field.units import Unit, check_factor

Axes = Literal["body", "world"]
HeadingUnit = Literal["rad", "deg", "compass"]

NO_HEADING = "none"
"""Given instead of a heading's column: a sensor carried by hand reads the same at all headings."""


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns to read from a table, by name in the header or by number from 1."""

    x: str = ""
    """Column of world x [m]. Default: a usual name, such as x, pos_x or easting."""

    y: str = ""
    """Column of world y [m]. Default: the usual name that belongs to that of x."""

    heading: str = ""
    """Column of the robot's heading, or "none" for a sensor carried by hand. Default: heading, yaw or
    theta."""

    quaternion: str = ""
    """Columns of the robot's orientation in world, qx,qy,qz,qw, instead of a heading. Names that end in x, y,
    z and w may be in any order."""

    field: str = ""
    """Column of the magnitude of the field. Default: a usual name, such as field, b_total or b_nt."""

    vector: str = ""
    """Columns of the components of the field, bx,by,bz. Default: usual names, if there is no magnitude."""

    axes: Axes | None = None
    """Axes of the vector: body (forward, left, up) or world. Default: body."""

    heading_unit: HeadingUnit | None = None
    """Unit of the heading: rad or deg, counter-clockwise from +x, or compass, degrees clockwise from north,
    which is +y of the map. Default: rad; headings that are too large for radians are refused."""

    unit: Unit | None = None
    """Unit of the field. Default: detected, as the unit in which the values have the size of the
    Earth's field."""

    scale: float | None = None
    """Factor from the file's values to nT. It replaces the unit, for example for normalised values."""

    time: str = ""
    """Column of time [s], or in the unit of its name. Default: t, time or timestamp. Times since 1970 in ms,
    us or ns are told by their size."""

    def __post_init__(self) -> None:
        for name, count in (("quaternion", 4), ("vector", 3)):
            given = getattr(self, name)
            if given and len(self.several(name)) != count:
                raise InputError(f"{name} takes {count} columns with commas between, got {given!r}")
        check_factor(self.unit, self.scale)
        if self.heading and self.quaternion:
            raise InputError("give either the heading's column or the quaternion's")

    def several(self, name: str) -> list[str]:
        """The columns that an option names, such as the three of `vector`."""
        return [word.strip() for word in getattr(self, name).split(",") if word.strip()]


@dataclass(frozen=True, kw_only=True)
class About:
    """Metadata that a survey's files may lack."""

    name: str | None = None
    """Name of the map. Default: the name of the output."""

    licence: str = ""
    """Licence of the survey, an SPDX identifier such as MIT."""

    created: str = ""
    """Date of the survey, YYYY-MM-DD."""

    height_m: float | None = None
    """Height of the sensor above the floor [m]."""

    frame: str = ""
    """Axes of x, y and heading, such as "world: x east, y north, z up"."""

    datum: str = ""
    """Origin of that frame, such as "origin at the centre of the floor"."""

    def __post_init__(self) -> None:
        from magtwin.field.days import check_day

        check_day(self.created, "--created")
