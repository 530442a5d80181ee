"""Forward model: what a robot reads above layers of dipoles, and its derivatives by every unknown."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.sources.compiled_dipoles import dipole_field_and_gradient_nt, moment_rows
from magtwin.field.sources.harmonic import HarmonicField

Array = NDArray[np.float64]

# Orthonormal components of soft iron: six off the diagonal, two on it. The trace is left out: it cannot be
# told from the strength of the field, and the prior of the moments would make it grow.
SOFT = np.zeros((8, 3, 3))
SOFT[np.arange(6), [0, 0, 1, 1, 2, 2], [1, 2, 0, 2, 0, 1]] = 1.0
SOFT[6] = np.diag([1.0, -1.0, 0.0]) / np.sqrt(2)
SOFT[7] = np.diag([1.0, 1.0, -2.0]) / np.sqrt(6)
SOFT.flags.writeable = False

PLATFORM = 13  # Unknowns of the platform: hard iron (3), soft iron (8, see `SOFT`), lever arm (2)
# dR/dyaw = R SPIN for rotations about z
SPIN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Reading:
    """Predicted readings with C components each: 1 for magnitudes, 3 for vectors."""

    values_nt: Array  # Predicted values [nT], shape (N, C)
    jacobian: Array  # Derivatives by the unknowns, shape (N, C, P)
    by_place: Array  # Derivatives by x and y of the robot [nT/m], shape (N, C, 2)
    by_yaw: Array  # Derivative by the heading [nT/rad], shape (N, C)


@dataclass(frozen=True, eq=False)
class Forward:
    """Dipoles, a uniform field and a platform; the sensor moves in the plane at `height_m`.

    The unknowns are, in order, the moments, dipole by dipole (3 D), the uniform field B_0 (3) and the
    platform's h, S and l (`PLATFORM`), and the field per unit of each signal, in base_link axes (3 K).
    """

    p_world_dipole: Array  # Dipole positions [m], shape (D, 3)
    height_m: float  # Height of the sensor [m]
    # Trace of the soft iron, if it is known: no unknown has a part in it, see `SOFT`
    soft_iron_trace: float = 0.0
    signals: int = 0  # Number of signals of the robot, each with a field along three axes

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 3 * (len(self.p_world_dipole) + 1 + self.signals) + PLATFORM

    def field(self, unknowns: Array) -> HarmonicField:
        """The unknowns as a field with its platform."""
        m, uniform, hard, soft, lever, _ = self._parts(unknowns)
        return HarmonicField(
            p_world_dipole=self.p_world_dipole,
            m_world=m,
            b_uniform_nt=uniform,
            hard_iron_nt=hard,
            soft_iron=soft,
            p_base_sensor=np.array([*lever, self.height_m]),
        )

    def vectors(self, p_world: Array) -> Array:
        """Derivatives of the field at points (N, 3) [m] by the unknowns, in world axes, shape (N, 3, P)."""
        p, count = np.ascontiguousarray(p_world, float), 3 * len(self.p_world_dipole)
        jacobian = np.zeros((len(p), 3, self.size))
        moment_rows(p, self.p_world_dipole, np.tile(np.eye(3), (len(p), 1, 1)), jacobian)
        jacobian[:, :, count : count + 3] = np.eye(3)
        return jacobian

    def read(
        self, unknowns: Array, p_xy: Array, yaw: Array, signals: Array | None = None, *, vectors: bool
    ) -> Reading:
        """What the robot reads at poses of base_link, with all derivatives.

        The unknowns have shape (P,), the signals (N, K); without signals it stands with its LiDAR off. With
        `vectors`, it reads them in base_link axes, otherwise magnitudes.
        """
        m, uniform, hard, soft, lever, own = self._parts(unknowns)
        turn, swing = _turns(yaw)
        at = np.column_stack([p_xy + turn[:, :2, :2] @ lever, np.full(len(p_xy), self.height_m)])
        b, slope = dipole_field_and_gradient_nt(at, self.p_world_dipole, m)
        b += uniform
        whole = np.eye(3) + soft
        base = np.einsum("nji,nj->ni", turn, b)
        inner = base @ whole.T + hard
        if signals is not None:
            inner += signals @ own
        out = np.broadcast_to(np.eye(3), (len(b), 3, 3))
        if not vectors:
            size = np.linalg.norm(inner, axis=1)
            out = (inner / size[:, None])[:, None, :]
        rows = out @ whole  # what a change of the field in base_link axes adds to what is read
        world = rows @ turn.transpose(0, 2, 1)
        by_place = world @ slope
        turned = np.einsum("nji,nj->ni", swing, b)
        carried = np.einsum("nji,njk,nk->ni", turn, slope[:, :, :2], swing[:, :2, :2] @ lever)
        count, parts = m.size, out.shape[1]
        jacobian = np.empty((len(b), parts, self.size))
        moment_rows(at, self.p_world_dipole, world, jacobian)
        jacobian[:, :, count : count + 3] = world
        jacobian[:, :, count + 3 : count + 6] = out
        jacobian[:, :, count + 6 : count + 14] = np.einsum("nci,kij,nj->nck", out, SOFT, base, optimize=True)
        jacobian[:, :, count + 14 : count + 16] = by_place[:, :, :2] @ turn[:, :2, :2]
        jacobian[:, :, count + 16 :] = 0.0
        if signals is not None:
            each = jacobian[:, :, count + 16 :].reshape(len(b), parts, self.signals, 3)
            each[:] = signals[:, None, :, None] * out[:, :, None, :]
        values = inner if vectors else size[:, None]
        by_yaw = np.einsum("nci,ni->nc", rows, turned + carried)
        return Reading(values, jacobian, by_place[:, :, :2], by_yaw)

    def _parts(self, unknowns: Array) -> tuple[Array, Array, Array, Array, Array, Array]:
        count = 3 * len(self.p_world_dipole)
        rest = unknowns[count:]
        return (
            unknowns[:count].reshape(-1, 3),
            rest[:3],
            rest[3:6],
            np.tensordot(rest[6:14], SOFT, 1) + self.soft_iron_trace / 3 * np.eye(3),
            rest[14:16],
            rest[16:].reshape(-1, 3),
        )


def _turns(yaw: ArrayLike) -> tuple[Array, Array]:
    """Rotation matrices from base_link to world and their derivatives by the heading, (N, 3, 3) each."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.zeros((len(c), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = c
    turn[:, 1, 0], turn[:, 0, 1], turn[:, 2, 2] = s, -s, 1.0
    return turn, turn @ SPIN
