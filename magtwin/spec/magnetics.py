"""What makes the field: the Earth, magnetised things, and the robot itself."""

import datetime
from dataclasses import dataclass

import numpy as np

from magtwin.frames import IDENTITY_XYZW
from magtwin.report.summary import Summarized
from magtwin.spec.base import ZERO3, ZERO9, Matrix3, Quat, Spec, Vec3
from magtwin.spec.mesh import check_mesh

MODEL = "the IGRF-14"
"""Model of the Earth's field."""

SPAN = (datetime.date(1900, 1, 1), datetime.date(2030, 1, 1))
"""First and last day of the model."""

SHAPES = ("cuboid", "cylinder", "sphere", "mesh")
"""Shapes of a magnetised body."""


@dataclass(frozen=True, kw_only=True)
class PlatformFieldSpec(Spec):
    """The robot's own magnetic field at its magnetometer, in base_link axes.

    B = (1 + S) b + h + E db/dt + terms of motors, LiDAR, electronics and turning iron, with b the ambient
    field in base_link axes. The first three are the permanent, induced and eddy terms of Tolles and Lawson
    (1950). `magtwin.sim.interference` computes all of them.
    """

    hard_iron_nt: Vec3 = ZERO3
    """Permanent field h (hard iron) [nT]."""

    soft_iron: Matrix3 = ZERO9
    """Induced field S (soft iron), by rows [nT per nT]."""

    eddy_s: Matrix3 = ZERO9
    """Eddy-current part E, by rows [nT per nT/s]."""

    left_motor_nt_nm: Vec3 = ZERO3
    """Field of the left motor per N m of torque at its wheel, since current is proportional to torque
    [nT/(N m)]."""

    right_motor_nt_nm: Vec3 = ZERO3
    """Field of the right motor per N m of torque at its wheel [nT/(N m)]."""

    lidar_nt: Vec3 = ZERO3
    """Steady field of the LiDAR and its supply while it is on [nT]."""

    lidar_cos_nt: Vec3 = ZERO3
    """Field of the LiDAR's motor, the part in proportion to the cosine of its angle [nT]."""

    lidar_sin_nt: Vec3 = ZERO3
    """Field of the LiDAR's motor, the part in proportion to the sine of its angle [nT]."""

    lidar_phase: float = 0.0
    """Angle of the LiDAR's motor at the start of a run [rad]."""

    battery_nt: Vec3 = ZERO3
    """Field per ampere of supply current above that at rest with a full pack [nT/A]."""

    left_wheel_moment: float = 0.0
    """Magnetic moment of the left wheel's iron across its axle [A m2]; it turns with the wheel."""

    left_wheel_phase: float = 0.0
    """Angle of that moment at the start of a run, from up towards forward [rad]."""

    right_wheel_moment: float = 0.0
    """Magnetic moment of the right wheel's iron across its axle [A m2]."""

    right_wheel_phase: float = 0.0
    """Angle of that moment at the start of a run, from up towards forward [rad]."""

    caster_moment: float = 0.0
    """Magnetic moment of the caster's iron, across its axle [A m2]; it rolls as the robot drives."""

    caster_phase: float = 0.0
    """Angle of that moment at the start of a run, from up towards forward [rad]."""

    p_base_caster: Vec3 = ZERO3
    """Centre of the caster in base_link [m]."""

    caster_radius_m: float = 0.01
    """Rolling radius of the caster [m]."""

    hard_iron_change_nt: Vec3 = ZERO3
    """Change of h since the survey of the map [nT]; 0 in the survey's session. A map that this robot surveyed
    contains h without the change."""

    hard_iron_drift_nt: Vec3 = ZERO3
    """Mean change of h between the survey and later sessions [nT]: handling, docking and tools magnetise or
    demagnetise the robot."""

    hard_iron_std_nt: float = 0.0
    """Standard deviation of each component of h between sessions [nT]."""

    current_std: float = 0.0
    """Relative standard deviation of the fields of motors, LiDAR and battery between sessions: wires move."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("caster_radius_m")
        self._not_negative("hard_iron_std_nt", "current_std")


@dataclass(frozen=True, kw_only=True)
class EarthFieldSpec(Spec):
    """The Earth's field, uniform over the lab."""

    b_world_nt: Vec3
    """Field in world axes [nT]."""

    latitude_deg: float
    """Geodetic latitude of the room, north positive [deg]."""

    longitude_deg: float
    """Longitude of the room, east positive [deg]."""

    height_m: float
    """Height above the WGS 84 ellipsoid [m]."""

    date: str
    """Date, YYYY-MM-DD."""

    north_deg: float = 0.0
    """Angle from the world's +y to true north, counter-clockwise from above [deg]."""

    measured: bool = False
    """Whether the field was measured; a measured field may differ from the model."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._within("latitude_deg", -90, 90)
        self._within("longitude_deg", -180, 360)
        self._within("north_deg", -360, 360)
        self._require("date", _is_date(self.date), "be a date YYYY-MM-DD", self.date)
        first, last = SPAN
        if not self.measured:
            within = first <= datetime.date.fromisoformat(self.date) <= last
            self._require("date", within, f"lie in {MODEL}'s span, {first} to {last}", self.date)


def _is_date(text: str) -> bool:
    try:
        return datetime.date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


@dataclass(frozen=True, kw_only=True, repr=False)
class SourceSpec(Summarized, Spec):
    """A magnetised thing: a point dipole, or a uniformly magnetised body."""

    name: str
    """Name of its prim: letters, digits and _, not starting with a digit."""

    p_world: Vec3
    """Position: the centre, or the origin of a mesh [m]."""

    m_world: Vec3 = ZERO3
    """Dipole moment of a point in world axes [A m2]."""

    shape: str = "point"
    """"point", "cuboid", "cylinder", "sphere" or "mesh"."""

    q_world_xyzw: Quat = IDENTITY_XYZW
    """Axes of a body in world. The axis of a cylinder is z."""

    size_m: Vec3 = ZERO3
    """Size of the body's bounding box along its own axes [m]; computed for a mesh."""

    magnetization: Vec3 = ZERO3
    """Remanent magnetization of a body in its own axes [A/m]."""

    susceptibility: float = 0.0
    """Volume susceptibility of the material [1]: the Earth's field induces more magnetization."""

    vertices_m: tuple[Vec3, ...] = ()
    """Vertices of a mesh in its own axes [m], in single precision as in USD."""

    faces: tuple[tuple[int, int, int], ...] = ()
    """Corners of a mesh's triangles, counter-clockwise from outside."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._named("shape", ("point", *SHAPES))
        self._unit("q_world_xyzw")
        self._not_negative("susceptibility")
        fits = self.shape == "mesh" or not (self.vertices_m or self.faces)
        self._require("vertices_m", fits, "be given for shape mesh only", "some")
        if self.shape == "point":
            for name, none in {"size_m": ZERO3, "magnetization": ZERO3, "susceptibility": 0.0}.items():
                value = getattr(self, name)
                self._require(name, value == none, "be left out for a point, which has only m_world", value)
            turned = self.q_world_xyzw != IDENTITY_XYZW
            what = "be left out for a point: m_world is in world axes"
            self._require("q_world_xyzw", not turned, what, "a rotation")
            return
        self._require("m_world", self.m_world == ZERO3, f"be left out for a {self.shape}", self.m_world)
        if self.shape == "mesh":
            vertices = np.asarray(np.asarray(self.vertices_m, np.float32), float).reshape(-1, 3)
            check_mesh(vertices, np.asarray(self.faces, int).reshape(-1, 3), f"source {self.name!r}")
            object.__setattr__(self, "vertices_m", tuple(map(tuple, vertices.tolist())))
            object.__setattr__(self, "size_m", tuple(np.ptp(vertices, axis=0).tolist()))
        else:
            self._require("size_m", min(self.size_m) > 0, "be above 0 m each way", self.size_m)
        x, y, z = self.size_m
        if self.shape == "cylinder":
            self._require("size_m", x == y, "be equal in x and y for a cylinder", self.size_m)
        if self.shape == "sphere":
            self._require("size_m", x == y == z, "be equal each way for a sphere", self.size_m)
