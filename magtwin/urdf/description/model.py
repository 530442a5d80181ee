"""Model: links, joints and materials of a URDF as values, with yourdfpy's names.

They are read here and not by yourdfpy, whose import takes longer than a whole conversion; the tests compare
every link and joint with yourdfpy's.
"""

import math
from dataclasses import dataclass, field, fields
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from magtwin.frames import matrix_from_quat

Element = ElementTree.Element
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Geometry:
    """A `<geometry>`; its kind determines which of the other values it has."""

    kind: str
    """box, capsule, cylinder, mesh or sphere; capsules and cylinders are along z."""

    size: Array = field(default_factory=lambda: np.ones(3))
    """Edges of a box [m], shape (3,); factors of a mesh, shape (1,) or (3,)."""

    radius: float = 0.0
    """[m]."""

    length: float = 0.0
    """Length of a cylinder, or of a capsule without its round ends [m]."""

    filename: str = ""
    """File of a mesh."""

    @property
    def empty(self) -> bool:
        """Whether it is a primitive of size 0; a capsule of length 0 is a ball."""
        if self.kind in ("box", "mesh"):
            return self.kind == "box" and 0 in self.size
        return self.radius == 0 or (self.kind == "cylinder" and self.length == 0)

    def half_extents(self, R: Array) -> Array:
        """Half the edges of the axis-aligned box around a primitive at the origin [m], shape (3,).

        A disc of radius r with normal n reaches r sqrt(1 - n_i^2) along axis i.

        Args:
            R: Rotation of the primitive, shape (3, 3).
        """
        if self.kind == "box":
            return np.abs(R) @ (self.size / 2)
        n = R[:, 2]
        rim = np.sqrt(np.clip(1 - n**2, 0, 1)) if self.kind == "cylinder" else np.ones(3)
        return self.radius * rim + np.abs(n) * self.length / 2


@dataclass(frozen=True)
class Material:
    """A `<material>` of a visual or of the robot."""

    name: str | None

    rgba: Array | None
    """Red, green, blue (sRGB) and opacity of its `<color>`, 0 to 1, shape (4,)."""

    texture: str | None
    """File of its `<texture>`."""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """A `<visual>` or `<collision>`."""

    geometry: Geometry
    name: str | None = None
    origin: Array | None = None
    """Pose in the link, shape (4, 4)."""
    material: Material | None = None
    element: Element | None = field(default=None, compare=False, repr=False)


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
    """Name of the leader."""

    multiplier: float
    """Ratio of the two values [1; rad/m or m/rad if one rotates and the other slides]."""

    offset: float
    """Value when the leader is at 0 [rad or m]."""


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

    own_body: bool = False
    """Whether `dont_collapse` asks for a body of its own, although the joint is fixed."""


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
    return Joint(
        name=element.attrib["name"],
        type=element.get("type", ""),
        parent=parent.attrib["link"],
        child=child.attrib["link"],
        origin=read_origin(element.find("origin")),
        axis=np.array([1.0, 0.0, 0.0]) if axis is None else _numbers(axis, "xyz", "1 0 0"),
        limit=None if limit is None else Limit(**{f.name: _number(limit, f.name) for f in fields(Limit)}),
        dynamics=None
        if dynamics is None
        else Dynamics(**{f.name: _number(dynamics, f.name) for f in fields(Dynamics)}),
        mimic=None
        if mimic is None
        else Mimic(
            mimic.attrib["joint"], float(mimic.get("multiplier", 1.0)), float(mimic.get("offset", 0.0))
        ),
        own_body=element.get("dont_collapse", "").lower() in ("true", "1"),
    )


def read_material(element: Element) -> Material:
    """The material of a checked `<material>`."""
    color, texture = element.find("color"), element.find("texture")
    return Material(
        element.get("name"),
        None if color is None else _numbers(color, "rgba"),
        None if texture is None else texture.attrib["filename"],
    )


def _shape(element: Element) -> Shape:
    geometry, material = element.find("geometry"), element.find("material")
    assert geometry is not None  # the grammar checked it, and that it has one shape
    return Shape(
        geometry=_geometry(geometry[0]),
        name=element.get("name"),
        origin=read_origin(element.find("origin")),
        material=None if material is None else read_material(material),
        element=element,
    )


def _geometry(form: Element) -> Geometry:
    if form.tag == "box":
        return Geometry("box", _numbers(form, "size"))
    if form.tag == "mesh":
        return Geometry("mesh", _numbers(form, "scale", "1"), filename=form.attrib["filename"])
    length = 0.0 if form.tag == "sphere" else float(form.attrib["length"])
    return Geometry(form.tag, radius=float(form.attrib["radius"]), length=length)


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
    return Inertial(
        read_origin(element.find("origin")), None if mass is None else _number(mass, "value"), tensor
    )


def read_origin(element: Element | None) -> Array | None:
    """Pose of an `<origin>`, shape (4, 4): R = Rz(yaw) Ry(pitch) Rx(roll), or that of a quaternion.

    Raises:
        ValueError: It was not checked, and something in it is no number.
    """
    if element is None:
        return None
    (x, y, z), rpy, q = origin_numbers(element)
    if q is not None:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = matrix_from_quat(q), (x, y, z)
        return T
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    return np.array(
        [
            [cp * cy, sp * (sr * cy) - cr * sy, sp * (cr * cy) + sr * sy, x],
            [cp * sy, sp * (sr * sy) + cr * cy, sp * (cr * sy) - sr * cy, y],
            [-sp, cp * sr, cp * cr, z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def origin_numbers(element: Element) -> tuple[Array, Array, Array | None]:
    """Place [m]; roll, pitch and yaw [rad]; and unit quaternion xyzw, if one is given, of an `<origin>`."""
    q = _numbers(element, "quat_xyzw") if "quat_xyzw" in element.attrib else None
    xyz, rpy = _numbers(element, "xyz", "0 0 0"), _numbers(element, "rpy", "0 0 0")
    return xyz, rpy, None if q is None else q / np.linalg.norm(q)


def rpy_of(R: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw of a rotation, R = Rz Ry Rx.

    Each angle is removed before the next is read, so that errors near a pitch of 90 deg cancel.
    """
    yaw = math.atan2(R[1, 0], R[0, 0]) if math.hypot(R[0, 0], R[1, 0]) > 1e-12 else 0.0
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ R
    pitch = math.atan2(-R[2, 0], R[0, 0])
    c, s = math.cos(pitch), math.sin(pitch)
    R = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) @ R
    return math.atan2(R[2, 1], R[1, 1]), pitch, yaw


def _number(element: Element, name: str) -> float | None:
    given = element.get(name)
    return None if given is None else float(given)


def _numbers(element: Element, name: str, default: str | None = None) -> Array:
    text = element.attrib[name] if default is None else element.get(name, default)
    return np.array([float(word) for word in text.split()])
