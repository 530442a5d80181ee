"""Room: a scene authored in Python, call by call; and scenes of which something is changed.

A `Room` holds the tables that a TOML would have (`magtwin.author.scene_file`), so that both have the same
keys, checks and meaning.
"""

import fnmatch
import importlib
import inspect
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

from magtwin.author.furniture import FurnitureTable, check_stands
from magtwin.author.robot import RobotSettings, mounted
from magtwin.author.room import asset_named, check_name, lab_of, obstacles_in
from magtwin.author.scene import check_things
from magtwin.author.scene_file import EarthTable
from magtwin.author.tables import table_of, table_of_robot, toml_text
from magtwin.author.walls import DoorTable, WallTable, check_not_in_walls, lab_with_walls
from magtwin.errors import InputError, MismatchWarning, hint
from magtwin.files.file import existing
from magtwin.files.outputs import WORKSHOP, output, transaction
from magtwin.files.settings import from_values, plain
from magtwin.frames import quat_from_yaw
from magtwin.report.summary import Summarized, Summary, listed
from magtwin.spec.base import Spec
from magtwin.spec.lab import LabSpec, SurveySpec
from magtwin.spec.magnetics import SourceSpec
from magtwin.spec.robot import PlacedRobot, RobotSpec
from magtwin.spec.scene import Scene
from magtwin.spec.walls import Window
from magtwin.usd.layers import layer_sha256

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from magtwin.field.maps.map import AnomalyMap

File = str | os.PathLike[str]
Point = Sequence[float]
"""x and y, or x, y and z in world [m]: a tuple, a list or an array."""

EARTH = {"latitude_deg": 29.65, "longitude_deg": -82.35, "height_m": 50.0, "date": "2026-11-21"}
"""Place and day of a room that names none: Gainesville, Florida, as in `magtwin new`."""

FAR_M = 100.0
"""A place further from the origin than this is probably not in metres [m]."""

DESCRIPTIONS = (".urdf", ".xacro", ".xml")


class LabKeys(TypedDict, total=False):
    """More of a room, see `LabSpec`."""

    wall_height_m: float
    wall_thickness_m: float
    post_height_m: float
    apron_m: float


class PieceKeys(TypedDict, total=False):
    """More of a piece of furniture, see `Room.furniture`."""

    name: str
    magnetization: Sequence[float]
    susceptibility: float
    seed: int


class WallKeys(TypedDict, total=False):
    """More of a wall, see `Wall`."""

    name: str
    height_m: float
    thickness_m: float
    magnetization: float
    susceptibility: float


class DoorKeys(WallKeys, total=False):
    """More of a door, see `Door`."""

    material: str
    width_m: float
    open_deg: float
    hinge: str


class WindowKeys(TypedDict, total=False):
    """More of a window, see `Window`."""

    name: str
    width_m: float
    height_m: float
    sill_m: float


class SourceKeys(TypedDict, total=False):
    """More of a magnet, see `SourceSpec`."""

    name: str
    shape: str
    q_world_xyzw: Sequence[float]
    size_m: Sequence[float]
    magnetization: Sequence[float]
    susceptibility: float
    vertices_m: Sequence[Point]
    faces: Sequence[Sequence[int]]


class SurveyKeys(TypedDict, total=False):
    """How a room is surveyed, see `SurveySpec`."""

    spacing_m: float
    headings_deg: Sequence[float]
    readings: int
    height_m: float
    heading_error_deg: float
    position_error_m: float


class RobotKeys(TypedDict, total=False):
    """Parts of a robot: specs, or mappings of their fields to change."""

    footprint_radius_m: float
    drive: Mapping[str, Any] | Spec
    battery: Mapping[str, Any] | Spec
    platform: Mapping[str, Any] | Spec
    imu: Mapping[str, Any] | Spec
    lidar: Mapping[str, Any] | Spec
    mocap: Mapping[str, Any] | Spec
    plant: Mapping[str, Any] | Spec
    conversion: Mapping[str, Any]


class Room(Summarized):
    """A room to be: floor, walls, furniture, magnets and robots, added call by call.

    Each call returns a new room and leaves this one as it is. Every function that takes a `Scene` takes a
    `Room`: `open_twin`, `simulate`, `sweep`, `survey`, `author_scene`. It becomes a scene when first used
    (`scene`); without a map, its robot then surveys it.

    Lengths are metres, angles radians unless a name ends in `_deg`, magnetization is in A/m. x and y run
    along the floor, z points up. The origin is the middle of the floor, or the origin of its corners.
    """

    table: Mapping[str, Any]
    """The tables of its TOML."""

    def __init__(
        self,
        x_m: float | None = None,
        y_m: float | None = None,
        *,
        floor: Sequence[Point] | None = None,
        name: str = "room",
        seed: int = 0,
        **lab: Unpack[LabKeys],
    ) -> None:
        """Begin a room.

        Args:
            x_m: Size of the floor along x [m]. Default: 6.
            y_m: Size of the floor along y [m]. Default: 3.5.
            floor: Corners of a floor of another shape, in order: x and y of each [m].
            name: Name of the scene and of its root layer.
            seed: Seed of magnetizations that are not given, and of the survey's noise.
            **lab: Heights and thickness of the low walls around the floor, see `LabSpec` [m].

        Raises:
            InputError: A value has the wrong type or size.
        """
        check_name(str(name))
        given: dict[str, Any] = dict(lab)
        if floor is not None:
            given["floor"] = [plain(corner) for corner in floor]
            if x_m is not None or y_m is not None:
                raise InputError("floor has corners; leave out x_m and y_m", parameter="floor")
        else:
            given["floor_m"] = [6.0 if x_m is None else x_m, 3.5 if y_m is None else y_m]
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise InputError(f"seed must be a whole number from 0 up, got {seed!r}", parameter="seed")
        table = {"name": str(name), "seed": seed, "lab": plain(given), "earth": EARTH}
        self.__dict__["table"] = table
        self._lab()

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"a Room does not change; use a method that returns another, got {name!r}")

    def furniture(
        self,
        kind: str,
        at: Point,
        yaw: float = 0.0,
        *,
        material: str = "",
        size_m: Sequence[float] | None = None,
        file: File | None = None,
        scale: float = 1.0,
        vertices_m: Sequence[Point] | None = None,
        faces: Sequence[Sequence[int]] | None = None,
        **more: Unpack[PieceKeys],
    ) -> "Room":
        """Add a piece of furniture or of the building.

        Args:
            kind: desk, chair, cabinet, column, radiator, door_frame or shelf; or box, cylinder or mesh.
            at: Middle of its footprint: x, y [m], and the height of its underside [m] if that is not 0.
            yaw: Direction of its front, counter-clockwise from x [rad].
            material: Of a box, cylinder or mesh: steel, painted_steel, wood, concrete, brick and others.
            size_m: Depth, width and height of a box; diameter, diameter and height of a cylinder [m].
            file: File of a mesh: .stl, .obj, .ply, .dae, .glb or .gltf.
            scale: Factor on the coordinates of the file; 0.001 for a file in mm.
            vertices_m: Vertices of a mesh [m], shape (V, 3), instead of a file.
            faces: Corners of its triangles, counter-clockwise from outside, shape (F, 3).
            **more: `name` (default: the kind, with a number from the second on); `magnetization` of each
                steel part along its longest side [A/m], [] for none, default: drawn from the seed;
                `susceptibility` [1]; `seed` of the magnetization.

        Raises:
            InputError: A value has the wrong type or size, or the piece reaches beyond the floor's slab or
                stands in a wall.
        """
        values: dict[str, Any] = {"name": self._free("furniture", kind), **more, "kind": kind}
        values |= {"p_world": _place(at), "yaw": yaw, "material": material or None, "size_m": size_m}
        values |= {"file": None if file is None else existing(file, "mesh file"), "vertices_m": vertices_m}
        values |= {"faces": faces, "scale": None if scale == 1.0 else scale}
        what = f"{kind} {values['name']!r}"
        table = from_values(FurnitureTable, values, what)
        try:
            check_stands(table.spec(self.table["seed"]), self._lab())
        except InputError as error:
            far = "; lengths are in metres" if max(map(abs, table.p_world)) > FAR_M else ""
            text = str(error).replace(f"p_world of {table.name!r} is", "at is").replace("[lab]", "the Room")
            raise InputError(f"{what}: {text}{far}") from error
        return self._adding("furniture", values)

    def desk(self, at: Point, yaw: float = 0.0, **more: Unpack[PieceKeys]) -> "Room":
        """Add a desk of 0.7 x 1.4 m, 0.74 m high; arguments as for `furniture`."""
        return self.furniture("desk", at, yaw, **more)

    def chair(self, at: Point, yaw: float = 0.0, **more: Unpack[PieceKeys]) -> "Room":
        """Add a chair of 0.45 x 0.42 m; arguments as for `furniture`."""
        return self.furniture("chair", at, yaw, **more)

    def cabinet(self, at: Point, yaw: float = 0.0, **more: Unpack[PieceKeys]) -> "Room":
        """Add a steel cabinet of 0.47 x 0.9 m, 1.9 m high; arguments as for `furniture`."""
        return self.furniture("cabinet", at, yaw, **more)

    def shelf(self, at: Point, yaw: float = 0.0, **more: Unpack[PieceKeys]) -> "Room":
        """Add a steel shelf of 0.4 x 1 m, 2 m high; arguments as for `furniture`."""
        return self.furniture("shelf", at, yaw, **more)

    def radiator(self, at: Point, yaw: float = 0.0, **more: Unpack[PieceKeys]) -> "Room":
        """Add a radiator of 0.1 x 1 m; arguments as for `furniture`."""
        return self.furniture("radiator", at, yaw, **more)

    def column(self, at: Point, yaw: float = 0.0, **more: Unpack[PieceKeys]) -> "Room":
        """Add a steel column of the building, 0.25 m wide; arguments as for `furniture`."""
        return self.furniture("column", at, yaw, **more)

    def door_frame(self, at: Point, yaw: float = 0.0, **more: Unpack[PieceKeys]) -> "Room":
        """Add a steel door frame of 1.02 m that stands free; a wall has its doors by `door`."""
        return self.furniture("door_frame", at, yaw, **more)

    def box(
        self, at: Point, size_m: Sequence[float], material: str, yaw: float = 0.0, **more: Unpack[PieceKeys]
    ) -> "Room":
        """Add a box of depth, width and height [m]; arguments as for `furniture`."""
        return self.furniture("box", at, yaw, material=material, size_m=size_m, **more)

    def cylinder(
        self, at: Point, diameter_m: float, height_m: float, material: str, **more: Unpack[PieceKeys]
    ) -> "Room":
        """Add an upright cylinder; arguments as for `furniture`."""
        size = (diameter_m, diameter_m, height_m)
        return self.furniture("cylinder", at, material=material, size_m=size, **more)

    def mesh(
        self,
        file: File,
        at: Point,
        material: str,
        yaw: float = 0.0,
        *,
        scale: float = 1.0,
        **more: Unpack[PieceKeys],
    ) -> "Room":
        """Add a mesh from a file, standing on the floor; arguments as for `furniture`."""
        return self.furniture("mesh", at, yaw, file=file, material=material, scale=scale, **more)

    def magnet(self, at: Point, m_world: Point = (0.0, 0.0, 0.0), **more: Unpack[SourceKeys]) -> "Room":
        """Add a magnetised thing that nobody bumps into, a `[[source]]`: a point dipole, or a body.

        Args:
            at: Its centre, x, y and z in world [m].
            m_world: Moment of a point in world axes [A m2].
            **more: `shape` "cuboid", "cylinder", "sphere" or "mesh" with `size_m` [m] and `magnetization` in
                its own axes [A/m]; see `SourceSpec`.

        Raises:
            InputError: A value has the wrong type or size.
        """
        values: dict[str, Any] = {"name": self._free("source", "magnet"), **more, "p_world": _place(at)}
        moment = plain(m_world)
        if not isinstance(moment, list) or any(moment):
            values["m_world"] = m_world
        elif not {"magnetization", "susceptibility"} & set(more):
            raise InputError(
                "magnet: needs m_world, its moment [A m2]; or shape, size_m and magnetization [A/m]"
            )
        from_values(SourceSpec, values, f"magnet {values['name']!r}")
        return self._adding("source", values)

    def wall(self, start: Point, end: Point, material: str | None = None, **more: Unpack[WallKeys]) -> "Room":
        """Add a wall from one point to another, each x and y [m]; its `material` and more as for `Wall`.

        Raises:
            InputError: A value has the wrong type or size, or the wall crosses a door.
        """
        values = {"name": self._free("wall", "wall", first=0), **more, "from": start, "to": end}
        values |= {} if material is None else {"material": material}
        from_values(WallTable, values, f"wall {values['name']!r}")
        return self._adding("wall", values)

    def door(self, at_m: float, wall: str | None = None, **more: Unpack[DoorKeys]) -> "Room":
        """Add a door that is open, or opens, to a wall.

        Args:
            at_m: Middle of the door along its wall, from the wall's start [m].
            wall: Name of the wall, or "south", "east", "north", "west" for a side of the room ("edge_0" and
                so on of a floor with corners). Default: the wall that was added last.
            **more: `width_m`, `open_deg` and others, see `Door`.

        Raises:
            InputError: A value has the wrong type or size, or the door is not within its wall.
        """
        return self._opening("door", DoorTable, at_m, wall, more)

    def window(self, at_m: float, wall: str | None = None, **more: Unpack[WindowKeys]) -> "Room":
        """Add a window to a wall; `at_m` and `wall` as for `door`, and more as for `Window`."""
        return self._opening("window", Window, at_m, wall, more)

    def earth(
        self,
        latitude_deg: float,
        longitude_deg: float,
        height_m: float = 0.0,
        date: str = "2026-11-21",
        *,
        north_deg: float = 0.0,
        b_world_nt: Point | None = None,
    ) -> "Room":
        """Put the room elsewhere on Earth, or give the Earth's field there as it was measured.

        Args:
            latitude_deg: Geodetic latitude, north positive [deg].
            longitude_deg: Longitude, east positive [deg].
            height_m: Height above the WGS 84 ellipsoid [m].
            date: Day, YYYY-MM-DD, from 1900 to 2030.
            north_deg: Angle from the world's y to true north, counter-clockwise from above [deg].
            b_world_nt: Measured field in world axes [nT]. Default: that of the IGRF-14.
        """
        values = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg, "height_m": height_m}
        values |= {"date": date, "north_deg": north_deg, "b_world_nt": b_world_nt}  # type: ignore[dict-item]
        values |= {"measured": True} if b_world_nt is not None else {}
        from_values(EarthTable, values, "earth")
        return self._with(earth=plain(values))

    def survey(self, **survey: Unpack[SurveyKeys]) -> "Room":
        """Choose how the robot surveys the room, see `SurveySpec`; `magtwin.survey` gives the map."""
        from_values(SurveySpec, survey, "survey")
        return self._with(survey=plain(survey))

    def map(self, layer: "File | AnomalyMap") -> "Room":
        """Read a map in place of a survey: a map layer, or an `AnomalyMap`."""
        return self._with(map=str(_map_file(layer)))

    def robot(
        self,
        robot: "File | RobotSpec" = "turtlebot4",
        at: Point | None = None,
        yaw: float = 0.0,
        *,
        name: str = "",
        path: File = "",
        network: File | None = None,
        kind: str | None = None,
        magnetometer: str | Mapping[str, Any] | Spec | None = None,
        **parts: Unpack[RobotKeys],
    ) -> "Room":
        """Add a robot. The first one is the robot that `simulate` drives.

        Args:
            robot: Name of a robot that ships ("turtlebot4"), a URDF or xacro, a USD asset that
                `magtwin robot` made, or a `RobotSpec`.
            at: Start, x and y in world [m]. Default: the origin; of a further robot with a path, its begin.
            yaw: Heading at the start, counter-clockwise from x [rad].
            name: Name of its prim. Default: that of the robot, with a number from the second on.
            path: What it drives by default: the name of a path, or a CSV file.
            network: Weights that predict its disturbance.
            kind: What its magnetometer reads: "physical", "neural" or "map-only".
            magnetometer: Of a URDF, its link and place as "LINK:x,y,z" [m]; or fields of `MagnetometerSpec`
                to change, as a mapping or a spec.
            **parts: Other parts to change: drive, battery, platform, imu, lidar, mocap, plant.

        Raises:
            InputError: There is no such robot, or a value has the wrong type or size.
        """
        values: dict[str, Any] = {}
        if isinstance(robot, RobotSpec):
            values = table_of_robot(PlacedRobot(robot=robot))
            del values["start"]
        elif Path(robot).suffix.lower() in DESCRIPTIONS:
            values = {"urdf": existing(robot, "robot description"), "conversion": {"profile": "diff-drive"}}
        else:
            bare = Path(robot).suffix == "" and Path(robot).name == str(robot)
            asset_named(Path(robot), str(robot), "robot")
            values = {"asset": str(robot) if bare else existing(robot, "robot asset")}
        if isinstance(magnetometer, str):
            mount = mounted(magnetometer)
            magnetometer = {"link": mount.link, "p_link_sensor": mount.p_link_sensor}
        given = {"magnetometer": magnetometer, **parts}
        values |= {k: table_of(v) if is_dataclass(v) else v for k, v in given.items() if v is not None}
        known = {f.name for f in fields(RobotSettings)} | {"asset", "urdf"}
        for key in values:
            if key not in known:
                raise InputError(f"robot has no part {key!r}; {hint(key, known)}")
        stem = str(values.get("name") or Path(str(robot)).name.split(".")[0])
        values["name"] = name or self._free("robot", stem)
        values |= {"start": None if at is None else [*_place(at)[:2], yaw], "kind": kind}
        values |= {"path": str(Path(path).absolute()) if Path(path).suffix else str(path) or None}
        values |= {"network": None if network is None else existing(network, "weights file")}
        return self._adding("robot", values)

    @property  # not a cached one, which pyright does not take for `magtwin.twin.twin.HasScene`
    def scene(self) -> Scene:
        """The scene, surveyed by its robot unless the room has a map. It is made once."""
        if "_scene" not in self.__dict__:
            self.__dict__["_scene"] = importlib.import_module("magtwin").scene_from_toml(self)
        return self.__dict__["_scene"]  # type: ignore[no-any-return]

    def with_(self, changes: Mapping[str, Any] | None = None, **values: Any) -> Scene:
        """The room's scene with something changed, and the map as it was; see `Scene.with_`."""
        return self.scene.with_(changes, **values)

    def to_toml(self, out: File | None = None, *, force: bool = False) -> str:
        """The room as the text of a TOML for `scene_from_toml` and `magtwin scene`.

        Args:
            out: File to write it to as well.
            force: Whether to replace a file that exists.
        """
        return written(self.tables, out, force)

    @property
    def tables(self) -> dict[str, Any]:
        """Its tables as a TOML has them: a single robot without a name of its own is `[robot]`."""
        robots = self.table.get("robot", ())
        if not robots:
            raise InputError(f'room {self.table["name"]!r} has no robot; add one: .robot("turtlebot4")')
        first, alone = robots[0], len(robots) == 1
        alone = alone and ("urdf" in first or first["name"] == Path(first.get("asset", "")).stem)
        single = {key: value for key, value in robots[0].items() if key != "name"}
        order = sorted(self.table, key=lambda key: isinstance(self.table[key], dict | list))
        tables = {key: self.table[key] for key in order}
        return {**tables, "robot": single if alone else list(robots)}

    def plot(self) -> "Figure":
        """Draw the room from above; see `magtwin.plot`."""
        return importlib.import_module("magtwin").plot(self)  # type: ignore[no-any-return]

    def _summary(self) -> Summary:
        lab, table = self._lab(), self.table
        earth = table["earth"]
        rows = [
            ("furniture", listed([piece["name"] for piece in table.get("furniture", ())], 80)),
            ("walls", listed([wall["name"] for wall in table.get("wall", ())], 80)),
            ("robots", listed([robot["name"] for robot in table.get("robot", ())], 80) or "none yet"),
            ("earth", f"{earth['latitude_deg']:g}, {earth['longitude_deg']:g} deg, {earth['date']}"),
        ]
        return Summary(f"Room {table['name']}: floor {lab.size_text}", tuple(rows))

    def _lab(self) -> LabSpec:
        """The room without what stands in it, and with its walls."""
        table, where = self.table, f"room {self.table['name']!r}"
        lab = lab_of(from_values(LabSpec, table["lab"], where), table, where, None)
        parts: list[Any] = [
            [from_values(cls, each, f"{name} {each['name']!r}") for each in table.get(name, ())]
            for name, cls in (("wall", WallTable), ("door", DoorTable), ("window", Window))
        ]
        return lab_with_walls(lab, parts[0], parts[1], parts[2], where, seed=table["seed"])

    def _opening(
        self, section: str, cls: type, at_m: float, wall: str | None, more: Mapping[str, Any]
    ) -> "Room":
        if wall is None:
            walls = self.table.get("wall", ())
            if not walls:
                raise InputError(
                    f'{section}: the room has no wall yet; add one before, or name a side: wall="south"'
                )
            wall = walls[-1]["name"]
        values = {"name": self._free(section, section, first=0), **more, "wall": wall, "at_m": at_m}
        from_values(cls, values, f"{section} {values['name']!r}")
        return self._adding(section, values)

    def _check_standing(self, tables: Sequence[Mapping[str, Any]]) -> None:
        """Refuse walls that cannot stand, and pieces of furniture in them."""
        lab, seed = self._lab(), self.table["seed"]
        pieces = [from_values(FurnitureTable, each, each["name"]).spec(seed) for each in tables]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MismatchWarning)  # of a scene, and told when it is made
            where = f"room {self.table['name']!r}"
            check_not_in_walls(pieces, lab, obstacles_in(lab, pieces), where)

    def _free(self, section: str, stem: str, *, first: int = 1) -> str:
        """A name that no table of the section has: box, box_2; or wall_0, wall_1."""
        taken = {each["name"] for each in self.table.get(section, ())}
        names = (f"{stem}_{k}" if k != 1 or first == 0 else stem for k in range(first, len(taken) + 2))
        return next((name for name in names if name not in taken), stem)

    def _adding(self, section: str, values: Mapping[str, Any]) -> "Room":
        held = self.table.get(section, [])
        if any(each["name"] == values["name"] for each in held):
            raise InputError(
                f"two things of [[{section}]] are called {values['name']!r}; give each its own name"
            )
        room = self._with(**{section: [*held, plain(values)]})
        if section == "furniture":
            room._check_standing(room.table[section][-1:])
        elif section in ("wall", "door", "window"):
            room._check_standing(room.table.get("furniture", ()))
        return room

    def _with(self, **tables: Any) -> "Room":
        room = Room.__new__(Room)
        room.__dict__["table"] = {**self.table, **tables}
        return room


for _method in vars(Room).values():  # `help` lists the keys that a method takes
    for _taken in getattr(_method, "__annotations__", {}).values():
        _keys = getattr((getattr(_taken, "__args__", None) or [None])[0], "__annotations__", {})
        if _keys and getattr(_taken, "__origin__", None) is Unpack and _method.__doc__:
            _method.__doc__ = f"{inspect.cleandoc(_method.__doc__)}\n\nKeys: {', '.join(_keys)}.\n"


def changed(scene: Scene, changes: Mapping[str, Any]) -> Scene:
    """A scene with other values; see `Scene.with_`."""
    before = dict.fromkeys(scene.furniture)
    for way, value in changes.items():
        if way == "map_layer":
            file = _map_file(value)
            scene = replace(scene, map_layer=file, map_sha256=layer_sha256(file))
            continue
        scene = _set(scene, way.split("."), value, way)
    check_things(scene)
    for piece in scene.furniture:
        if piece not in before:
            check_stands(piece, scene.lab)
    return scene


def _set(spec: Any, way: Sequence[str], value: Any, whole: str) -> Any:
    """A spec, or a tuple of named specs, with another value at the end of a way of names."""
    name, *rest = way
    if isinstance(spec, tuple):
        named = [str(getattr(each, "name", "") or each.robot.name) for each in spec]
        chosen = [fnmatch.fnmatchcase(each, name) for each in named]
        if not any(chosen):
            near = hint(name, named) if named else "there is none"
            raise InputError(f"{whole}: there is no {name!r}; {near}")
        if not rest and value is not None:
            way = f"a field, as in {whole}.p_world, or be None to remove it"
            raise InputError(f"{whole} must be followed by {way}")
        each_chosen = zip(spec, chosen, strict=True)
        if not rest:
            return tuple(each for each, this in each_chosen if not this)
        return tuple(_set(each, rest, value, whole) if this else each for each, this in each_chosen)
    if not is_dataclass(spec) or isinstance(spec, type):
        raise InputError(f"{whole}: there is nothing below {spec!r}")
    if name == "yaw" and hasattr(spec, "q_world_xyzw"):
        name, value = "q_world_xyzw", tuple(quat_from_yaw(float(value)).tolist())
    known = [f.name for f in fields(spec)]
    if name not in known:
        raise InputError(f"{whole}: {type(spec).__name__} has no field {name!r}; {hint(name, known)}")
    new = _set(getattr(spec, name), rest, value, whole) if rest else value
    try:
        if isinstance(spec, RobotSpec) and isinstance(new, Spec):
            return spec.with_part(name, new)
        return replace(spec, **{name: new})
    except InputError as error:
        start = "" if whole == name or whole in str(error) else f"{whole}: "
        raise InputError(f"{start}{error}") from error


def written(tables: Mapping[str, Any], out: File | None, force: bool) -> str:
    """Tables as the text of a TOML, which is also written to a file if one is given.

    A map in a temporary folder is then copied beside it.
    """
    if out is None:
        return toml_text(tables)
    layer = Path(str(tables.get("map", "")))
    with transaction():
        if layer.parent.name.startswith(WORKSHOP):
            copy = Path(out).with_suffix(".map.usdc")
            with output(copy, force=force) as aside:
                aside.write_bytes(layer.read_bytes())
            tables = {**tables, "map": copy.name}
        text = toml_text(tables)
        with output(out, force=force) as aside:
            aside.write_text(text, encoding="utf-8")
    return text


def _map_file(layer: Any) -> Path:
    """The file of a map; one that is in memory is written to a temporary folder."""
    if not hasattr(layer, "values_nt"):
        return existing(layer, "map layer").resolve()
    folder = Path(importlib.import_module("magtwin.twin.authoring").new_workshop())
    layer.save(folder / "map.usdc")
    return folder / "map.usdc"


def _place(at: Point) -> list[float]:
    """x, y and z of a place whose z may be left out."""
    place = plain(at)
    if isinstance(place, list) and len(place) == 2:
        place = [*place, 0.0]
    if not isinstance(place, list) or len(place) != 3:
        raise InputError(f"at must be x and y, or x, y and z [m], got {at!r}", parameter="at")
    return place
