"""A scene: lab, magnetised things, map and robots."""

import importlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magtwin.errors import find
from magtwin.report.summary import Summarized, Summary, listed
from magtwin.spec.base import ZERO3, Spec, Vec3
from magtwin.spec.furniture import FurnitureSpec, steel_of
from magtwin.spec.lab import LabSpec
from magtwin.spec.magnetics import EarthFieldSpec, SourceSpec
from magtwin.spec.robot import PlacedRobot, RobotSpec, fields_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, repr=False)
class Scene(Summarized, Spec):
    """A lab, its magnetic map, and one or more robots.

    `robot`, `start` and `path` are those of the first robot; `led_by` makes another robot the first.
    """

    name: str
    """Name of the scene, and of its root layer."""

    map_layer: Path
    """USD layer of the anomaly map."""

    map_sha256: str = ""
    """SHA-256 of the map layer, lower-case hex; "" accepts any file."""

    robot: RobotSpec
    lab: LabSpec = field(default_factory=LabSpec)
    earth: EarthFieldSpec | None = None
    """Earth's field; None if only a survey is known."""

    sources: tuple[SourceSpec, ...] = ()
    """Magnetised things in the lab. With `earth` and `furniture`, they define the exact field."""

    furniture: tuple[FurnitureSpec, ...] = ()
    """Furniture and parts of the building; their steel is magnetised too."""

    start: Vec3 = ZERO3
    """Start of the robot, see `PlacedRobot`."""

    path: str | Path = ""
    """Default path of the robot, see `PlacedRobot`."""

    others: tuple[PlacedRobot, ...] = ()
    """Further robots in the lab, each with its own name."""

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [placed.robot.name for placed in self.robots]
        twice = next((name for name in names if names.count(name) > 1), "")
        self._require("others", not twice, "have different names", f"{twice!r} twice")

    @property
    def robots(self) -> tuple[PlacedRobot, ...]:
        """Every robot, `robot` first."""
        return (PlacedRobot(robot=self.robot, start=self.start, path=self.path), *self.others)

    def with_robots(self, change: Callable[[int, RobotSpec], RobotSpec]) -> "Scene":
        """The scene with each robot as `change` makes it of its number, from 0, and its spec."""
        robots = [replace(placed, robot=change(k, placed.robot)) for k, placed in enumerate(self.robots)]
        return replace(self, **fields_of(robots))

    def led_by(self, name: str) -> "Scene":
        """The scene with the robot called `name` as the first robot."""
        placed = find("robot", name, {placed.robot.name: placed for placed in self.robots})
        rest = [other for other in self.robots if other.robot.name != name]
        return replace(self, **fields_of([placed, *rest]))

    def with_(self, changes: Mapping[str, Any] | None = None, **values: Any) -> "Scene":
        """The scene with something changed. The map stays: `open_twin` warns where and by how much it is off.

        Args:
            changes: New values by their way from the scene, as in {"furniture.desk.p_world": (1, 0, 0),
                "furniture.*.magnetization": (), "robot.magnetometer.rate_hz": 20}. A piece of furniture, a
                source, wall, door or window is named by its name, of which * stands for any part; None in
                place of it removes it. `yaw` [rad] turns what has an orientation.
            **values: New values of fields, such as name="b" or earth=EarthFieldSpec(...). `map_layer` may be
                an `AnomalyMap`: `scene.with_(map_layer=magtwin.survey(scene))` has a fresh one.

        Raises:
            InputError: There is no such field or thing; a value has the wrong type or size, or a piece of
                furniture does not stand on the floor.
        """
        rooms = importlib.import_module("magtwin.author.rooms")
        return rooms.changed(self, {**(changes or {}), **values})  # type: ignore[no-any-return]

    def to_toml(self, out: str | os.PathLike[str] | None = None, *, force: bool = False) -> str:
        """The scene as the text of a TOML, of which `magtwin.scene_from_toml` makes the same scene.

        Args:
            out: File to write it to as well.
            force: Whether to replace a file that exists.
        """
        tables = importlib.import_module("magtwin.author.tables").table_of_scene(self)
        return str(importlib.import_module("magtwin.author.rooms").written(tables, out, force))

    def plot(self) -> "Figure":
        """Draw the room from above, over its map; see `magtwin.plot`."""
        return importlib.import_module("magtwin").plot(self)  # type: ignore[no-any-return]

    def _summary(self) -> Summary:
        """Name and floor; robots; map; field; paths; furniture."""
        robots = [f"{p.robot.name} ({p.robot.magnetometer.kind} magnetometer)" for p in self.robots]
        field = "no Earth's field" if self.earth is None else f"Earth's field of {self.earth.date}"
        things = f"{len(self.sources):,} sources, {len(self.furniture):,} pieces of furniture"
        rows = {
            "robots" if self.others else "robot": listed(robots, 80),
            "map": str(self.map_layer),
            "field": f"{field}, {things}",
            "path": listed([str(placed.path) or "not set" for placed in self.robots]),
            "furniture": listed([piece.name for piece in self.furniture], 200),
            "walls": listed([wall.name for wall in self.lab.walls], 80),
            "doors": listed([f"{door.name} at {door.open_deg:g} deg" for door in self.lab.doors], 80),
        }
        return Summary(f"Scene {self.name}: floor {self.lab.size_text}", tuple(rows.items()))

    @property
    def magnets(self) -> tuple[SourceSpec, ...]:
        """All magnetised things: the sources, and the steel of the furniture, walls and doors."""
        steel = (source for piece in self.furniture for source in steel_of(piece))
        return (*self.sources, *steel, *self.lab.magnets)
