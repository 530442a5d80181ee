"""Furniture and parts of a building: the parts of each kind, and their steel."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from magtwin.errors import InputError, find
from magtwin.frames import IDENTITY_XYZW, rotate
from magtwin.spec.base import ZERO3, Quat, Spec, Vec3
from magtwin.spec.magnetics import SourceSpec

Face = tuple[int, int, int]


@dataclass(frozen=True)
class Part:
    """A box, an upright cylinder or a mesh, in the axes of its piece.

    x is the front of the piece, z is up, the origin is the middle of its footprint. Hollow sections and bent
    sheets count as solid, so a magnetization is the mean over the whole section.
    """

    name: str
    p: Vec3
    """Centre [m]."""

    size_m: Vec3
    """Sides of a box; diameter, diameter and height of a cylinder [m]."""

    look: str
    """Material, a name of `magtwin.usd.lab.looks`."""

    shape: str = "cuboid"
    """"cuboid", "cylinder" or "mesh"."""

    fill: float = 1.0
    """Fraction of the volume that is steel; it scales a magnetization that is drawn. Computed for a generic
    part."""

    vertices_m: tuple[Vec3, ...] = ()
    """Vertices of a mesh about its centre [m], in single precision."""

    faces: tuple[Face, ...] = ()
    """Corners of a mesh's triangles, counter-clockwise from outside."""

    @property
    def steel(self) -> bool:
        """Whether the part can be magnetised."""
        return self.look in STEEL

    @property
    def along(self) -> int:
        """Index of the longest side, along which the steel is magnetised: there it demagnetises least."""
        return self.size_m.index(max(self.size_m))


STEEL = ("Steel", "PaintedSteel", "Door", "Chrome", "Enamel", "ReinforcedConcrete")
"""Looks of parts that can be magnetised."""

MATERIALS: Mapping[str, str] = MappingProxyType(
    {
        "steel": "Steel",
        "painted_steel": "PaintedSteel",
        "wood": "Wood",
        "concrete": "Concrete",
        "reinforced_concrete": "ReinforcedConcrete",
        "brick": "Brick",
        "plasterboard": "Plasterboard",
        "plywood": "Wall",
        "glass": "Glass",
        "plastic": "Plastic",
        "aluminium": "Aluminium",
    }
)
"""Look of each material of a wall, box, cylinder or mesh. Only those with steel are magnetised."""

GENERIC = ("box", "cylinder", "mesh")
"""Kinds of one part, with a material and a size."""

BODY = "body"
"""Name of that part."""


def _desk() -> Iterator[Part]:
    """A desk of 1.4 x 0.7 m, 0.74 m high: a board on four square tubes, with a rail before and behind."""
    deep, wide, high, board, tube = 0.7, 1.4, 0.74, 0.028, 0.04
    yield Part("top", (0, 0, high - board / 2), (deep, wide, board), "Wood")
    x, y, leg = deep / 2 - 0.06, wide / 2 - 0.06, high - board
    for k, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        yield Part(f"leg_{k}", (sx * x, sy * y, leg / 2), (tube, tube, leg), "PaintedSteel")
    for k, sx in enumerate((1, -1)):
        yield Part(f"rail_{k}", (sx * x, 0, leg - tube / 2), (0.03, 2 * y - tube, tube), "PaintedSteel")


def _chair() -> Iterator[Part]:
    """A chair, its seat 0.46 m high, on four tubes of which two rise to carry the back."""
    wide, seat, back, tube = 0.42, 0.46, 0.86, 0.025
    yield Part("seat", (0, 0, seat - 0.0125), (wide, wide, 0.025), "Wood")
    arm = wide / 2 - tube
    for k, sy in enumerate((1, -1)):
        high = seat - 0.025
        yield Part(f"front_{k}", (arm, sy * arm, high / 2), (tube, tube, high), "Chrome", "cylinder")
    for k, sy in enumerate((1, -1)):
        at = (-wide / 2 - tube / 2, sy * arm, back / 2)
        yield Part(f"rear_{k}", at, (tube, tube, back), "Chrome", "cylinder")
    yield Part("rest", (-wide / 2 + 0.01, 0, back - 0.14), (0.02, 2 * arm + tube, 0.22), "Wood")


def _cabinet() -> Iterator[Part]:
    """A cabinet of steel sheet, 0.9 x 0.45 m and 1.9 m high, with two doors."""
    deep, wide, high, sheet, foot = 0.45, 0.9, 1.9, 0.0015, 0.06
    tall, middle = high - foot, (high + foot) / 2
    for name, sy in (("left", 1), ("right", -1)):
        yield Part(name, (0, sy * (wide - sheet) / 2, middle), (deep, sheet, tall), "PaintedSteel")
    inner = wide - 2 * sheet
    yield Part("back", (-(deep - sheet) / 2, 0, middle), (sheet, inner, tall), "PaintedSteel")
    for name, z in (("top", high - sheet / 2), ("bottom", foot + sheet / 2)):
        yield Part(name, (0, 0, z), (deep - 2 * sheet, inner, sheet), "PaintedSteel")
    door = (inner - 0.012) / 2
    for k, sy in enumerate((1, -1)):
        at = ((deep - sheet) / 2, sy * (door / 2 + 0.004), middle)
        yield Part(f"door_{k}", at, (sheet, door, tall - 0.02), "Door")
    for k, sy in enumerate((1, -1)):
        yield Part(f"handle_{k}", (deep / 2 + 0.012, sy * 0.045, 1.05), (0.024, 0.016, 0.16), "Plastic")
    yield Part("plinth", (-0.02, 0, foot / 2), (deep - 0.08, wide - 0.06, foot), "Plastic")


def _column() -> Iterator[Part]:
    """A column of the building, 3 m of square tube, 0.25 m wide, on a foot plate."""
    wide, high, plate = 0.25, 3.0, 0.025
    yield Part("shaft", (0, 0, (high + plate) / 2), (wide, wide, high - plate), "Steel", fill=0.4)
    yield Part("plate", (0, 0, plate / 2), (0.4, 0.4, plate), "Concrete")


def _radiator() -> Iterator[Part]:
    """A panel radiator, 1 m wide and 0.6 m high, 0.12 m above the floor: two panels, two pipes below."""
    deep, wide, high, low, panel = 0.1, 1.0, 0.6, 0.12, 0.016
    for name, side in (("front", 1), ("rear", -1)):
        yield Part(
            name, (side * (deep - panel) / 2, 0, low + high / 2), (panel, wide, high), "Enamel", fill=0.4
        )
    inner = deep - 2 * panel
    yield Part("grille", (0, 0, low + high - 0.004), (inner, wide, 0.008), "Enamel", fill=0.1)
    for k, side in enumerate((1, -1)):
        at = (0, side * (wide / 2 - 0.05), (low + 0.06) / 2)
        yield Part(f"pipe_{k}", at, (0.018, 0.018, low + 0.06), "Chrome", "cylinder")


def _door_frame() -> Iterator[Part]:
    """A door's frame of 1.5 mm sheet about an opening of 0.9 x 2.02 m, which one drives through along x."""
    deep, face, wide, high = 0.12, 0.06, 0.9, 2.02
    for name, side in (("left", 1), ("right", -1)):
        at = (0, side * (wide + face) / 2, high / 2)
        yield Part(name, at, (deep, face, high), "PaintedSteel", fill=0.3)
    yield Part("head", (0, 0, high + face / 2), (deep, wide + 2 * face, face), "PaintedSteel", fill=0.3)


def _shelf() -> Iterator[Part]:
    """A shelf of 1 x 0.4 m and 2 m high: five folded steel boards between four angles."""
    deep, wide, high, angle, board = 0.4, 1.0, 2.0, 0.035, 0.03
    for k, (sx, sy) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
        at = (sx * (deep - angle) / 2, sy * (wide - angle) / 2, high / 2)
        yield Part(f"upright_{k}", at, (angle, angle, high), "PaintedSteel")
    inner = wide - 2 * angle
    for k, z in enumerate((0.1, 0.565, 1.03, 1.495, 1.96)):
        yield Part(f"board_{k}", (0, 0, z), (deep, inner, board), "Door", fill=0.2)


_MAKERS: tuple[Callable[[], Iterator[Part]], ...]
_MAKERS = _desk, _chair, _cabinet, _column, _radiator, _door_frame, _shelf
KINDS = MappingProxyType({make.__name__.removeprefix("_"): make for make in _MAKERS})
"""Functions that make the parts of each kind, without the generic ones."""


def parts_of(
    kind: str,
    *,
    material: str = "",
    size_m: Vec3 = (0.0, 0.0, 0.0),
    vertices_m: tuple[Vec3, ...] = (),
    faces: tuple[Face, ...] = (),
) -> tuple[Part, ...]:
    """The parts of a kind of furniture, in order.

    Args:
        kind: A name of `KINDS` or `GENERIC`.
        material: Material of a generic piece, a name of `MATERIALS`.
        size_m: Sides of the bounding box of a box or cylinder [m].
        vertices_m: Vertices of a mesh [m].
        faces: Corners of its triangles.
    """
    if kind not in GENERIC:
        make = find("furniture", kind, {**KINDS, **dict.fromkeys(GENERIC)})
        for name, value in (("material", material), ("size_m", any(size_m)), ("faces", faces)):
            if value:
                raise InputError(f"{name} is for {', '.join(GENERIC)}, not for a {kind}")
        assert make is not None
        return tuple(make())
    if not material:
        raise InputError(f"material is missing: a {kind} needs one of {', '.join(MATERIALS)}")
    look = find("material", material, MATERIALS)
    if kind == "mesh":
        return (_mesh_part(look, size_m, vertices_m, faces),)
    if faces or vertices_m:
        raise InputError(f"vertices and faces are for a mesh, not for a {kind}")
    if not min(size_m) > 0:
        raise InputError(f"size_m of a {kind} must be its three sides, above 0 m, got {size_m}")
    if kind == "cylinder" and size_m[0] != size_m[1]:
        raise InputError(f"size_m of a cylinder must be as wide in y as in x, got {size_m}")
    shape = "cuboid" if kind == "box" else "cylinder"
    return (Part(BODY, (0.0, 0.0, size_m[2] / 2), size_m, look, shape),)


def _mesh_part(look: str, size_m: Vec3, vertices_m: tuple[Vec3, ...], faces: tuple[Face, ...]) -> Part:
    """The part of a mesh, standing on the floor with its footprint about the origin."""
    if not (vertices_m and faces):
        raise InputError("a mesh needs vertices_m and faces; a TOML gives them by file")
    if any(size_m):
        raise InputError("size_m is for a box or cylinder; leave it out for a mesh")
    points = np.array(vertices_m, np.float32).astype(float)
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    if np.abs(middle).max() > 1e-6 * (high - low).max():  # rounding; a mesh that was centred stays as it is
        points = (points - middle).astype(np.float32).astype(float)
    x, y, z = (float(side) for side in high - low)
    vertices = tuple(map(tuple, points.tolist()))
    return Part(BODY, (0.0, 0.0, z / 2), (x, y, z), look, "mesh", vertices_m=vertices, faces=faces)


@dataclass(frozen=True, kw_only=True)
class FurnitureSpec(Spec):
    """A piece of furniture or of the building."""

    name: str
    """Name of its prim."""

    kind: str
    """A name of `KINDS` ("desk", "cabinet"), or "box", "cylinder" or "mesh"."""

    p_world: Vec3
    """Position of the middle of its footprint [m]."""

    q_world_xyzw: Quat = IDENTITY_XYZW
    """Its axes in world: x is the front, z is up."""

    magnetization: tuple[float, ...] = ()
    """Magnetization of each steel part along its longest side, in order [A/m]; () means none."""

    susceptibility: float = 0.0
    """Volume susceptibility of its steel parts [1]."""

    material: str = ""
    """Material of a box, cylinder or mesh, a name of `MATERIALS`."""

    size_m: Vec3 = ZERO3
    """Size of a box along x, y and z, or diameter, diameter and height of a cylinder [m]."""

    vertices_m: tuple[Vec3, ...] = ()
    """Vertices of a mesh about the centre of its bounding box [m], in single precision; it stands on the
    floor."""

    faces: tuple[tuple[int, int, int], ...] = ()
    """Corners of a mesh's triangles, counter-clockwise from outside."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._unit("q_world_xyzw")
        self._not_negative("susceptibility")
        steel = [part.name for part in self.parts if part.steel]
        fits = len(self.magnetization) in (0, len(steel))
        what = f"have one number for each of {', '.join(steel)}"
        what = what if steel else "be left out: the piece has no steel"
        self._require("magnetization", fits, what, self.magnetization)
        if not any(self.magnetization):
            object.__setattr__(self, "magnetization", ())
        if self.faces:
            object.__setattr__(self, "vertices_m", self.parts[0].vertices_m)
            self.sources()  # refuses a steel mesh that is not closed

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts of the piece."""
        shape = {"size_m": self.size_m, "vertices_m": self.vertices_m, "faces": self.faces}
        return parts_of(self.kind, material=self.material, **shape)  # type: ignore[arg-type]

    def sources(self, *, in_world: bool = True) -> tuple[SourceSpec, ...]:
        """One source for each steel part, named after the piece and the part.

        Args:
            in_world: Whether positions and axes are in world; otherwise they are in the axes of the piece.
        """
        steel = [part for part in self.parts if part.steel]
        at = (self.p_world, self.q_world_xyzw) if in_world else None
        return tuple(
            source_of(part, f"{self.name}_{part.name}", at, m, part.along, self.susceptibility)
            for part, m in zip(steel, self.magnetization or (0.0,) * len(steel), strict=True)
        )


def source_of(
    part: Part, name: str, at: tuple[Vec3, Quat] | None, m: float, along: int, susceptibility: float
) -> SourceSpec:
    """The source of a steel part.

    Args:
        part: The part.
        name: Name of the source.
        at: Origin [m] and axes in world of what the part belongs to. None: the source stays in these axes.
        m: Magnetization [A/m].
        along: Axis of the magnetization, 0 to 2.
        susceptibility: Volume susceptibility [1].
    """
    p_world, turn = (ZERO3, IDENTITY_XYZW) if at is None else at
    x, y, z = map(float, part.p if at is None else rotate(turn, part.p) + p_world)
    return SourceSpec(
        name=name,
        p_world=(x, y, z),
        shape=part.shape,
        q_world_xyzw=turn,
        size_m=ZERO3 if part.faces else part.size_m,
        vertices_m=part.vertices_m,
        faces=part.faces,
        magnetization=tuple(m * (k == along) for k in range(3)),  # type: ignore[arg-type]
        susceptibility=susceptibility,
    )


@lru_cache(maxsize=1024)
def steel_of(piece: FurnitureSpec) -> tuple[SourceSpec, ...]:
    """`piece.sources()`, cached because every run of a furnished lab needs them."""
    return tuple(piece.sources())
