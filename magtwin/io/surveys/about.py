"""About: metadata that the files of a survey may lack."""

from dataclasses import dataclass


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
