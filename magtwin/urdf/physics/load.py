"""Load: the inertia and the weight that each joint carries."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Inertial

GRAVITY = 9.80665
"""Standard gravity [m/s2]; CODATA 2018."""


@dataclass(frozen=True)
class Load:
    """What a joint carries: the links beyond it, at rest."""

    inertia: float
    """Moment of inertia about the axis [kg m2]; of a joint that slides, the mass [kg]."""

    weight: float
    """Largest torque of gravity about the axis, in any attitude [N m]; if the joint slides, the force [N]."""

    beside: float = 0.0
    """Part of the inertia that is due to the distance of the centre from the axis; 0 if the joint slides."""

    slope: float = 1.0
    """Size of the axis' component along the root's z at rest."""


def read_loads(description: Description, poses: Mapping[str, NDArray]) -> dict[str, Load]:
    """The load of each joint by name, from the masses and tensors that the description gives.

    About an axis u through p, bodies of total mass M, centre C and tensor I_C about C have (Goldstein 2002,
    section 5.3)

        I = u^T I_C u + M |u x (C - p)|^2,  largest torque M g |u x (C - p)|.

    Args:
        description: Links and joints.
        poses: T_root_link of each link, parents before children, shape (4, 4) each.
    """
    moments = {
        name: _moments(description.links[name].inertial, T) for name, T in poses.items()
    }  # of each link and, below, of all links beyond it
    for child in reversed(list(poses)):
        if child in description.joints:
            parent = description.joints[child].parent
            moments[parent] = moments[parent] + moments[child]
    loads = {}
    for child, joint in description.joints.items():
        mass, first, second = moments[child][0, 0], moments[child][1:4, 0], moments[child][1:4, 1:4]
        length = float(np.linalg.norm(joint.axis))
        if not mass or not length:
            loads[joint.name] = Load(0.0, 0.0)
            continue
        if joint.type == "prismatic":
            loads[joint.name] = Load(float(mass), float(mass * GRAVITY))
            continue
        axis, centre = poses[child][:3, :3] @ np.asarray(joint.axis, float) / length, first / mass
        own = second - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        arm = float(np.linalg.norm(np.cross(axis, centre - poses[child][:3, 3])))
        about = float(axis @ own @ axis) + mass * arm**2
        beside = mass * arm**2 / about if about > 0 else 0.0
        loads[joint.name] = Load(
            max(about, 0.0), float(mass * GRAVITY * arm), float(beside), float(abs(axis[2]))
        )
    return loads


def _moments(inertial: Inertial | None, T: NDArray) -> NDArray[np.float64]:
    """Mass, first moment and tensor about the root's origin of a link with pose T, as a table (4, 4).

    Row 0 holds the mass, column 0 below it the first moment, and the rest the tensor. Tables add up.
    """
    table = np.zeros((4, 4))
    mass = None if inertial is None else inertial.mass
    if inertial is None or not mass or not (np.isfinite(mass) and mass > 0):
        return table
    frame = T @ origin_of(inertial)
    centre = frame[:3, 3]
    table[0, 0], table[1:4, 0] = mass, mass * centre
    table[1:4, 1:4] = mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    if inertial.inertia is not None and np.isfinite(inertial.inertia).all():
        table[1:4, 1:4] += frame[:3, :3] @ np.asarray(inertial.inertia, float) @ frame[:3, :3].T
    return table
