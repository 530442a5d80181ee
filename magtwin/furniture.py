"""Furniture and parts of a building, as the parts that they are made of."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from magtwin.names import find

Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class Part:
    """A box or an upright cylinder, in its piece's axes: x its front, z up, the origin amid its footprint.

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
    """"cuboid" or "cylinder"."""

    @property
    def steel(self) -> bool:
        """Whether it can be magnetised."""
        return self.look in STEEL

    @property
    def along(self) -> int:
        """Its longest side, 0 to 2, which steel is magnetised along: there it demagnetises least."""
        return self.size_m.index(max(self.size_m))


STEEL = ("Steel", "PaintedSteel", "Door", "Chrome")
"""Looks of what can be magnetised."""


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
    yield Part("shaft", (0, 0, (high + plate) / 2), (wide, wide, high - plate), "Steel")
    yield Part("plate", (0, 0, plate / 2), (0.4, 0.4, plate), "Concrete")


KINDS: Mapping[str, Callable[[], Iterator[Part]]] = MappingProxyType(
    {"desk": _desk, "chair": _chair, "cabinet": _cabinet, "column": _column}
)
"""What makes the parts of each kind."""


def parts_of(kind: str) -> tuple[Part, ...]:
    """The parts of a kind of furniture, in order.

    Raises:
        UnknownNameError: No such kind; the text names the nearest one.
    """
    return tuple(find("furniture", kind, KINDS)())
