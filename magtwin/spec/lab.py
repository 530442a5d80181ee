"""The lab: its floor, walls and posts; and how a robot surveys it."""

from dataclasses import dataclass

from magtwin.spec.base import Spec


@dataclass(frozen=True, kw_only=True)
class LabSpec(Spec):
    """A room: a floor centred on the world's origin, low walls, and posts for motion capture."""

    floor_m: tuple[float, float] = (6.0, 3.5)
    """Size of the floor in x and y [m]."""

    wall_height_m: float = 0.3
    """Height of the walls [m]; 0 means no walls."""

    wall_thickness_m: float = 0.05
    """Thickness of the walls, which stand outside the floor [m]."""

    post_height_m: float = 2.2
    """Height of the posts, one at each corner and one in the middle of each long wall [m]; 0 means none."""

    apron_m: float = 0.2
    """Width of the slab outside the walls; furniture may stand on it [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("floor_m", min(self.floor_m) > 0, "be above 0 m each way", self.floor_m)
        self._not_negative("wall_height_m", "post_height_m", "apron_m")
        self._above_zero("wall_thickness_m")


@dataclass(frozen=True, kw_only=True)
class SurveySpec(Spec):
    """A survey of a room without a map: the robot stands at each node of a grid in each heading."""

    spacing_m: float = 0.25
    """Distance between nodes [m]."""

    headings_deg: tuple[float, ...] = (0.0, 90.0, 180.0, 270.0)
    """Headings at each node, ascending [deg]."""

    readings: int = 135
    """Readings averaged at each node and heading."""

    height_m: float | None = None
    """Height of the sensor above the floor [m]. Default: the robot's."""

    heading_error_deg: float = 0.0
    """Standard deviation of the heading [deg]."""

    position_error_m: float = 0.0
    """Standard deviation of the position along x and y [m]."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("spacing_m")
        self._require("readings", self.readings >= 1, "be at least 1", self.readings)
        self._not_negative("heading_error_deg", "position_error_m")
        self._require("height_m", (self.height_m or 0.0) >= 0, "not be below 0", self.height_m)
        headings = self.headings_deg
        rises = bool(headings) and list(headings) == sorted(set(headings))
        within = rises and headings[0] >= 0 and headings[-1] < 360
        self._require("headings_deg", within, "ascend from 0 to below 360", headings)
