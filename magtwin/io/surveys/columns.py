"""Columns: the meaning and the units of the columns of a table of readings."""

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import Literal

from magtwin.errors import InputError
from magtwin.field.units import Unit, check_factor
from magtwin.tables.delimited import DEGREES, label_of

Axes = Literal["body", "world"]
HeadingUnit = Literal["rad", "deg", "compass"]

FIELD_UNITS: dict[str, Unit] = {
    "nt": "nT",
    "nanotesla": "nT",
    "ut": "uT",
    "microtesla": "uT",
    "t": "T",
    "tesla": "T",
    "mg": "mG",
    "milligauss": "mG",
    "g": "G",
    "gauss": "G",
}
"""Units of the field, by the unit in a header in lower case."""

TIME_UNITS = dict.fromkeys(("s", "sec", "seconds"), 1.0)
TIME_UNITS |= dict.fromkeys(("ms", "msec", "milliseconds"), 1e-3)
TIME_UNITS |= dict.fromkeys(("us", "usec", "microseconds"), 1e-6)
TIME_UNITS |= dict.fromkeys(("ns", "nsec", "nanoseconds"), 1e-9)
TIME_UNITS |= {"min": 60.0, "h": 3600.0}
"""Seconds per unit of time, by the unit in a header."""

ANGLE_UNITS = (*DEGREES, "rad")
"""Units of a heading in a header."""

HEADINGS = ("heading", "yaw", "theta")
"""Default names of a heading."""

NO_HEADING = "none"
"""Given instead of a heading's column: a sensor carried by hand reads the same at all headings."""

POSITIONS = (
    *(("x", "y"), ("p_world_base_x", "p_world_base_y"), ("pos_x", "pos_y")),
    ("position_x", "position_y"),
)
"""Default names of x and y."""

FIELDS = (
    *("field", "b_nt", "scalar_mag", "magnitude", "b_measured", "b_total", "b_ut", "absolute_field", "b"),
    *("b_tot", "btotal", "bt", "|b|", "b_mag", "b_abs", "bmag", "mag", "total", "total_field", "mag_total"),
    *("magnetic_field", "mag_field", "tmi", "mag_tmi", "f"),
)
"""Default names of a magnitude, as `named` gives them."""

VECTORS = (
    *(("bx", "by", "bz"), ("b_x", "b_y", "b_z"), ("mx", "my", "mz"), ("mag_x", "mag_y", "mag_z")),
    *(("magx", "magy", "magz"), ("field_x", "field_y", "field_z")),
    *(
        ("magnetic_field_x", "magnetic_field_y", "magnetic_field_z"),
        ("mag_field_x", "mag_field_y", "mag_field_z"),
    ),
    ("magnetometer_x", "magnetometer_y", "magnetometer_z"),
)
"""Default names of a vector, if there is no magnitude."""

TIMES = ("t", "time", "timestamp", "stamp", "seconds_elapsed", "elapsed", "time_since_start")
"""Default names of time."""

_BETWEEN = re.compile(r"[\s./-]+")
_MICRO = str.maketrans("\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}", "uu")
_AMBIGUOUS = ("t", "g", "min", "h")
"""Units that are read in brackets only: `b_t` may be the total, and `t_min` the least."""


def named(label: str, units: Collection[str]) -> tuple[str, str]:
    """Name and unit in the header of a column, in lower case, with low lines between the words of the name.

    The unit is "" if there is none. One in brackets is read always, one behind a low line if it is among
    `units`: `Magnetic field x (\N{MICRO SIGN}T)` and `magnetic_field.x_uT` are magnetic_field_x in ut.
    """
    name, unit = label_of(label)
    name = _BETWEEN.sub("_", name.strip("./ ")).translate(_MICRO)
    head, _, tail = name.rpartition("_")
    if not unit and head and tail in units and tail not in _AMBIGUOUS:
        return head.removesuffix("_in"), tail
    return name, unit.translate(_MICRO)


@dataclass(frozen=True, kw_only=True)
class Columns:
    """Columns to read from a table, by name in the header or by number from 1."""

    x: str = "x"
    """Column of world x [m], such as x or pos_x."""

    y: str = "y"
    """Column of world y [m]."""

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

    run_column: str = ""
    """Column that identifies the run of each row, by numbers or text."""

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
