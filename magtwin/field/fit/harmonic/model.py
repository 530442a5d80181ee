"""HarmonicModel: a fitted harmonic field, what it predicts and how sure it is."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.fit.harmonic.forward import Forward
from magtwin.field.fit.harmonic.problem import Figures
from magtwin.field.fit.methods import FittedModel
from magtwin.field.grid import TURN
from magtwin.field.sources.harmonic import HarmonicField

Array = NDArray[np.float64]

BLOCK = 512
"""Poses predicted at a time."""

COARSE = 1 / 3
"""Distance between nodes whose variance is evaluated, at most, in the depth of the nearest layer."""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class HarmonicModel(FittedModel):
    """A harmonic field fitted to readings, and how sure it is."""

    field: HarmonicField
    """The field and the platform."""

    parameters: Mapping[str, Any]
    """Figures of the fit, by name with unit."""

    noise_nt2: float
    """Variance of one reading of the magnitude about the field, the mean over the survey [nT^2]."""

    figures: Figures
    """What was learnt beside the field."""

    forward: Forward
    """How readings follow from the unknowns."""

    unknowns: Array
    """The unknowns at the posterior's greatest, shape (P,)."""

    prior_sd: Array
    """Standard deviations of their priors, shape (P,)."""

    learnt: Array
    """What the readings tell of the unknowns, in units of `prior_sd`: the posterior's covariance is
    1 - learnt learnt^T there, shape (P, K)."""

    @property
    def method(self) -> str:
        """Name of the method."""
        return "harmonic"

    width: float
    """Factor of the magnitude's posterior variance where that is large beside the noise, see `widened`."""

    headings_rad: Array
    """Headings that were surveyed, ascending, where they are few and far apart; else none, shape (H,)."""

    turned: float
    """Variance that headings between them add, over (d g)^2 with d and g the angles to the two beside,
    as headings left out in turn show it [nT^2/rad^4]: a platform is more than iron. Few headings tell it
    loosely: of the APRILab survey's four, each left out, 73 % lie in the 90 % intervals that the other three
    give; `magtwin map check --split heading` says so of any survey."""

    def predict(self, p_xy: ArrayLike, yaw: ArrayLike) -> tuple[Array, Array]:
        """Field magnitude as the survey's robot reads it, and its variance.

        Args:
            p_xy: Where base_link is, in world [m], shape (..., 2).
            yaw: Headings [rad], shape (...); the two shapes are broadcast.

        Returns:
            Magnitude [nT] and its variance [nT^2], that of `noise_nt2` left out, each of shape (...).
        """
        p, yaw = np.asarray(p_xy, float), np.asarray(yaw, float)
        if p.ndim == 0 or p.shape[-1] != 2:
            raise InputError(f"p_xy must have shape (..., 2), got {p.shape}")
        shape = np.broadcast_shapes(p.shape[:-1], yaw.shape)
        p = np.broadcast_to(p, (*shape, 2)).reshape(-1, 2)
        yaw = np.broadcast_to(yaw, shape).reshape(-1)
        value, variance = np.empty(len(p)), np.empty(len(p))
        for start in range(0, len(p), BLOCK):
            part = slice(start, start + BLOCK)
            read = self.forward.read(self.unknowns, p[part], yaw[part], vectors=False)
            value[part] = read.values_nt[:, 0]
            variance[part] = widened(self._variance(read.jacobian[:, 0]), self.noise_nt2, self.width)
            variance[part] += self.turned * between(self.headings_rad, yaw[part])
        return value.reshape(shape), variance.reshape(shape)

    def predict_nodes(self, p_xy: Array, yaw: float) -> tuple[Array, Array]:
        """What `predict` gives on evenly spaced nodes, several times faster.

        On a fine grid the posterior's variance is evaluated at some nodes only, `COARSE` apart, and
        interpolated in its logarithm; it is then within some 5 % of its value at most nodes.

        Args:
            p_xy: Nodes of a grid [m], shape (Y, X, 2).
            yaw: One heading for all of them [rad].

        Returns:
            Magnitude [nT] and its variance [nT^2], each of shape (Y, X).
        """
        value, _ = self.field.magnitude_with_gradient(p_xy, yaw)
        depth = np.abs(self.forward.p_world_dipole[:, 2] - self.forward.height_m).min()
        cell = np.linalg.norm(p_xy[1, 0] - p_xy[0, 0]), np.linalg.norm(p_xy[0, 1] - p_xy[0, 0])
        strides = [max(1, int(COARSE * depth / step + 1e-9)) for step in cell]
        rows, columns = (
            np.unique([*range(0, n, stride), n - 1]) for n, stride in zip(value.shape, strides, strict=True)
        )
        coarse = p_xy[np.ix_(rows, columns)]
        p, variance = coarse.reshape(-1, 2), np.empty(coarse[..., 0].size)
        for start in range(0, len(p), BLOCK):
            part = slice(start, start + BLOCK)
            at = p[part]
            read = self.forward.read(self.unknowns, at, np.full(len(at), yaw), vectors=False)
            variance[part] = self._variance(read.jacobian[:, 0])
        log = np.log(np.maximum(variance, np.finfo(float).tiny)).reshape(coarse.shape[:2])
        every = [np.arange(n) for n in value.shape]
        log = np.array([np.interp(every[1], columns, row) for row in log])
        log = np.array([np.interp(every[0], rows, column) for column in log.T]).T
        whole = widened(np.exp(log), self.noise_nt2, self.width)
        return value, whole + self.turned * between(self.headings_rad, np.array([yaw]))

    def predict_vector(self, p_world: ArrayLike) -> tuple[Array, Array]:
        """The field without the robot, at any height between the layers of dipoles, and its variance.

        Args:
            p_world: Points [m], shape (..., 3).

        Returns:
            Field [nT] and the variance of each part [nT^2], in world axes, each of shape (..., 3).
        """
        p = np.asarray(p_world, float)
        value = self.field.field_nt(p)
        points, variance = p.reshape(-1, 3), np.empty(p.shape)
        flat = variance.reshape(-1, 3)
        for start in range(0, len(points), BLOCK):
            part = slice(start, start + BLOCK)
            rows = self.forward.vectors(points[part])
            flat[part] = self._variance(rows.reshape(-1, rows.shape[-1])).reshape(-1, 3)
        return value, variance

    def _variance(self, jacobian: Array) -> Array:
        """Posterior variances of what changes by `jacobian` (N, P) with the unknowns, shape (N,)."""
        scaled = jacobian * self.prior_sd
        told = scaled @ self.learnt
        left = np.einsum("np,np->n", scaled, scaled) - np.einsum("nk,nk->n", told, told)
        return np.asarray(np.maximum(left, 0))


def widened(variance_nt2: Array, noise_nt2: Array | float, width: Array | float) -> Array:
    """Posterior variances as places left out in turn show them to be.

    Beside readings, where the variance is small against the noise, the posterior is right. Away from
    them it is too modest, or too bold, by a factor, for the prior's layers are not the floor's iron.
    """
    return np.asarray(variance_nt2 * (noise_nt2 + width * variance_nt2) / (noise_nt2 + variance_nt2))


FAR_TURN = np.radians(60.0)
"""Gap between headings from which what lies in it counts as not surveyed."""

TURN_SECTORS = 24
"""Sectors into which headings are parted to see where a scattered survey has none."""

STRAY = 0.05
"""Largest share of the readings that a heading may have and still be ignored."""


def surveyed(yaw: Array) -> tuple[Array, NDArray[np.intp]]:
    """Group headings that lie together.

    Args:
        yaw: Headings of the readings [rad], shape (N,).

    Returns:
        Mean heading of each group [rad], ascending, shape (H,); and the group of each reading, -1 for a
        stray one, shape (N,). No groups where the headings are all around, or where there are fewer than 3.
    """
    angle = np.mod(yaw, TURN)
    sorted_angles = np.sort(angle)
    gap = np.diff(np.append(sorted_angles, sorted_angles[0] + TURN))
    wide = gap > TURN / TURN_SECTORS
    none = np.empty(0), np.full(len(yaw), -1)
    if gap.max() < FAR_TURN:
        return none
    edges = np.sort(np.mod(sorted_angles[wide] + gap[wide] / 2, TURN))
    group = np.searchsorted(edges, angle) % len(edges)
    count = np.bincount(group, minlength=len(edges))
    whole = np.flatnonzero(count > STRAY * len(yaw))
    if len(whole) < 3:
        return none
    mean = np.array([np.angle(np.exp(1j * angle[group == k]).sum()) for k in whole]) % TURN
    order = np.argsort(mean)
    rank = np.full(len(edges), -1)
    rank[whole[order]] = np.arange(len(whole))
    return mean[order], rank[group]


def between(headings_rad: Array, yaw: Array) -> Array:
    """(d g)^2, where d and g are the angles from a heading to the nearest surveyed one on each side.

    Args:
        headings_rad: Surveyed headings [rad], shape (H,); with none of them the result is 0.
        yaw: Headings to look at [rad], shape (N,).

    Returns:
        Squared product of the two angles [rad^4], shape (N,).
    """
    if not len(headings_rad):
        return np.zeros(len(yaw))
    up = np.mod(headings_rad[:, None] - yaw, TURN).min(axis=0)
    down = np.mod(yaw - headings_rad[:, None], TURN).min(axis=0)
    return np.asarray((up * down) ** 2)
