"""Neighbours: the other robots in a lab, as a robot's magnetometer and bumper meet them.

The iron of another robot is a point dipole at its base_link, with the moment that makes the permanent and
induced field of its platform at its own magnetometer. That is exact far away and approximate nearby, because
the place of the iron in the robot is unknown. Motors, LiDAR, battery and turning iron are neglected.

Robots do not see each other while they drive. Their least distance is found afterwards.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.run import mapped
from magtwin.sim.interference import NEAREST_M, sensor_places
from magtwin.sim.motion.drive import Moment
from magtwin.sim.motion.engine import Travel
from magtwin.sim.motion.sampling import Moving, moment_at
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]

MU_0_NT = 4 * math.pi * 1e2
"""Magnetic constant [nT m/A]."""

RATE_STEP_S = 1e-3
"""Half of the time over which a neighbour's field is differenced [s]; robots drive 0.3 mm in it."""

SEEN_HZ = 50.0
"""Rate of the clearance check [Hz]: every 12 mm for two robots that drive at each other."""


@dataclass(frozen=True, eq=False)
class Neighbour:
    """Another robot and its motion."""

    robot: RobotSpec
    motion: Travel


@dataclass(frozen=True)
class Approach:
    """Nearest approach of two robots."""

    names: tuple[str, str]
    """Names of the robots."""

    clearance_m: float
    """Least distance between their footprints [m]; below 0 if they overlap."""

    t_s: float
    """Time of the least distance [s]."""

    meet_s: float | None
    """Time of their first overlap [s]; None if they never overlap."""

    p_meet: tuple[float, float]
    """Place of the first overlap, or else of the least distance, midway between them [m]."""

    def joined(self, later: "Approach") -> "Approach":
        """The nearest approach of two robots in this time and a later one."""
        least = later if later.clearance_m < self.clearance_m else self
        met = next((one for one in (self, later) if one.meet_s is not None), least)
        return replace(least, meet_s=met.meet_s, p_meet=met.p_meet)


def iron_moments(robot: RobotSpec, b_base_nt: ArrayLike) -> Array:
    """Dipole at base_link's origin that represents a robot's iron.

    With r u the vector from there to its magnetometer, and B = h + S b its permanent and induced field there,
    B = mu_0 / 4 pi r^3 (3 (m . u) u - m) has the solution m = 4 pi r^3 / mu_0 (3/2 (B . u) u - B).

    Returns:
        Moments in base_link axes [A m2], shape (N, 3).
    """
    platform, b = robot.platform, np.asarray(b_base_nt, float)
    iron = np.einsum("nk,jk->nj", b, np.reshape(platform.soft_iron, (3, 3))) + platform.hard_iron_nt
    r = math.hypot(*robot.p_base_magnetometer)
    if not iron.any():
        return iron
    if not r > NEAREST_M:
        raise InputError(
            f"robot {robot.name!r}: its magnetometer is at the origin of base_link, so the dipole "
            "of its iron, which other robots feel, is unknown; move the magnetometer, or run it alone"
        )
    u = np.divide(robot.p_base_magnetometer, r)
    return np.asarray(4 * math.pi * r**3 / MU_0_NT * (1.5 * (iron @ u)[:, None] * u - iron))


def neighbours_field_nt(
    scene: Scene,
    neighbours: Sequence[Neighbour],
    motion: Moving,
    t: ArrayLike,
    true: Moment,
    until_s: float = math.inf,
) -> Array:
    """Field of other robots at a robot's magnetometer.

    (1 + S) b + E db/dt with their field b in base_link axes: the robot's soft iron and eddy currents respond
    to it as to the lab's field.

    Returns:
        Field in base_link axes [nT], shape (N, 3).
    """
    t = np.asarray(t, float)
    ahead = np.minimum(RATE_STEP_S, until_s - t)
    later, sooner = (_at_sensor(scene, neighbours, motion, at) for at in (t + ahead, t - RATE_STEP_S))
    yaw = true.pose[:, 2]
    b = _turned(_at_sensor(scene, neighbours, motion, t), -yaw)
    rate = _turned((later - sooner) / (ahead + RATE_STEP_S)[:, None], -yaw)
    rate[:, 0] += true.w * b[:, 1]
    rate[:, 1] -= true.w * b[:, 0]
    soft, eddy = (
        np.reshape(m, (3, 3)) for m in (scene.robot.platform.soft_iron, scene.robot.platform.eddy_s)
    )
    return np.asarray(b + np.einsum("nk,jk->nj", b, soft) + np.einsum("nk,jk->nj", rate, eddy))


def _at_sensor(scene: Scene, neighbours: Sequence[Neighbour], motion: Moving, t: Array) -> Array:
    """The neighbours' field at the first robot's magnetometer at times [s], in world axes [nT], (N, 3)."""
    assert scene.earth is not None
    p_sensor = sensor_places(scene.robot, moment_at(motion, t).pose)
    field = np.zeros((len(t), 3))
    for other in neighbours:
        pose = moment_at(other.motion, t).pose
        earth = np.broadcast_to(scene.earth.b_world_nt, (len(t), 3))
        m_world = _turned(iron_moments(other.robot, _turned(earth, -pose[:, 2])), pose[:, 2])
        height = np.full(len(t), other.robot.base_height_m)
        r = p_sensor - np.column_stack([pose[:, :2], height])
        d = np.sqrt(np.sum(r * r, axis=1))[:, None]  # a dipole for each row; see `dipole_field_nt`
        along = 3 * np.sum(m_world * r, axis=1)[:, None] * r / d**5
        field += MU_0_NT / (4 * math.pi) * (along - m_world / d**3)
    return field


def approaches(travels: Mapping[str, Neighbour]) -> Iterator[Approach]:
    """Nearest approach of each pair of robots, until the last has arrived; the others stand then."""
    end = max(robot.motion.duration_s for robot in travels.values())
    count, found = int(end * SEEN_HZ) + 1, dict[tuple[str, str], Approach]()
    for rows in mapped.parts(count):
        t = np.arange(rows.start, rows.stop) / SEEN_HZ
        places = {name: robot.motion.at(t).pose[:, :2] for name, robot in travels.items()}
        for a, b in combinations(travels, 2):
            apart = np.hypot(*(places[a] - places[b]).T)
            apart -= travels[a].robot.footprint_radius_m + travels[b].robot.footprint_radius_m
            middle = (places[a] + places[b]) / 2
            nearest = int(np.argmin(apart))
            met = np.flatnonzero(apart < 0)
            first = int(met[0]) if len(met) else nearest
            later = Approach(
                names=(a, b),
                clearance_m=float(apart[nearest]),
                t_s=float(t[nearest]),
                meet_s=float(t[first]) if len(met) else None,
                p_meet=(float(middle[first, 0]), float(middle[first, 1])),
            )
            before = found.get((a, b))
            found[a, b] = later if before is None else before.joined(later)
    yield from found.values()


def touching(
    t: Array, motion: Moving, robot: RobotSpec, neighbours: Sequence[Neighbour]
) -> NDArray[np.bool_]:
    """Whether a robot's footprint overlaps another's at times [s], shape (N,)."""
    here = motion.at(t).pose[:, :2]
    touches = np.zeros(len(t), bool)
    for other in neighbours:
        there = other.motion.at(t).pose[:, :2]
        reach = robot.footprint_radius_m + other.robot.footprint_radius_m
        touches |= np.hypot(*(here - there).T) < reach
    return touches


def _turned(v: Array, angle: Array) -> Array:
    """Vectors (N, 3) turned about z by angles (N,)."""
    x, y, z = v.T
    cos, sin = np.cos(angle), np.sin(angle)
    return np.column_stack([cos * x - sin * y, sin * x + cos * y, z])
