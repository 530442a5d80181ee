"""Furniture of a scene's TOML: its table, its default magnetization, and whether it stands on the slab."""

import hashlib
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from magtwin.errors import InputError
from magtwin.field.sources.moments import mesh_moments
from magtwin.files.file import existing
from magtwin.files.settings import refused_at
from magtwin.frames import IDENTITY_XYZW, quat_from_yaw, rotate
from magtwin.spec.base import ZERO3, Quat, Spec, Vec3
from magtwin.spec.furniture import BODY, FurnitureSpec, Part
from magtwin.spec.lab import LabSpec
from magtwin.urdf.meshes.mesh import read_mesh
from magtwin.usd.attributes import check_prim_name

LARGEST_M = 1000.0
"""A larger room or piece of furniture is probably in mm [m]."""

SATURATION_A_M = 2.2e6
"""Magnetization that no material exceeds [A/m]; iron saturates at 1.7e6."""

DRAWN_A_M = (500.0, 5000.0)
"""Range of the default magnetization of a steel part [A/m]: usual for desks, chairs and cabinets."""

HUGE_M = 30.0
"""Size of a mesh above which it is likely to be in millimetres [m]."""

REINFORCED = 0.01
"""Fraction of reinforced concrete that is steel, some 80 kg/m3."""

WALL_M = 0.002
"""Thickness of the steel of a box, cylinder or mesh, since most are hollow [m]."""


@dataclass(frozen=True, kw_only=True)
class FurnitureTable(Spec):
    """A piece of furniture or of the building; see the kinds above."""

    name: str
    """Name of the piece, used once: letters, digits and _, not starting with a digit."""

    kind: str
    """desk, chair, cabinet, column, radiator, door_frame or shelf; or box, cylinder or mesh."""

    p_world: Vec3
    """Middle of the footprint, and height of the underside above the floor [m]."""

    yaw: float = 0.0
    """Direction of the front, counter-clockwise from the world's x [rad]."""

    q_world_xyzw: Quat = IDENTITY_XYZW
    """Orientation as a quaternion, instead of yaw."""

    magnetization: tuple[float, ...] | None = None
    """Magnetization of each steel part along its longest side [A/m]. Default: drawn from the seed, 500 to
    5000 A/m of either sign, less for wide hollow sections. [] means none."""

    susceptibility: float = 0.0
    """Volume susceptibility of the steel [1]. Above 0, the Earth's field magnetises it too."""

    material: str = ""
    """Material of a box, cylinder or mesh, see the materials above. Only those with steel are magnetised."""

    size_m: Vec3 = ZERO3
    """Depth, width and height of a box; diameter, diameter and height of a cylinder [m]."""

    file: Path | None = None
    """File of a mesh: .stl, .obj, .ply, .dae, .glb or .gltf. The mesh is put on the floor, the middle of its
    footprint at p_world. A steel mesh must be closed."""

    scale: float = 1.0
    """Factor on the coordinates of a mesh file; 0.001 for a file in mm."""

    vertices_m: tuple[Vec3, ...] = ()
    """Vertices of a mesh [m], instead of a file."""

    faces: tuple[tuple[int, int, int], ...] = ()
    """Corners of the triangles of these vertices, counter-clockwise from outside."""

    seed: int | None = None
    """Seed of the magnetization. Default: the scene's."""

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
        per_metre = "be in A/m; iron saturates at 1.7e6"
        self._require("magnetization", strong <= SATURATION_A_M, per_metre, self.magnetization)
        if self.kind == "mesh" and (self.file is None) != bool(self.vertices_m):
            raise InputError('kind "mesh" needs file = "FILE.stl", or vertices_m and faces')
        if self.kind != "mesh" and (self.file is not None or self.scale != 1):
            raise InputError(f'file and scale are for kind "mesh", not for a {self.kind}')
        object.__setattr__(self, "_piece", self._made())

    def _made(self) -> FurnitureSpec:
        """The piece, with the magnetization of the table or none."""
        given = {f.name: getattr(self, f.name) for f in fields(FurnitureSpec) if hasattr(self, f.name)}
        given["magnetization"] = self.magnetization or ()
        if self.yaw:
            given["q_world_xyzw"] = tuple(map(float, quat_from_yaw(self.yaw)))
        if self.file is not None:
            mesh = read_mesh(existing(self.file, "mesh file"))
            points, faces = mesh.points.astype(float) * self.scale, mesh.faces
            if mesh_moments(points, faces)[0] < 0:
                faces = faces[:, ::-1]  # outwards
            largest = float(np.ptp(points, axis=0).max())
            if largest > LARGEST_M:
                text = f"{self.file.name} would be {largest:,.0f} m large; if it is in mm, give scale = 0.001"
                raise InputError(f"scale is missing: {text}")
            given["vertices_m"] = tuple(map(tuple, points.tolist()))
            given["faces"] = tuple(map(tuple, faces.tolist()))
        return FurnitureSpec(**given)

    def spec(self, seed: int) -> FurnitureSpec:
        """The piece, with the magnetization of the table or the default drawn from the scene's seed."""
        piece: FurnitureSpec = self._piece  # type: ignore[attr-defined]
        if self.magnetization is not None:
            return piece
        drawn = drawn_magnetization(self.name, piece.parts, seed=seed if self.seed is None else self.seed)
        return replace(piece, magnetization=drawn)


def drawn_magnetization(name: str, parts: Iterable[Part], *, seed: int = 0) -> tuple[float, ...]:
    """Default magnetization of a piece's steel parts, each along its longest side.

    Uniform in `DRAWN_A_M` with a random sign, times the fraction of steel, rounded to 1 A/m. It depends on
    seed and name alone, so adding, removing or moving another piece changes nothing.

    Args:
        name: Name of the piece.
        parts: Its parts.
        seed: Seed of the scene.

    Returns:
        One number for each steel part, in order [A/m].
    """
    words = np.frombuffer(hashlib.sha256(name.encode()).digest(), "<u4").tolist()
    rng = np.random.default_rng([seed, *words])
    drawn = list[float]()
    for part in parts:
        if part.steel:
            size = rng.uniform(*DRAWN_A_M) * rng.choice((-1.0, 1.0)) * _steel_fraction(part)
            drawn.append(float(np.copysign(max(round(abs(size)), 1), size)))
    return tuple(drawn)


def _steel_fraction(part: Part) -> float:
    """Fraction of a part's volume that is steel; a generic part is a shell of `WALL_M`."""
    if part.look == "ReinforcedConcrete":
        return REINFORCED
    if part.name != BODY:
        return part.fill
    if not part.faces:
        inner = [max(side - 2 * WALL_M, 0.0) / side for side in part.size_m]
        return 1 - inner[0] * inner[1] * inner[2]
    corner = np.array(part.vertices_m)[np.array(part.faces)]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    volume = abs(float(np.einsum("fi,fi->", corner[:, 0], across)) / 6)
    shell = WALL_M * float(np.linalg.norm(across, axis=1).sum()) / 2
    return min(1.0, shell / volume) if volume else 1.0


def check_stands(piece: FurnitureSpec, lab: LabSpec) -> None:
    """Refuse a piece of furniture that does not stand on the slab.

    Raises:
        InputError: It does not; the text has the size of the slab.
    """
    signs = np.array(np.meshgrid((-1, 1), (-1, 1), (-1, 1))).reshape(3, -1).T
    corners = np.concatenate([np.array(p.p) + signs * np.array(p.size_m) / 2 for p in piece.parts])
    world = rotate(piece.q_world_xyzw, corners) + piece.p_world
    edge = lab.wall_thickness_m + lab.apron_m
    beyond = -float(lab.inside_m(world[:, :2]).min()) - edge
    if beyond > 1e-6:
        size, hint = np.ptp(world, axis=0), ""
        x, y = (side + 2 * edge for side in lab.floor_m)
        floor, slab = "floor_m", f"{x:g} x {y:g} m about the origin"
        if lab.floor:
            floor, slab = "floor", f"the floor of {lab.size_text}, and {edge:g} m around it"
        if any(part.faces for part in piece.parts) and size.max() > HUGE_M:
            hint = f"; it is {size[0]:.3g} x {size[1]:.3g} m: is its file in mm? then scale = 0.001"
        raise InputError(
            f"p_world of {piece.name!r} is ({piece.p_world[0]:g}, {piece.p_world[1]:g}): it reaches "
            f"{beyond:.2f} m beyond the slab, which is {slab}; move it, or enlarge {floor} or apron_m of "
            f"[lab]{hint}"
        )


def placed_furniture(
    tables: Sequence[FurnitureTable], lab: LabSpec | None, path: str | os.PathLike[str], *, seed: int
) -> tuple[FurnitureSpec, ...]:
    """The pieces of [[furniture]] tables, with their magnetization.

    Args:
        tables: The tables, in order.
        lab: Room whose slab they must stand on. None skips the check.
        path: The file of the tables, for error messages.
        seed: Seed of the scene.

    Raises:
        InputError: Two pieces have one name, or one does not stand on the slab; the text has the line.
    """
    pieces = list[FurnitureSpec]()
    for number, table in enumerate(tables):
        if any(piece.name == table.name for piece in pieces):
            text = f"two pieces of furniture are called {table.name!r}; give each its own name"
            raise refused_at(path, "name", text, section="furniture", number=number)
        pieces.append(table.spec(seed))
        try:
            if lab is not None:
                check_stands(pieces[-1], lab)
        except InputError as error:
            raise refused_at(path, "p_world", str(error), section="furniture", number=number) from error
    return tuple(pieces)
