"""HarmonicModel: a fitted harmonic field, its predictions and their variance."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.fit.harmonic.forward import Forward
from magtwin.field.fit.harmonic.layers import Layers
from magtwin.field.fit.harmonic.problem import Hyperparameters
from magtwin.field.fit.methods import FittedModel
from magtwin.field.fit.nodes import variance_at_nodes
from magtwin.field.grid import TURN
from magtwin.field.sources.harmonic import HarmonicField
from magtwin.field.survey.axes import WORLD, SurveyAxes

Array = NDArray[np.float64]

BLOCK = 512  # Poses predicted at a time
# Largest distance between nodes at which the variance is computed, in the depth of the nearest layer
COARSE = 1 / 3
# Factor of the posterior variance of vectors, chosen on surveys of the default lab with a known platform:
# magnitudes do not tell it. No factor is right at every spacing (docs/maps.md, `benchmarks/intervals.py`).
VECTOR_WIDTH = 2.0


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class HarmonicModel(FittedModel):
    """A harmonic field fitted to readings, with its uncertainty."""

    field: HarmonicField  # The field and the platform
    parameters: Mapping[str, Any]  # Hyperparameters and unknowns, by name with unit
    noise_nt2: float  # Variance of one reading of the magnitude about the field, mean over the survey [nT^2]
    figures: Hyperparameters  # Hyperparameters
    forward: Forward  # How readings follow from the unknowns
    layers: Layers  # Layers of its dipoles
    unknowns: Array  # Most likely unknowns, shape (P,)
    prior_sd: Array  # Prior standard deviations of the unknowns, shape (P,)
    # Information of the readings: in units of `prior_sd` the posterior covariance is 1 - learnt learnt^T,
    # shape (P, K)
    learnt: Array
    # Spread of the unknowns, in units of `prior_sd`, between fits without a stretch of the drive each, by the
    # block jackknife (Efron & Tibshirani 1993, section 11.5), shape (P, G): G is 0 if no signals of the robot
    # are fitted. What their fields lack, such as a delay, is no noise, and differs between stretches.
    spread: Array
    width: float  # Factor of the posterior variance where it is large against the noise, see `widened`
    headings_rad: Array  # Surveyed headings, ascending, if they are few and far apart; else empty, shape (H,)
    # Added variance between these headings, over (d g)^2 with the angles d and g to the two beside, estimated
    # from headings left out in turn [nT^2/rad^4]. Few headings determine it loosely: of the APRILab survey's
    # four, each left out, 73 % of the readings lie in the 90 % intervals from the other three.
    turned: float
    signals: tuple[str, ...] = ()  # Names of the signals of the robot whose fields were fitted
    untold: str = ""  # Why the vector field is unknown; "" if it is known
    method: str = "harmonic"  # Name of the method
    axes: SurveyAxes = WORLD  # Axes of `forward`, `layers`, `unknowns`, `prior_sd`, `learnt`, `headings_rad`

    def predict(self, p_xy: ArrayLike, yaw: ArrayLike, signals: Array | None = None) -> tuple[Array, Array]:
        """Field magnitude as the survey's robot reads it [nT], and its variance without noise [nT^2]. See
        `FieldModel`. Without signals (N, K) of its drive, the robot stands with its LiDAR off.
        """
        p, yaw, shape = self.own_poses(p_xy, yaw)
        value, variance = self._read(p, yaw, signals)
        return value.reshape(shape), self._corrected(variance, yaw).reshape(shape)

    def placed(self, axes: SurveyAxes) -> "HarmonicModel":
        """The model for poses in world, with its field in world, if it was fitted in `axes`."""
        turn, field, count = np.eye(3), self.field, self.field.m_world.size
        turn[:2, :2] = axes.turn
        uniform = turn @ field.b_uniform_nt
        rows = np.zeros((3, len(self.unknowns)))
        rows[:, count : count + 3] = turn
        return replace(
            self,
            axes=axes,
            field=replace(
                field,
                p_world_dipole=np.column_stack(
                    [axes.world_xy(field.p_world_dipole[:, :2]), field.p_world_dipole[:, 2]]
                ),
                m_world=field.m_world @ turn.T,
                b_uniform_nt=uniform,
            ),
            parameters={
                **self.parameters,
                "uniform field [nT]": np.round(uniform, 1).tolist(),
                "uniform field, sd [nT]": np.round(np.sqrt(self._variance(rows)), 1).tolist(),
            },
        )

    def predict_nodes(self, p_xy: Array, yaw: float) -> tuple[Array, Array]:
        """`predict` on evenly spaced nodes, several times faster.

        On a fine grid the variance is computed only at nodes `COARSE` apart, and interpolated.
        """
        value = self.field.magnitude_nt(p_xy, yaw, compiled=True)
        depth = np.abs(self.forward.p_world_dipole[:, 2] - self.forward.height_m).min()
        turned = np.array([yaw]) - self.axes.yaw_rad
        variance = variance_at_nodes(
            p_xy, COARSE * depth, lambda p: self._read(*self.own_poses(p, yaw)[:2])[1]
        )
        return value, self._corrected(variance, turned)

    def predict_values(self, p_xy: ArrayLike, yaw: ArrayLike) -> Array:
        """The magnitude of `predict` alone, many times faster."""
        return self.field.magnitude_nt(p_xy, yaw)

    def predict_vector(self, p_world: ArrayLike) -> tuple[Array, Array]:
        """Field without the robot, at any height between the layers of dipoles, and its variance.

        Of a survey of magnitudes, it is known only with the platform (options `hard_iron_nt` and `soft_iron`
        of the fit): turns about the vertical do not tell hard iron, soft iron and the uniform field apart,
        whether the Earth's field is known or not. `untold` and the parameter "vector field" say so. Of a
        survey of vectors, hard iron z and the uniform field z are shared out by their priors alone.

        Args:
            p_world: Points [m], shape (..., 3).

        Returns:
            Field [nT] and the variance of each component [nT^2], in world axes, each of shape (..., 3); nan
            and infinite where the vector field is unknown.
        """
        p = np.asarray(p_world, float)
        if self.untold:
            return np.full(p.shape, np.nan), np.full(p.shape, np.inf)
        value = self.field.field_nt(p)
        points, variance = p.reshape(-1, 3).copy(), np.empty(p.shape)
        points[:, :2] = self.axes.own_poses(points[:, :2], 0.0)[0]
        flat = variance.reshape(-1, 3)
        for start in range(0, len(points), BLOCK):
            part = slice(start, start + BLOCK)
            rows = self.forward.vectors(points[part])
            rows[:, :2] = np.einsum("ij,njp->nip", self.axes.turn, rows[:, :2])
            flat[part] = VECTOR_WIDTH * self._variance(rows.reshape(-1, rows.shape[-1])).reshape(-1, 3)
        return value, variance

    def _read(self, p: Array, yaw: Array, signals: Array | None = None) -> tuple[Array, Array]:
        """Magnitude [nT] and its posterior variance [nT^2] at poses (N, 2), (N,)."""
        value, variance = np.empty(len(p)), np.empty(len(p))
        for start in range(0, len(p), BLOCK):
            part = slice(start, start + BLOCK)
            some = None if signals is None else signals[part]
            read = self.forward.read(self.unknowns, p[part], yaw[part], some, vectors=False)
            value[part], variance[part] = read.values_nt[:, 0], self._variance(read.jacobian[:, 0])
        return value, variance

    def _corrected(self, variance: Array, yaw: Array) -> Array:
        whole = widened(variance, self.noise_nt2, self.width)
        return whole + self.turned * between(self.headings_rad, yaw)

    def _variance(self, jacobian: Array) -> Array:
        """Posterior variances of linear functions `jacobian` (N, P) of the unknowns, shape (N,)."""
        scaled = jacobian * self.prior_sd
        known, apart = scaled @ self.learnt, scaled @ self.spread
        left = np.einsum("np,np->n", scaled, scaled) - np.einsum("nk,nk->n", known, known)
        left += np.einsum("ng,ng->n", apart, apart)
        return np.asarray(np.maximum(left, 0))


def widened(variance_nt2: Array, noise_nt2: Array | float, width: Array | float) -> Array:
    """Posterior variances, corrected by positions left out in turn.

    Near readings, where the variance is small against the noise, the posterior is right. Away from them it is
    off by a factor, since the prior's layers are not the floor's iron.
    """
    return np.asarray(variance_nt2 * (noise_nt2 + width * variance_nt2) / (noise_nt2 + variance_nt2))


FAR_TURN = np.radians(60.0)  # Gap between headings that counts as not surveyed
TURN_SECTORS = 24  # Heading sectors in which gaps of a scattered survey are found
STRAY = 0.05  # Largest share of readings at a heading that is ignored


def surveyed(yaw: Array) -> tuple[Array, NDArray[np.intp]]:
    """Mean headings of groups of headings that lie together [rad], (H,), and each reading's group, (N,).

    Strays are in group -1. There are no groups if the headings are all around, or fewer than 3.
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
    """(d g)^2 for the angles d and g from each heading to the surveyed ones beside it [rad^4], shape (N,).

    It is 0 without surveyed headings.
    """
    if not len(headings_rad):
        return np.zeros(len(yaw))
    up = np.mod(headings_rad[:, None] - yaw, TURN).min(axis=0)
    down = np.mod(yaw - headings_rad[:, None], TURN).min(axis=0)
    return np.asarray((up * down) ** 2)
