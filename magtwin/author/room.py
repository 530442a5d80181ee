"""Room: the furniture of a scene's TOML, and whether everything in the room fits together."""

import math
import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd

from magtwin.errors import InputError
from magtwin.field.sources.bodies import mesh_moments
from magtwin.files import existing, refused_at, shipped
from magtwin.frames import IDENTITY_XYZW, quat_from_yaw, rotate
from magtwin.spec.base import ZERO3, Quat, Spec, Vec3
from magtwin.spec.furniture import FurnitureSpec, drawn_magnetization
from magtwin.spec.lab import LabSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import PlacedRobot
from magtwin.urdf.meshes.mesh import read_mesh
from magtwin.usd.attributes import check_prim_name
from magtwin.usd.furniture import FURNITURE, define_furniture
from magtwin.usd.lab import define_lab
from magtwin.usd.maps import load_map
from magtwin.usd.obstacles import read_obstacles

LARGEST_M = 1000.0
"""A room or a piece of furniture that is larger is taken for one in mm [m]."""

SATURATION_A_M = 2.2e6
"""Magnetization that no material exceeds [A/m]; iron saturates at 1.7e6."""


@dataclass(frozen=True, kw_only=True)
class FurnitureTable(Spec):
    """A piece of furniture or of the building; see the kinds above."""

    name: str
    """Name of the piece, each its own: letters, digits and _, no digit first."""

    kind: str
    """desk, chair, cabinet, column, radiator, door_frame or shelf; or box, cylinder or mesh."""

    p_world: Vec3
    """Middle of its footprint, and height of its underside above the floor [m]."""

    yaw: float = 0.0
    """Direction of its front from the world's x, counter-clockwise from above [rad]."""

    q_world_xyzw: Quat = IDENTITY_XYZW
    """Its orientation as a quaternion, in place of yaw."""

    magnetization: tuple[float, ...] | None = None
    """Magnetization of each steel part along its longest side [A/m]; by default drawn from the seed, 500 to
    5000 A/m of either sign, less for wide hollow sections. [] for none."""

    susceptibility: float = 0.0
    """Volume susceptibility of its steel [1]: above 0, the Earth's field magnetises it too."""

    material: str = ""
    """Of a box, cylinder or mesh: steel, painted_steel, wood, concrete, brick, plastic or aluminium. Only the
    steels make a field."""

    size_m: Vec3 = ZERO3
    """Size of a box along its front, its width and its height; diameter, diameter and height of a cylinder
    [m]."""

    file: Path | None = None
    """Mesh file of a mesh: .stl, .obj, .ply, .dae, .glb or .gltf. It is put on the floor, the middle of its
    footprint at p_world. A steel one must be closed."""

    scale: float = 1.0
    """Factor on the coordinates of a mesh file; 0.001 for one in mm."""

    seed: int | None = None
    """Seed of this piece's magnetization; by default the scene's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_prim_name(self.name, "furniture")
        self._above_zero("scale")
        degrees = f"be in radians, at most 2 pi; {self.yaw:g} deg are {math.radians(self.yaw):.4f} rad"
        self._require("yaw", abs(self.yaw) <= 2 * math.pi + 1e-6, degrees, self.yaw)
        both = self.yaw != 0 and self.q_world_xyzw != IDENTITY_XYZW
        self._require("yaw", not both, "be left out beside q_world_xyzw", self.yaw)
        self._require("seed", self.seed is None or self.seed >= 0, "not be below 0", self.seed)
        strong = max(map(abs, self.magnetization or ()), default=0.0)
        self._require(
            "magnetization",
            strong <= SATURATION_A_M,
            "be in A/m; iron saturates at 1.7e6",
            self.magnetization,
        )
        if self.kind == "mesh" and self.file is None:
            raise InputError('kind "mesh" needs file = "FILE.stl"')
        if self.kind != "mesh" and (self.file is not None or self.scale != 1):
            raise InputError(f'file and scale are for kind "mesh", not for a {self.kind}')
        object.__setattr__(self, "_piece", self._made())

    def _made(self) -> FurnitureSpec:
        """The piece, not magnetised unless it says so."""
        given = {
            f.name: getattr(self, f.name)
            for f in fields(FurnitureSpec)
            if hasattr(self, f.name) and f.name != "magnetization"
        }
        given["magnetization"] = self.magnetization or ()
        if self.yaw:
            given["q_world_xyzw"] = tuple(map(float, quat_from_yaw(self.yaw)))
        if self.file is not None:
            points, faces = _mesh_of(self.file, self.scale)
            largest = float(np.ptp(points, axis=0).max())
            if largest > LARGEST_M:
                raise InputError(
                    f"scale is missing: {self.file.name} would be {largest:,.0f} m large; if it is in mm, "
                    "give scale = 0.001"
                )
            given |= {
                "vertices_m": tuple(map(tuple, points.tolist())),
                "faces": tuple(map(tuple, faces.tolist())),
            }
        return FurnitureSpec(**given)

    def spec(self, seed: int) -> FurnitureSpec:
        """The piece, magnetised as the table says or as the scene's seed draws."""
        piece: FurnitureSpec = self._piece  # type: ignore[attr-defined]
        if self.magnetization is not None:
            return piece
        drawn = drawn_magnetization(self.name, piece.parts, seed=seed if self.seed is None else self.seed)
        return replace(piece, magnetization=drawn)


def _mesh_of(file: Path, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [m] and triangles of a mesh file, facing outwards."""
    mesh = read_mesh(existing(file, "mesh file"))
    points, faces = mesh.points.astype(float) * scale, mesh.faces
    return points, faces[:, ::-1] if mesh_moments(points, faces)[0] < 0 else faces


def obstacles_in(lab: LabSpec, furniture: Sequence[FurnitureSpec]) -> Obstacles:
    """What stands in a room that is not authored yet, as a robot meets it."""
    stage = Usd.Stage.CreateInMemory()
    define_lab(stage, lab)
    if furniture:
        define_furniture(stage, tuple(furniture))
    return read_obstacles(stage)


def check_stands(piece: FurnitureSpec, lab: LabSpec) -> None:
    """Refuse a piece of furniture that stands beside the slab.

    Raises:
        InputError: It does; the text says how large the slab is and what to change.
    """
    corners = np.concatenate([_corners(part.p, part.size_m) for part in piece.parts])
    world = rotate(piece.q_world_xyzw, corners) + piece.p_world
    half = np.array(lab.floor_m) / 2 + lab.wall_thickness_m + lab.apron_m
    beyond = float(np.max(np.abs(world[:, :2]) - half))
    if beyond > 1e-6:
        x, y = piece.p_world[:2]
        raise InputError(
            f"p_world of {piece.name!r} is ({x:g}, {y:g}): it reaches {beyond:.2f} m beyond the slab, "
            f"which is {2 * half[0]:g} x {2 * half[1]:g} m about the origin; move it, or enlarge floor_m or "
            "apron_m of [lab]"
        )


def _corners(middle: Vec3, size: Vec3) -> Any:
    signs = np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, -1).T
    return np.asarray(middle) + signs * np.asarray(size) / 2


def check_start(placed: PlacedRobot, lab: LabSpec, obstacles: Obstacles) -> None:
    """Refuse a robot that starts off the floor or in a piece of furniture.

    Raises:
        InputError: It does; the text gives the nearest free place.
    """
    x, y, yaw = placed.start
    radius = placed.robot.footprint_radius_m
    if abs(yaw) > 2 * math.pi + 1e-6:
        raise InputError(
            f"start's yaw must be in radians, at most 2 pi; {yaw:g} deg are {math.radians(yaw):.4f} rad"
        )
    inside = [k for k, name in enumerate(obstacles.names) if name.startswith(str(FURNITURE))]
    standing = Obstacles(
        tuple(obstacles.names[k] for k in inside), tuple(obstacles.outlines[k] for k in inside)
    )
    distance, which = standing.clearance([[x, y]], reach_m=radius)
    half = np.array(lab.floor_m) / 2
    if distance[0] < radius:
        piece = standing.names[which[0]].split("/")[-2]
        what = f"in {piece!r}"
    elif np.any(np.abs((x, y)) > half):
        what = f"off the floor of {lab.floor_m[0]:g} x {lab.floor_m[1]:g} m"
    else:
        return
    free = _nearest_free(x, y, half - radius, standing, radius)
    hint = f"start = [{free[0]:.2f}, {free[1]:.2f}, 0.0] is free" if free else "nowhere on it is room"
    raise InputError(f"start ({x:g}, {y:g}) of robot {placed.robot.name!r} is {what}; {hint}")


def _nearest_free(
    x: float, y: float, reach: np.ndarray, standing: Obstacles, radius: float
) -> tuple[float, float] | None:
    """The free place nearest to a point, on a raster of 5 cm or so."""
    if min(reach) <= 0:
        return None
    axes = [np.linspace(-r, r, min(400, max(3, int(r / 0.025)))) for r in reach]
    at = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    distance, _ = standing.clearance(at, reach_m=radius + 0.05)
    free = at[distance >= radius + 0.05]
    if not len(free):
        return None
    nearest = free[np.argmin(np.hypot(free[:, 0] - x, free[:, 1] - y))]
    return float(nearest[0]), float(nearest[1])


def lab_of(
    lab: LabSpec, table: Mapping[str, Any], path: str | os.PathLike[str], map_layer: Path | None
) -> LabSpec:
    """The room of a TOML; its floor is as large as the map where the TOML gives no size.

    Args:
        lab: What [lab] says.
        table: The whole TOML.
        path: The file, for refusals.
        map_layer: The map that it names; None where it names none.

    Raises:
        InputError: The floor cannot be in metres.
    """
    if map_layer is not None and "floor_m" not in table.get("lab", {}):
        x0, x1, y0, y1 = load_map(map_layer).extent
        floor = 2 * max(abs(x0), abs(x1)), 2 * max(abs(y0), abs(y1))
        lab = replace(lab, floor_m=(round(floor[0], 6), round(floor[1], 6)))
    if max(lab.floor_m) > LARGEST_M:
        text = f"floor_m must be in metres, at most {LARGEST_M:g} each way, got {lab.floor_m}"
        raise refused_at(path, "floor_m", text, section="lab")
    return lab


def placed_furniture(
    tables: Sequence[FurnitureTable], lab: LabSpec | None, path: str | os.PathLike[str], *, seed: int
) -> tuple[FurnitureSpec, ...]:
    """The pieces of [[furniture]] tables, each magnetised.

    Args:
        tables: The tables, in order.
        lab: Room whose slab they must stand on; None does not check.
        path: The file that holds them, for refusals.
        seed: Seed of the scene.

    Raises:
        InputError: A piece stands beside the slab; with its line.
    """
    pieces = []
    for number, table in enumerate(tables):
        pieces.append(table.spec(seed))
        try:
            if lab is not None:
                check_stands(pieces[-1], lab)
        except InputError as error:
            raise refused_at(path, "p_world", str(error), section="furniture", number=number) from error
    return tuple(pieces)


def no_map(path: str | os.PathLike[str], *, furnished: bool) -> InputError:
    """The refusal of a scene without a map that cannot be surveyed either."""
    more = "" if furnished else " and furniture or sources ([[furniture]], [[source]])"
    return InputError(
        f'{path}: names no map; add map = "FILE.usdc" to it, or give --map FILE.usdc, or add an [earth] '
        f"table (latitude_deg, longitude_deg, height_m, date){more}, from which it is surveyed"
    )


def asset_named(file: Path, text: str, where: str) -> Path:
    """The USD file of a robot that is named by its file, or by the name of one that ships.

    Args:
        file: What `text` names, taken from the TOML's folder.
        text: What the TOML says.
        where: Where it says so, for refusals.

    Raises:
        InputError: It is neither; the text lists the robots that ship.
    """
    if file.is_file() or Path(text).suffix or Path(text).name != text:
        return file
    folders = sorted(shipped("robots").iterdir())
    known = {f.name: f / f"{f.name}.usda" for f in folders if (f / f"{f.name}.usda").is_file()}
    if text in known:
        return known[text]
    raise InputError(
        f"{where} asset: no robot {text!r}; known: {', '.join(known)}; or give the name of a USD file"
    )


def check_name(name: str) -> None:
    """Refuse a scene's name that a file cannot have on every system, or that USD reads as something else.

    Raises:
        InputError: It is such a name.
    """
    wrong = re.search(r'[\x00-\x1f\x7f/\\:*?"<>|\[\]@]', name)
    if wrong or not name.strip() or name[0] in ". -" or name[-1] in ". " or len(name.encode()) > 200:
        raise InputError(
            f"scene {name!r} cannot name a file; use letters, digits, - and _, up to 200 bytes, and none of "
            '/ \\ : * ? " < > | [ ] @'
        )


def check_names(pieces: Iterable[FurnitureSpec], path: str | os.PathLike[str]) -> None:
    """Refuse two pieces of furniture of one name, before one is drawn over the other.

    Raises:
        InputError: Two have one name.
    """
    seen = set()
    for piece in pieces:
        if piece.name in seen:
            raise InputError(
                f"{path}: two pieces of furniture are called {piece.name!r}; give each its own name"
            )
        seen.add(piece.name)
