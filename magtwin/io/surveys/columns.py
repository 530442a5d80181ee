"""Columns: which columns of a table of readings hold what, and in which units."""

from dataclasses import dataclass
from typing import Literal

from magtwin.errors import InputError
from magtwin.field.units import Unit

Axes = Literal["body", "world"]
HeadingUnit = Literal["rad", "deg"]

HEADINGS = ("heading", "yaw", "theta")
"""Names under which a heading is looked for where none is given."""

FIELDS = (
    *(
        "field",
        "b_nt",
        "scalar_mag",
        "magnitude",
        "b_total",
        "b_total_nt",
        "b_ut",
        "b_total_ut",
        "b",
        "b_tot",
    ),
    *("btotal", "bt", "|b|", "b_mag", "mag", "total", "total_field", "f"),
)
"""Names under which a magnitude is looked for where neither it nor a vector is given; case does not count."""

VECTORS = (
    *(("bx", "by", "bz"), ("b_x", "b_y", "b_z"), ("mx", "my", "mz"), ("mag_x", "mag_y", "mag_z")),
    *(("magx", "magy", "magz"), ("field_x", "field_y", "field_z"), ("bx_nt", "by_nt", "bz_nt")),
    *(("bx_ut", "by_ut", "bz_ut"), ("magnetic_field.x", "magnetic_field.y", "magnetic_field.z")),
)
"""Names under which a vector is looked for where neither it nor a magnitude is given or found."""

TIMES = ("t", "time", "timestamp", "stamp", "time_s")
"""Names under which time is looked for where none is given."""


@dataclass(frozen=True, kw_only=True)
class Columns:
    """What to read from which columns of a table; a column is a name of the header, or a number from 1."""

    x: str = "x"
    """Column of world x [m]."""

    y: str = "y"
    """Column of world y [m]."""

    heading: str = ""
    """Column of the robot's heading; heading, yaw or theta unless given."""

    quaternion: str = ""
    """Columns of the robot's orientation in world, qx,qy,qz,qw, in place of a heading."""

    field: str = ""
    """Column of the field's magnitude; unless given, one of a usual name, such as field, b_total or b_nt."""

    vector: str = ""
    """Columns of the field's three components, bx,by,bz; unless given, those of usual names where there is no
    magnitude."""

    axes: Axes | None = None
    """Axes of the vector: body (forward, left, up), the default, or world."""

    heading_unit: HeadingUnit | None = None
    """Unit of the heading: rad, which is checked unless given, or deg."""

    unit: Unit | None = None
    """Unit of the field. Default: the unit in which it has the size of the Earth's field."""

    scale: float | None = None
    """Factor from the file's values to nT, in place of a unit, as for a normalised sensor."""

    time: str = ""
    """Column of time [s]; t, time or timestamp unless given."""

    run_column: str = ""
    """Column whose values, numbers or words, tell runs apart."""

    def __post_init__(self) -> None:
        for name, count in (("quaternion", 4), ("vector", 3)):
            given = getattr(self, name)
            if given and len(self.several(name)) != count:
                raise InputError(f"{name} takes {count} columns with commas between, got {given!r}")
        if self.scale is not None:
            if self.unit is not None:
                raise InputError("give the field's unit or its scale, the factor to nT, not both")
            if not (0 < self.scale < float("inf")):
                raise InputError(f"scale is a factor to nT, above 0, got {self.scale:g}")
        if self.heading and self.quaternion:
            raise InputError("give the heading's column or the quaternion's, not both")

    def several(self, name: str) -> list[str]:
        """The columns that an option names, such as the three of `vector`."""
        return [word.strip() for word in getattr(self, name).split(",") if word.strip()]
