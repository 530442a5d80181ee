"""Furniture and parts of a building: the parts that they consist of, and how their steel is magnetised."""

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
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
    """A box, an upright cylinder or a mesh, in its piece's axes: x its front, z up, the origin amid its
    footprint.

    Hollow sections and bent sheets are taken as solid: a magnetization is that of the whole section.
    """

    name: str
    p: Vec3
    """Its middle [m]."""

    size_m: Vec3
    """Sides of a box; diameter, diameter and height of a cylinder [m]."""

    look: str
    """What it is made of, a name of `magtwin.usd.looks`."""

    shape: str = "cuboid"
    """"cuboid", "cylinder" or "mesh"."""

    fill: float = 1.0
    """Factor on a magnetization that is drawn: a wide hollow section holds less steel than a slim tube."""

    vertices_m: tuple[Vec3, ...] = ()
    """Vertices of a mesh about its middle [m], in single precision."""

    faces: tuple[Face, ...] = ()
    """Corners of a mesh's triangles, counter-clockwise from outside."""

    @property
    def steel(self) -> bool:
        """Whether it can be magnetised."""
        return self.look in STEEL

    @property
    def along(self) -> int:
        """Its longest side, 0 to 2, which steel is magnetised along: there it demagnetises least."""
        return self.size_m.index(max(self.size_m))


STEEL = ("Steel", "PaintedSteel", "Door", "Chrome", "Enamel")
"""Looks of what can be magnetised."""

MATERIALS: Mapping[str, str] = MappingProxyType(
    {
        "steel": "Steel",
        "painted_steel": "PaintedSteel",
        "wood": "Wood",
        "concrete": "Concrete",
        "brick": "Brick",
        "plastic": "Plastic",
        "aluminium": "Aluminium",
    }
)
"""Look of each material that a box, cylinder or mesh can have; only the steels make a field."""

GENERIC = ("box", "cylinder", "mesh")
"""Kinds of one part, whose material and size are given."""

BODY = "body"
"""Name of that part."""

WALL_M = 0.002
"""Thickness of the steel of a generic piece, for the magnetization that is drawn [m]: most are hollow."""

DRAWN_A_M = (500.0, 5000.0)
"""Least and greatest magnetization that is drawn for a steel part [A/m], of either sign: what desks, chairs
and cabinets usually have."""


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


KINDS: Mapping[str, Callable[[], Iterator[Part]]] = MappingProxyType(
    {
        "desk": _desk,
        "chair": _chair,
        "cabinet": _cabinet,
        "column": _column,
        "radiator": _radiator,
        "door_frame": _door_frame,
        "shelf": _shelf,
    }
)
"""What makes the parts of each kind that is not generic."""


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
        material: What a generic piece is made of, a name of `MATERIALS`.
        size_m: Sides of the box about a generic piece [m]; that of a mesh follows from its vertices.
        vertices_m: Vertices of a mesh [m].
        faces: Corners of its triangles.

    Raises:
        UnknownNameError: No such kind or material; the text names the nearest one.
        InputError: A generic piece has no material or size, or another kind has one.
    """
    if kind not in GENERIC:
        make = find("furniture", kind, {**KINDS, **dict.fromkeys(GENERIC)})
        for name, value in (("material", material), ("size_m", any(size_m)), ("faces", faces)):
            if value:
                raise InputError(f"{name} is for {', '.join(GENERIC)}; a {kind} has its own")
        assert make is not None
        return tuple(make())
    if not material:
        raise InputError(f"material is missing: a {kind} needs one of {', '.join(MATERIALS)}")
    look = find("material", material, MATERIALS)
    if kind == "mesh":
        return (_mesh_part(look, size_m, vertices_m, faces),)
    if faces or vertices_m:
        raise InputError(f"vertices and faces go with a mesh, not with a {kind}")
    if not min(size_m) > 0:
        raise InputError(f"size_m of a {kind} must be its three sides, above 0 m, got {size_m}")
    if kind == "cylinder" and size_m[0] != size_m[1]:
        raise InputError(f"size_m of a cylinder must be as wide in y as in x, got {size_m}")
    inner = [max(side - 2 * WALL_M, 0.0) / side for side in size_m]
    shape = "cuboid" if kind == "box" else "cylinder"
    steel = 1 - inner[0] * inner[1] * inner[2]
    return (Part(BODY, (0.0, 0.0, size_m[2] / 2), size_m, look, shape, fill=steel),)


def _mesh_part(look: str, size_m: Vec3, vertices_m: tuple[Vec3, ...], faces: tuple[Face, ...]) -> Part:
    """The part of a mesh: it stands on the floor, its footprint about the origin."""
    if not (vertices_m and faces):
        raise InputError("a mesh needs vertices_m and faces; a TOML gives them by file")
    if any(size_m):
        raise InputError("size_m is for a box or cylinder; a mesh has that of its vertices")
    points = np.array(vertices_m, np.float32).astype(float)
    low, high = points.min(axis=0), points.max(axis=0)
    middle = (low + high) / 2
    if np.abs(middle).max() > 1e-6 * (high - low).max():  # rounding; a mesh that was centred stays as it is
        points = (points - middle).astype(np.float32).astype(float)
    corner = points[np.array(faces)]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    volume = abs(float(np.einsum("fi,fi->", corner[:, 0], across)) / 6)
    shell = WALL_M * float(np.linalg.norm(across, axis=1).sum()) / 2
    x, y, z = (float(side) for side in high - low)
    return Part(
        BODY,
        (0.0, 0.0, z / 2),
        (x, y, z),
        look,
        "mesh",
        fill=min(1.0, shell / volume) if volume else 1.0,
        vertices_m=tuple(map(tuple, points.tolist())),
        faces=faces,
    )


def drawn_magnetization(name: str, parts: Iterable[Part], *, seed: int = 0) -> tuple[float, ...]:
    """Magnetization of a piece's steel parts where none is given, each along its longest side.

    Uniform in `DRAWN_A_M`, of random sign, times the part's `fill`, to 1 A/m. Each piece draws from a
    stream of its own, from the seed and its name: adding, removing or moving a piece changes no other.

    Args:
        name: Name of the piece.
        parts: Its parts.
        seed: Seed of the scene.

    Returns:
        One number for each steel part, in order [A/m].
    """
    words = np.frombuffer(hashlib.sha256(name.encode()).digest(), "<u4").tolist()
    rng = np.random.default_rng([seed, *words])
    drawn = []
    for part in parts:
        if part.steel:
            size = rng.uniform(*DRAWN_A_M) * rng.choice((-1.0, 1.0)) * part.fill
            drawn.append(float(np.copysign(max(round(abs(size)), 1), size)))
    return tuple(drawn)


@dataclass(frozen=True, kw_only=True)
class FurnitureSpec(Spec):
    """A piece of furniture or of the building; `magtwin.spec.furniture` says what each kind consists of."""

    name: str
    """Name of its prim."""

    kind: str
    """What it is, a name of `magtwin.spec.furniture.KINDS`, or "box", "cylinder" or "mesh"."""

    p_world: Vec3
    """Where it stands: the middle of its footprint, on the floor [m]."""

    q_world_xyzw: Quat = IDENTITY_XYZW
    """Its axes in world: x is its front, z up."""

    magnetization: tuple[float, ...] = ()
    """Magnetization of its steel parts, each along its longest side, in their order [A/m]; () for none."""

    susceptibility: float = 0.0
    """Volume susceptibility of its steel parts [1]."""

    material: str = ""
    """What a box, cylinder or mesh is made of, a name of `magtwin.spec.furniture.MATERIALS`."""

    size_m: Vec3 = ZERO3
    """Size of a box along its own x, y and z, or diameter, diameter and height of a cylinder [m]."""

    vertices_m: tuple[Vec3, ...] = ()
    """Vertices of a mesh about the middle of its box [m], in single precision; it stands on the floor."""

    faces: tuple[tuple[int, int, int], ...] = ()
    """Corners of a mesh's triangles, counter-clockwise from outside."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._unit("q_world_xyzw")
        self._not_negative("susceptibility")
        steel = [part.name for part in self.parts if part.steel]
        fits = len(self.magnetization) in (0, len(steel))
        what = f"have one number for each of {', '.join(steel)}" if steel else "be left out: it has no steel"
        self._require("magnetization", fits, what, self.magnetization)
        if not any(self.magnetization):
            object.__setattr__(self, "magnetization", ())
        if self.faces:
            object.__setattr__(self, "vertices_m", self.parts[0].vertices_m)
            self.sources()  # refuses a steel mesh that is not closed

    @property
    def parts(self) -> tuple[Part, ...]:
        """What it consists of."""
        return parts_of(
            self.kind,
            material=self.material,
            size_m=self.size_m,
            vertices_m=self.vertices_m,
            faces=self.faces,
        )

    def sources(self, *, in_world: bool = True) -> tuple[SourceSpec, ...]:
        """Its steel, a source each, named after the piece and the part.

        Args:
            in_world: Whether they stand where it does; otherwise they are in its own axes.
        """
        steel = [part for part in self.parts if part.steel]
        turn = self.q_world_xyzw if in_world else IDENTITY_XYZW
        sources = []
        for part, m in zip(steel, self.magnetization or (0.0,) * len(steel), strict=True):
            x, y, z = rotate(turn, part.p) + self.p_world if in_world else map(float, part.p)
            sources.append(
                SourceSpec(
                    name=f"{self.name}_{part.name}",
                    p_world=(float(x), float(y), float(z)),
                    shape=part.shape,
                    q_world_xyzw=turn,
                    size_m=ZERO3 if part.faces else part.size_m,
                    vertices_m=part.vertices_m,
                    faces=part.faces,
                    magnetization=tuple(m * (k == part.along) for k in range(3)),  # type: ignore[arg-type]
                    susceptibility=self.susceptibility,
                )
            )
        return tuple(sources)


@lru_cache(maxsize=1024)
def steel_of(piece: FurnitureSpec) -> tuple[SourceSpec, ...]:
    """`piece.sources()`, kept, as every run of a furnished lab asks for them."""
    return tuple(piece.sources())
