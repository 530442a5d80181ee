"""HarmonicField: a magnetic field without curl or divergence, from equivalent dipoles and the Earth."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.sources.dipoles import dipole_field_nt
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate
from magtwin.report.summary import Summarized

Array = NDArray[np.float64]

SHAPES = {
    "p_world_dipole": (-1, 3),
    "m_world": (-1, 3),
    "b_uniform_nt": (3,),
    "hard_iron_nt": (3,),
    "soft_iron": (3, 3),
    "p_base_sensor": (3,),
}


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class HarmonicField(Summarized):
    """The field of dipoles below a floor and of the Earth, and the robot of the survey.

    B(p) = B_0 + the dipoles' fields has neither curl nor divergence above them, so it is known at every
    height. The survey's robot at (x, y) with heading yaw reads

        |(1 + S) R(yaw)^T B(p + R(yaw) l) + h|

    with hard iron h, soft iron S and the sensor at l in base_link. Arrays are copied and read-only. Two
    fields are equal if every array is.
    """

    p_world_dipole: Array  # Dipole positions [m], shape (D, 3)
    m_world: Array  # Dipole moments [A m^2], shape (D, 3)
    b_uniform_nt: Array  # Uniform part B_0 in world axes [nT], shape (3,)
    hard_iron_nt: Array  # Hard iron h of the robot, in base_link axes [nT], shape (3,)
    soft_iron: Array  # Soft iron S of the robot [nT per nT], shape (3, 3)
    # Position l of the sensor in base_link, with its height above the floor as z [m], shape (3,)
    p_base_sensor: Array

    def __post_init__(self) -> None:
        for name, shape in SHAPES.items():
            array = np.array(getattr(self, name), float)
            fits = array.ndim == len(shape) and array.shape[1:] == shape[1:] and shape[0] in (-1, len(array))
            if not (fits and np.all(np.isfinite(array))):
                text = f"{name} of HarmonicField must be finite, of shape {shape}"
                raise InputError(f"{text}, got {array.shape}")
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if self.p_world_dipole.shape != self.m_world.shape:
            raise InputError(
                f"{len(self.p_world_dipole)} dipoles of HarmonicField have {len(self.m_world)} moments"
            )

    def __eq__(self, other: Any) -> bool:
        if not isinstance(other, HarmonicField):
            return NotImplemented
        return all(np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    @property
    def height_m(self) -> float:
        """Height of the sensor above the floor [m]."""
        return float(self.p_base_sensor[2])

    def field_nt(self, p_world: ArrayLike, *, compiled: bool = False) -> Array:
        """Field without the robot, in world axes.

        Points above the dipoles [m] and field [nT], shape (..., 3). Compiled code is equal up to rounding and
        faster for many points.
        """
        sums = dipole_field_nt
        if compiled:
            from magtwin.field.sources import compiled_dipoles

            sums = compiled_dipoles.dipole_field_nt
        return sums(p_world, self.p_world_dipole, self.m_world) + self.b_uniform_nt

    def magnitude_nt(
        self,
        p_xy: ArrayLike,
        yaw: ArrayLike,
        *,
        height_m: float | None = None,
        own_nt: ArrayLike = 0.0,
        compiled: bool = False,
    ) -> Array:
        """What the survey's robot reads at rest at a pose.

        Positions of base_link [m], shape (..., 2), and headings [rad], shape (...), are broadcast; the height
        of the sensor above the floor [m] is by default the survey's. `own_nt` (..., 3) is what the robot adds
        to its hard iron, such as by motors. Field magnitude [nT], shape (...).
        """
        p, yaw = np.asarray(p_xy, float), np.asarray(yaw, float)
        shape = np.broadcast_shapes(p.shape[:-1], yaw.shape)
        turn = quat_from_yaw(np.broadcast_to(yaw, shape))
        place = self.p_base_sensor if height_m is None else np.array([*self.p_base_sensor[:2], height_m])
        at = rotate(turn, np.broadcast_to(place, (*shape, 3)))
        at[..., :2] += p
        b = rotate(quat_conjugate(turn), self.field_nt(at, compiled=compiled))
        own = np.asarray(own_nt) + self.hard_iron_nt
        return np.asarray(np.linalg.norm(b + b @ self.soft_iron.T + own, axis=-1))
