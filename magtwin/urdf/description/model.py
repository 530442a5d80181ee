"""Model: links, joints and materials of a URDF as values, with yourdfpy's names.

They are read here and not by yourdfpy, whose import takes longer than a whole conversion; the tests compare
every link and joint with yourdfpy's.
"""

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

Element = ElementTree.Element
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Box:
    """A `<box>`."""

    size: Array
    """Edges [m], shape (3,)."""


@dataclass(frozen=True)
class Cylinder:
    """A `<cylinder>` along z."""

    radius: float
    length: float


@dataclass(frozen=True)
class Capsule:
    """A `<capsule>`; yourdfpy has none."""

    radius: float
    """Radius of the cylinder and of its round ends [m]."""

    length: float
    """Length along z without the ends [m]."""


@dataclass(frozen=True)
class Sphere:
    """A `<sphere>`."""

    radius: float


@dataclass(frozen=True)
class Mesh:
    """A `<mesh>`."""

    filename: str

    scale: Array
    """One factor or three, shape (1,) or (3,)."""


@dataclass(frozen=True)
class Geometry:
    """A `<geometry>`: exactly one field is not None."""

    box: Box | None = None
    capsule: Capsule | None = None
    cylinder: Cylinder | None = None
    mesh: Mesh | None = None
    sphere: Sphere | None = None

    @property
    def kind(self) -> str:
        """Its tag."""
        return next(name for name, form in vars(self).items() if form is not None)

    @property
    def empty(self) -> bool:
        """Whether it is a primitive of size 0; a capsule of length 0 is a ball."""
        sizes = [] if self.box is None else [*self.box.size]
        sizes += [form.radius for form in (self.capsule, self.cylinder, self.sphere) if form]
        return 0 in sizes or (self.cylinder is not None and self.cylinder.length == 0)

    @property
    def volume(self) -> float:
        """Volume of a primitive [m3]."""
        if self.box is not None:
            return float(np.prod(self.box.size))
        form = self.sphere or self.cylinder or self.capsule
        assert form is not None
        ball = 0.0 if self.cylinder else 4 / 3 * np.pi * form.radius**3
        return ball + np.pi * form.radius**2 * getattr(form, "length", 0.0)

    def half_extents(self, R: Array) -> Array:
        """Half the edges of the axis-aligned box around a primitive at the origin [m], shape (3,).

        A disc of radius r with normal n reaches r sqrt(1 - n_i^2) along axis i.

        Args:
            R: Rotation of the primitive, shape (3, 3).
        """
        if self.box is not None:
            return np.abs(R) @ (self.box.size / 2)
        if self.sphere is not None:
            return np.full(3, self.sphere.radius)
        n = R[:, 2]
        if self.cylinder is not None:
            rim = self.cylinder.radius * np.sqrt(np.clip(1 - n**2, 0, 1))
            return rim + np.abs(n) * self.cylinder.length / 2
        assert self.capsule is not None
        return self.capsule.radius + np.abs(n) * self.capsule.length / 2


@dataclass(frozen=True)
class Color:
    """A `<color>`."""

    rgba: Array
    """Red, green, blue (sRGB) and opacity, 0 to 1, shape (4,)."""


@dataclass(frozen=True)
class Texture:
    """A `<texture>`."""

    filename: str


@dataclass(frozen=True)
class Material:
    """A `<material>` of a visual or of the robot."""

    name: str | None
    color: Color | None
    texture: Texture | None


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A `<visual>` or `<collision>`."""

    geometry: Geometry
    name: str | None = None
    origin: Array | None = None
    """Pose in the link, shape (4, 4)."""
    material: Material | None = None


@dataclass(frozen=True)
class Inertial:
    """An `<inertial>`."""

    origin: Array | None
    """Pose in the link, shape (4, 4)."""

    mass: float | None
    """Mass [kg]."""

    inertia: Array | None
    """Moments and products about the centre of mass [kg m2], shape (3, 3)."""


@dataclass(frozen=True)
class Link:
    """A `<link>`."""

    name: str
    inertial: Inertial | None
    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]


@dataclass(frozen=True)
class Limit:
    """A `<limit>`: effort [N m or N], velocity [rad/s or m/s], lower and upper [rad or m]."""

    effort: float | None
    velocity: float | None
    lower: float | None
    upper: float | None


@dataclass(frozen=True)
class Dynamics:
    """A `<dynamics>`."""

    damping: float | None
    """[N m s/rad or N s/m]."""

    friction: float | None
    """[N m or N]."""


@dataclass(frozen=True)
class Mimic:
    """A `<mimic>`: q = multiplier q_joint + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """A `<joint>`."""

    name: str
    type: str
    parent: str
    child: str

    origin: Array | None
    """Pose of the child in the parent at 0, shape (4, 4)."""

    axis: Array
    """Axis in the joint's frame, of any length, shape (3,)."""

    limit: Limit | None
    dynamics: Dynamics | None
    mimic: Mimic | None


def read_link(element: Element) -> Link:
    """The link of a checked `<link>`."""
    visuals = tuple(_shape(child) for child in element.findall("visual"))
    collisions = tuple(_shape(child) for child in element.findall("collision"))
    return Link(element.attrib["name"], _inertial(element.find("inertial")), visuals, collisions)


def read_joint(element: Element) -> Joint:
    """The joint of a checked `<joint>`, which has a parent and a child."""
    parent, child = element.find("parent"), element.find("child")
    axis, limit, dynamics, mimic = (element.find(t) for t in ("axis", "limit", "dynamics", "mimic"))
    assert parent is not None  # the names were checked
    assert child is not None
    dynamics_values = None if dynamics is None else [_number(dynamics, n) for n in ("damping", "friction")]
    limits = None if limit is None else [_number(limit, n) for n in ("effort", "velocity", "lower", "upper")]
    return Joint(
        name=element.attrib["name"],
        type=element.get("type", ""),
        parent=parent.attrib["link"],
        child=child.attrib["link"],
        origin=_origin(element.find("origin")),
        axis=np.array([1.0, 0.0, 0.0]) if axis is None else _numbers(axis, "xyz", "1 0 0"),
        limit=None if limits is None else Limit(*limits),
        dynamics=None if dynamics_values is None else Dynamics(*dynamics_values),
        mimic=None if mimic is None else _mimic(mimic),
    )


def _mimic(element: Element) -> Mimic:
    factor, offset = float(element.get("multiplier", 1.0)), float(element.get("offset", 0.0))
    return Mimic(element.attrib["joint"], factor, offset)


def read_material(element: Element) -> Material:
    """The material of a checked `<material>`."""
    color, texture = element.find("color"), element.find("texture")
    return Material(
        element.get("name"),
        None if color is None else Color(_numbers(color, "rgba")),
        None if texture is None else Texture(texture.attrib["filename"]),
    )


def _shape(element: Element) -> Shape:
    geometry, material = element.find("geometry"), element.find("material")
    assert geometry is not None  # the grammar checked it, and that it has one shape
    return Shape(
        geometry=_geometry(geometry[0]),
        name=element.get("name"),
        origin=_origin(element.find("origin")),
        material=None if material is None else read_material(material),
    )


def _geometry(form: Element) -> Geometry:
    if form.tag == "box":
        return Geometry(box=Box(_numbers(form, "size")))
    if form.tag == "mesh":
        return Geometry(mesh=Mesh(form.attrib["filename"], _numbers(form, "scale", "1")))
    radius, length = float(form.attrib["radius"]), _number(form, "length") or 0.0
    if form.tag == "sphere":
        return Geometry(sphere=Sphere(radius))
    if form.tag == "capsule":
        return Geometry(capsule=Capsule(radius, length))
    return Geometry(cylinder=Cylinder(radius, length))


def _inertial(element: Element | None) -> Inertial | None:
    """Defaults of `<inertia>`: moments 1, as in yourdfpy, and products 0."""
    if element is None:
        return None
    mass, inertia = element.find("mass"), element.find("inertia")
    tensor = None
    if inertia is not None:
        xx, yy, zz = (float(inertia.get(name, 1.0)) for name in ("ixx", "iyy", "izz"))
        xy, xz, yz = (float(inertia.get(name, 0.0)) for name in ("ixy", "ixz", "iyz"))
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return Inertial(_origin(element.find("origin")), None if mass is None else _number(mass, "value"), tensor)


def _origin(element: Element | None) -> Array | None:
    """Pose of an `<origin>`, shape (4, 4): R = Rz(yaw) Ry(pitch) Rx(roll)."""
    if element is None:
        return None
    (sr, sp, sy), (cr, cp, cy) = (turn(_numbers(element, "rpy", "0 0 0")) for turn in (np.sin, np.cos))
    x, y, z = _numbers(element, "xyz", "0 0 0")
    return np.array(
        [
            [cp * cy, sp * (sr * cy) - cr * sy, sp * (cr * cy) + sr * sy, x],
            [cp * sy, sp * (sr * sy) + cr * cy, sp * (cr * sy) - sr * cy, y],
            [-sp, cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _number(element: Element, name: str) -> float | None:
    given = element.get(name)
    return None if given is None else float(given)


def _numbers(element: Element, name: str, default: str | None = None) -> Array:
    text = element.attrib[name] if default is None else element.get(name, default)
    return np.array([float(word) for word in text.split()])
