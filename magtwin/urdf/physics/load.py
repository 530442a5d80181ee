"""Load: the inertia and the weight that each joint carries."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.urdf.description.description import Description, origin_of
from magtwin.urdf.description.model import Inertial
from magtwin.urdf.physics.inertia import MassProperties, combined

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


def read_loads(
    description: Description, poses: Mapping[str, NDArray], filled: Mapping[str, MassProperties]
) -> dict[str, Load]:
    """The load of each joint by name, from the masses and tensors that the description gives, or `filled`.

    About an axis u through p, bodies of total mass M, centre C and tensor I_C about C have (Goldstein 2002,
    section 5.3)

        I = u^T I_C u + M |u x (C - p)|^2,  largest torque M g |u x (C - p)|.

    Args:
        description: Links and joints.
        poses: T_root_link of each link, parents before children, shape (4, 4) each.
        filled: Mass properties of links without `<inertial>`, in the root's frame.
    """
    whole = {
        name: _body(inertial, T)
        for name, T in poses.items()
        if (inertial := description.links[name].inertial) is not None and inertial.mass
    } | dict(filled)  # of each link and, below, of all links beyond it
    for child in reversed(list(poses)):
        if child in description.joints and child in whole:
            parent = description.joints[child].parent
            whole[parent] = combined([whole[name] for name in (parent, child) if name in whole])
    loads = {}
    for child, joint in description.joints.items():
        body, length = whole.get(child), float(np.linalg.norm(joint.axis))
        if body is None or not length:
            loads[joint.name] = Load(0.0, 0.0)
            continue
        mass = body.mass
        if joint.type == "prismatic":
            loads[joint.name] = Load(mass, mass * GRAVITY)
            continue
        axis = poses[child][:3, :3] @ np.asarray(joint.axis, float) / length
        arm = float(np.linalg.norm(np.cross(axis, body.centre - poses[child][:3, 3])))
        about = float(axis @ body.inertia @ axis) + mass * arm**2
        beside = mass * arm**2 / about if about > 0 else 0.0
        loads[joint.name] = Load(
            max(about, 0.0), float(mass * GRAVITY * arm), float(beside), float(abs(axis[2]))
        )
    return loads


def _body(inertial: Inertial, T: NDArray) -> MassProperties:
    """A link with pose T, shape (4, 4), in the root's frame; without a tensor, a point."""
    tensor = np.zeros((3, 3)) if inertial.inertia is None else np.asarray(inertial.inertia, float)
    return MassProperties(float(inertial.mass or 0.0), np.zeros(3), tensor).moved(T @ origin_of(inertial))
