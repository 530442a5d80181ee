"""Columns: which columns of a table of readings hold what, and in which units."""

from dataclasses import dataclass
from typing import Literal

from magtwin.names import RefusedError

Unit = Literal["nT", "uT", "T", "mG", "G"]
Axes = Literal["body", "world"]
HeadingUnit = Literal["rad", "deg"]

HEADINGS = ("heading", "yaw", "theta")
"""Names under which a heading is looked for where none is given."""

FIELDS = ("field", "b_nt", "scalar_mag", "magnitude")
"""Names under which a magnitude is looked for where neither it nor a vector is given."""


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
    """Column of the field's magnitude; field, b_nt, scalar_mag or magnitude unless given."""

    vector: str = ""
    """Columns of the field's three components, bx,by,bz."""

    axes: Axes = "body"
    """Axes of the vector: body (forward, left, up) or world."""

    heading_unit: HeadingUnit | None = None
    """Unit of the heading: rad, which is checked unless given, or deg."""

    unit: Unit | None = None
    """Unit of the field. Default: nT; of a bag, the unit that makes it the Earth's field."""

    scale: float | None = None
    """Factor from the file's values to nT, in place of a unit, as for a normalised sensor."""

    time: str = ""
    """Column of time [s]."""

    run_column: str = ""
    """Column whose values, numbers or words, tell runs apart."""

    def __post_init__(self) -> None:
        for name, count in (("quaternion", 4), ("vector", 3)):
            given = getattr(self, name)
            if given and len(self.several(name)) != count:
                raise RefusedError(f"{name} takes {count} columns with commas between, got {given!r}")
        if self.scale is not None:
            if self.unit is not None:
                raise RefusedError("give the field's unit or its scale, the factor to nT, not both")
            if not (0 < self.scale < float("inf")):
                raise RefusedError(f"scale is a factor to nT, above 0, got {self.scale:g}")
        if self.heading and self.quaternion:
            raise RefusedError("give the heading's column or the quaternion's, not both")

    def several(self, name: str) -> list[str]:
        """The columns that an option names, such as the three of `vector`."""
        return [word.strip() for word in getattr(self, name).split(",") if word.strip()]
