"""A scene: lab, magnetised things, map and robots."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from magtwin.errors import find
from magtwin.spec.base import ZERO3, Spec, Vec3
from magtwin.spec.furniture import FurnitureSpec, steel_of
from magtwin.spec.lab import LabSpec
from magtwin.spec.magnetics import EarthFieldSpec, SourceSpec
from magtwin.spec.robot import PlacedRobot, RobotSpec
from magtwin.summary import Summarized, Summary, listed


@dataclass(frozen=True, kw_only=True, repr=False)
class Scene(Summarized, Spec):
    """A lab, its magnetic map, and a robot in it, or several.

    What is asked of a scene is asked of its first robot, `robot`; `led_by` makes another one the first.
    """

    name: str
    """Name of the scene, and of its root layer."""

    map_layer: Path
    """USD layer of the anomaly map."""

    map_sha256: str = ""
    """Checksum of the map layer's file, lower-case hex; "" means that any file will do."""

    robot: RobotSpec
    lab: LabSpec = field(default_factory=LabSpec)
    earth: EarthFieldSpec | None = None
    """Earth's field; none where only a survey is known."""

    sources: tuple[SourceSpec, ...] = ()
    """Magnetised things in the lab; with `earth` and `furniture` they make the exact field known."""

    furniture: tuple[FurnitureSpec, ...] = ()
    """Furniture and parts of the building, whose steel is magnetised too."""

    start: Vec3 = ZERO3
    """Robot's first x [m], y [m] and yaw [rad] in world, where a path does not say."""

    path: str | Path = ""
    """What the robot drives unless told otherwise; see `PlacedRobot`."""

    others: tuple[PlacedRobot, ...] = ()
    """Further robots in the lab, each of a name of its own."""

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [placed.robot.name for placed in self.robots]
        twice = next((name for name in names if names.count(name) > 1), "")
        self._require("others", not twice, "be robots of names of their own", f"{twice!r} twice")

    @property
    def robots(self) -> tuple[PlacedRobot, ...]:
        """Every robot, `robot` first."""
        return (PlacedRobot(robot=self.robot, start=self.start, path=self.path), *self.others)

    def led_by(self, name: str) -> "Scene":
        """The scene with the robot of that name as its first, the others after it in their order.

        Raises:
            UnknownNameError: No robot is called so; the text names the nearest one.
        """
        placed = find("robot", name, {placed.robot.name: placed for placed in self.robots})
        rest = tuple(other for other in self.robots if other.robot.name != name)
        return replace(self, robot=placed.robot, start=placed.start, path=placed.path, others=rest)

    def _summary(self) -> Summary:
        """Name and floor; robots; map; what makes the field; what is driven."""
        width, depth = self.lab.floor_m
        robots = [f"{one.robot.name} ({one.robot.magnetometer.kind} magnetometer)" for one in self.robots]
        field = "no Earth's field" if self.earth is None else f"Earth's field of {self.earth.date}"
        return Summary(
            f"Scene {self.name}: floor {width:g} x {depth:g} m",
            (
                ("robots" if self.others else "robot", listed(robots, 80)),
                ("map", str(self.map_layer)),
                (
                    "field",
                    f"{field}, {len(self.sources):,} sources, {len(self.furniture):,} pieces of furniture",
                ),
                ("path", listed([str(one.path) or "not set" for one in self.robots])),
                ("furniture", listed([one.name for one in self.furniture], 200)),
            ),
        )

    @property
    def magnets(self) -> tuple[SourceSpec, ...]:
        """Everything that is magnetised: the sources, and the steel of the furniture."""
        return (*self.sources, *(source for piece in self.furniture for source in steel_of(piece)))
