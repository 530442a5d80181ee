"""Forward: what a robot reads over layers of vertical dipoles, and how that changes with every unknown."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.harmonic import HarmonicField
from magtwin.field.sources import MU_0_OVER_4_PI, NT_PER_T

Array = NDArray[np.float64]

PLATFORM = 14
"""Unknowns of the platform: hard iron (3), soft iron (9, row by row), lever arm (2)."""

SPIN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
"""dR/dyaw = R SPIN for turns about z."""


@dataclass(frozen=True, eq=False)
class Reading:
    """Readings that a set of unknowns predicts, C parts each: 1 for magnitudes, 3 for vectors."""

    values_nt: Array
    """What is read, shape (N, C)."""

    jacobian: Array
    """Its derivatives by the unknowns, shape (N, C, P)."""

    by_place: Array
    """Its derivatives by x and y of the robot [nT/m], shape (N, C, 2)."""

    by_yaw: Array
    """Its derivative by the heading [nT/rad], shape (N, C)."""


@dataclass(frozen=True, eq=False)
class Forward:
    """Vertical dipoles, a uniform field and a platform; the sensor moves in the plane at `height_m`.

    A layer of vertical dipoles makes every field that has neither curl nor divergence above it: a
    horizontal dipole's, of wave number k, differs from theirs by a factor of modulus k_x / k only
    (Blakely 1995, section 12.1). The unknowns are, in order, the moments m (D), the uniform field B_0 (3)
    and the platform's h, S and l (`PLATFORM`).
    """

    p_world_dipole: Array
    """Places of the dipoles [m], shape (D, 3)."""

    height_m: float
    """Height of the sensor [m]."""

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return len(self.p_world_dipole) + 3 + PLATFORM

    def field(self, unknowns: Array) -> HarmonicField:
        """The unknowns as a field with its platform."""
        m, uniform, hard, soft, lever = self._parts(unknowns)
        moments = np.zeros((len(m), 3))
        moments[:, 2] = m
        return HarmonicField(
            p_world_dipole=self.p_world_dipole,
            m_world=moments,
            b_uniform_nt=uniform,
            hard_iron_nt=hard,
            soft_iron=soft,
            p_base_sensor=np.array([*lever, self.height_m]),
        )

    def vectors(self, p_world: Array) -> Array:
        """Derivatives of the field at points by the unknowns, in world axes, shape (N, 3, P).

        Args:
            p_world: Points [m], shape (N, 3).
        """
        rx, ry, rz, cubed, fifth = self._distances(p_world)
        jacobian = np.zeros((len(p_world), 3, self.size))
        count = len(self.p_world_dipole)
        fifth = fifth * rz
        jacobian[:, 0, :count] = fifth * rx
        jacobian[:, 1, :count] = fifth * ry
        jacobian[:, 2, :count] = fifth * rz - cubed
        jacobian[:, :, count : count + 3] = np.eye(3)
        return jacobian

    def read(self, unknowns: Array, p_xy: Array, yaw: Array, *, vectors: bool) -> Reading:
        """What the robot reads at poses, with all derivatives.

        Args:
            unknowns: Moments [A m^2], uniform field [nT] and platform, shape (P,).
            p_xy: Where base_link is [m], shape (N, 2).
            yaw: Headings [rad], shape (N,).
            vectors: Whether the field's parts in base_link are read, or its magnitude.
        """
        m, uniform, hard, soft, lever = self._parts(unknowns)
        turn, swing = _turns(yaw)
        at = np.column_stack([p_xy + turn[:, :2, :2] @ lever, np.full(len(p_xy), self.height_m)])
        rx, ry, rz, cubed, fifth = self._distances(at)
        b, slope = self._sums(m, at, rz[0], cubed, fifth)
        b += uniform
        whole = np.eye(3) + soft
        base = np.einsum("nji,nj->ni", turn, b)
        inner = base @ whole.T + hard
        out = np.broadcast_to(np.eye(3), (len(b), 3, 3))
        if not vectors:
            size = np.linalg.norm(inner, axis=1)
            out = (inner / size[:, None])[:, None, :]
        rows = out @ whole  # what a change of the field in base_link axes adds to what is read
        world = rows @ turn.transpose(0, 2, 1)
        by_place = world @ slope
        turned = np.einsum("nji,nj->ni", swing, b)
        carried = np.einsum("nji,njk,nk->ni", turn, slope[:, :, :2], swing[:, :2, :2] @ lever)
        count, parts = len(m), out.shape[1]
        jacobian = np.empty((len(b), parts, self.size))
        for c in range(parts):
            w = world[:, c, :, None]
            towards = w[:, 0] * rx
            towards += w[:, 1] * ry
            towards += w[:, 2] * rz
            towards *= rz
            towards *= fifth
            towards -= w[:, 2] * cubed
            jacobian[:, c, :count] = towards
        jacobian[:, :, count : count + 3] = world
        jacobian[:, :, count + 3 : count + 6] = out
        jacobian[:, :, count + 6 : count + 15] = (out[..., None] * base[:, None, None, :]).reshape(
            len(b), parts, 9
        )
        jacobian[:, :, count + 15 :] = by_place[:, :, :2] @ turn[:, :2, :2]
        values = inner if vectors else size[:, None]
        by_yaw = np.einsum("nci,ni->nc", rows, turned + carried)
        return Reading(values, jacobian, by_place[:, :, :2], by_yaw)

    def _parts(self, unknowns: Array) -> tuple[Array, Array, Array, Array, Array]:
        count = len(self.p_world_dipole)
        rest = unknowns[count:]
        return unknowns[:count], rest[:3], rest[3:6], rest[6:15].reshape(3, 3), rest[15:]

    def _distances(self, p: Array) -> tuple[Array, Array, Array, Array, Array]:
        """x, y and z of the ways from dipoles, 1 / r^3 and 3 / r^5 with the field's factor, (N, D) each."""
        q = self.p_world_dipole
        rx, ry, rz = (p[:, axis, None] - q[:, axis] for axis in range(3))
        inverse = 1 / (rx * rx + ry * ry + rz * rz)
        cubed = MU_0_OVER_4_PI * NT_PER_T * inverse * np.sqrt(inverse)
        return rx, ry, rz, cubed, 3 * cubed * inverse

    def _sums(self, m: Array, at: Array, rz: Array, cubed: Array, fifth: Array) -> tuple[Array, Array]:
        """Field (N, 3) and its gradient dB_a/dx_b (N, 3, 3), by products with sums over the dipoles.

        Every reading has the same height, so r_z is one number a dipole, and the powers of r_x = x - x_d
        come out of sums of the powers of x_d.
        """
        q = self.p_world_dipole[:, :2] - self.p_world_dipole[:, :2].mean(axis=0)
        x, y = (at[:, :2] - self.p_world_dipole[:, :2].mean(axis=0)).T
        one = np.column_stack([np.ones(len(q)), q])
        two = np.column_stack([one, q[:, 0] ** 2, q[:, 0] * q[:, 1], q[:, 1] ** 2])
        a = fifth @ ((m * rz)[:, None] * one)
        d = fifth @ (m[:, None] * one)
        seventh = fifth * (fifth / (3 * cubed))
        c = seventh @ ((5 * m * rz)[:, None] * two)
        e = seventh @ ((5 * m * rz**2)[:, None] * one)
        f = seventh @ (5 * m * rz**3)
        b = np.column_stack([x * a[:, 0] - a[:, 1], y * a[:, 0] - a[:, 2], fifth @ (m * rz**2) - cubed @ m])
        g = np.empty((len(at), 3, 3))
        g[:, 0, 0] = a[:, 0] - (x * x * c[:, 0] - 2 * x * c[:, 1] + c[:, 3])
        g[:, 1, 1] = a[:, 0] - (y * y * c[:, 0] - 2 * y * c[:, 2] + c[:, 5])
        g[:, 0, 1] = g[:, 1, 0] = -(x * y * c[:, 0] - y * c[:, 1] - x * c[:, 2] + c[:, 4])
        g[:, 0, 2] = g[:, 2, 0] = (x * d[:, 0] - d[:, 1]) - (x * e[:, 0] - e[:, 1])
        g[:, 1, 2] = g[:, 2, 1] = (y * d[:, 0] - d[:, 2]) - (y * e[:, 0] - e[:, 2])
        g[:, 2, 2] = 3 * a[:, 0] - f
        return b, g


def _turns(yaw: ArrayLike) -> tuple[Array, Array]:
    """Rotation matrices from base_link to world and their derivatives by the heading, (N, 3, 3) each."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.zeros((len(c), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = c
    turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = s, -s, 1.0
    return turn, turn @ SPIN
