"""Problem: the readings and fixed priors of a harmonic fit, and the hyperparameters that it learns."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.field.fit.harmonic.forward import SOFT, Forward, Reading
from magtwin.field.fit.harmonic.layers import DEPTH_SPACINGS, Layers
from magtwin.field.fit.passes import by_pass
from magtwin.field.survey.bins import means
from magtwin.field.survey.onboard import prior_sd_nt
from magtwin.field.survey.readings import Readings

Array = NDArray[np.float64]

WEAK = 0.1  # Initial strength of layers above relative to layers below: what both can explain is put below
# Compass directions and dip of the starts beside straight down, if the Earth's field is unknown: several
# fields explain magnitudes, and the steps find the nearest one
BEGINNINGS, BEGUN_DIP = 4, np.radians(60.0)
EARTH_SD_NT = 1000.0  # Prior standard deviation of the uniform field about the Earth's, per component [nT]
# Prior standard deviations of the platform's unknowns, about 0
HARD_IRON_SD_NT, SOFT_IRON_SD, LEVER_SD_M = 3000.0, 0.03, 0.05
# Length of the headings' mean vector from which they count as one: a spread of at most 8 deg
ONE_HEADING = 0.99
STRETCHES = 10  # Parts of a drive that a jackknife leaves out in turn


@dataclass(frozen=True, kw_only=True, eq=False)
class Hyperparameters:
    """Hyperparameters of a fit."""

    noise_nt: float  # Noise of a reading, or of a mean of several [nT]
    position_m: float  # Error of a recorded position, per axis [m]
    heading_rad: float  # Error of a recorded heading [rad]
    freedom: float  # Degrees of freedom of Student's t
    strength: Array  # Prior standard deviation of each component of each dipole's moment [A m^2], shape (D,)

    def change(self, before: "Hyperparameters") -> float:
        """Logarithmic difference to other hyperparameters: of the noise, or RMS of the strengths."""
        moved = np.sqrt(np.mean(np.log(self.strength / before.strength) ** 2))
        return float(max(abs(np.log(self.noise_nt / before.noise_nt)), moved))

    def variance(self, reading: Reading) -> Array:
        """Squared scale of each component of readings [nT^2], shape (N, C)."""
        return np.asarray(self.terms(reading).sum(axis=-1))

    def terms(self, reading: Reading) -> Array:
        """Parts of `variance` from noise, position and heading [nT^2], shape (N, C, 3)."""
        place = self.position_m**2 * np.sum(reading.by_place**2, axis=-1)
        heading = self.heading_rad**2 * reading.by_yaw**2
        return np.stack([np.full_like(place, self.noise_nt**2), place, heading], axis=-1)


# Why magnitudes of a robot that turns about the vertical alone leave the vector field open
UNTOLD = (
    "unknown: from magnitudes, turns about the vertical do not tell hard iron, soft iron and the uniform "
    "field apart; a known platform does (hard_iron_nt and soft_iron of the fit), and so would turns about a "
    "second axis; the Earth's field does not, since the building adds a uniform part to it"
)


@dataclass(frozen=True, kw_only=True)
class Platform:
    """The robot's own field, where it is known."""

    hard_iron_nt: Array  # Hard iron in base_link axes [nT], shape (3,)
    soft_iron: Array  # Soft iron [nT per nT], shape (3, 3)


@dataclass(frozen=True, eq=False)
class Problem:
    """The readings and the fixed priors."""

    forward: Forward
    layers: Layers
    p_xy: Array
    yaw: Array
    read_nt: Array  # (N, C)
    signals: Array | None  # (N, K)
    cell: NDArray[np.intp]  # of each good reading
    passes: NDArray[np.intp] | None  # pass of each row of a drive, (N,); None if rows are not parts of one
    mean: Array  # of the unknowns' priors
    rest_sd: Array  # standard deviations of the priors of all unknowns but the moments
    begins: list[Array]  # uniform fields to begin with
    untold: str = ""  # Why the vector field is unknown; "" if it is known

    @classmethod
    def of(
        cls,
        good: Readings,
        layers: Layers,
        height: float,
        earth_nt: Sequence[float] | None,
        platform: Platform | None = None,
    ) -> "Problem":
        """The problem of good readings over layers of dipoles."""
        read = good.b_nt[:, None] if good.b_body_nt is None else good.b_body_nt
        cell, follow = means(good, min(map(abs, layers.depths)))
        size = np.bincount(cell)
        passes = by_pass(good).run[np.unique(cell, return_index=True)[1]] if follow else None

        def mean(values: Array) -> Array:
            return np.asarray(np.bincount(cell, values) / size)

        read = np.column_stack([mean(part) for part in read.T])
        p = np.column_stack([mean(good.p_xy[:, 0]), mean(good.p_xy[:, 1])])
        yaw = np.arctan2(mean(np.sin(good.yaw)), mean(np.cos(good.yaw)))
        signals = None if good.signals is None else np.column_stack([mean(s) for s in good.signals.T])
        typical = float(np.median(good.b_nt))
        uniform, sd = np.array([0.0, 0.0, -typical]), typical / 2
        level, down = typical * np.cos(BEGUN_DIP), typical * np.sin(BEGUN_DIP)
        angles = 2 * np.pi * np.arange(BEGINNINGS) / BEGINNINGS
        begins = [uniform, *(np.array([level * np.cos(a), level * np.sin(a), -down]) for a in angles)]
        if earth_nt is not None:
            uniform, sd = np.asarray(earth_nt, float), EARTH_SD_NT
            begins = [uniform]
        elif good.b_body_nt is not None:
            c, s = np.cos(yaw), np.sin(yaw)
            turned = [c * read[:, 0] - s * read[:, 1], s * read[:, 0] + c * read[:, 1], read[:, 2]]
            uniform = np.array([part.mean() for part in turned])
            begins = [uniform]
        trace = 0.0 if platform is None else float(np.trace(platform.soft_iron))
        forward = Forward(layers.p_world_dipole, height, trace, len(good.signal_names))
        prior = np.zeros(forward.size)
        count = 3 * len(layers.p_world_dipole)
        prior[count : count + 3] = uniform
        rest = np.repeat([sd, HARD_IRON_SD_NT, SOFT_IRON_SD, LEVER_SD_M], [3, 3, 8, 2])
        if abs(np.mean(np.exp(1j * yaw))) > ONE_HEADING:
            rest[3:] = 0.0  # a platform that never turned cannot be told from the field
        if platform is not None:
            prior[count + 3 : count + 6] = platform.hard_iron_nt
            prior[count + 6 : count + 14] = np.tensordot(SOFT, platform.soft_iron, 2) / np.sum(
                SOFT**2, (1, 2)
            )
            rest[3:14] = 0.0
        rest = np.append(rest, np.repeat(prior_sd_nt(good.signal_names), 3))
        untold = UNTOLD if platform is None and good.b_body_nt is None else ""
        return cls(forward, layers, p, yaw, read, signals, cell, passes, prior, rest, begins, untold)

    @property
    def vectors(self) -> bool:
        """Whether vectors are read, not magnitudes."""
        return self.read_nt.shape[1] == 3

    def places(self) -> list[NDArray[np.intp]]:
        """Rows of reading components that lie together: at one node, or within a spacing."""
        side = abs(self.layers.depths[0]) / DEPTH_SPACINGS
        square = np.floor(self.p_xy / side + 0.5).astype(np.int64)
        _, place = np.unique(square, axis=0, return_inverse=True)
        return self._grouped(place.ravel())

    def stretches(self) -> list[NDArray[np.intp]]:
        """Rows of reading components of `STRETCHES` parts of a drive; none if rows are not parts of one."""
        if self.passes is None or len(self.passes) < 2 * STRETCHES:
            return []
        return self._grouped(np.arange(len(self.passes)) * STRETCHES // len(self.passes))

    def met(self) -> tuple[list[NDArray[np.intp]], NDArray[np.bool_]]:
        """Rows of reading components of each pass, and the rows within a spacing of another pass, (R,).

        Both are empty if no two passes meet, or the readings are not of a drive.
        """
        from scipy.spatial import cKDTree

        none = list[NDArray[np.intp]](), np.zeros(0, bool)
        if self.passes is None or np.ptp(self.passes) == 0:
            return none
        side, near = abs(self.layers.depths[0]) / DEPTH_SPACINGS, np.zeros(len(self.p_xy), bool)
        for name in np.unique(self.passes):
            own = self.passes == name
            near[own] = cKDTree(self.p_xy[~own]).query(self.p_xy[own])[0] <= side
        if not near.any():
            return none
        return self._grouped(self.passes), np.repeat(near, self.read_nt.shape[1])

    def _grouped(self, group: NDArray[np.intp]) -> list[NDArray[np.intp]]:
        """Rows of reading components, by the groups (N,) of their readings."""
        rows = np.arange(self.read_nt.size).reshape(self.read_nt.shape)
        order = np.argsort(group, kind="stable")
        ends = np.flatnonzero(np.diff(group[order])) + 1
        return [rows[part].ravel() for part in np.split(order, ends)]

    def at(self, unknowns: Array) -> Reading:
        """Predictions for every row, with derivatives."""
        return self.forward.read(unknowns, self.p_xy, self.yaw, self.signals, vectors=self.vectors)

    def first(self) -> Hyperparameters:
        """Initial hyperparameters: strengths that give the field's spread, and small noises."""
        spread = float(self.read_nt.std(axis=0).max())
        depth = np.array(self.layers.depths)[self.layers.layer]
        above = depth < 0
        # a white layer of density s per metre makes a field of variance 3 (1e2 s)^2 pi / (8 d^4) or so
        density = max(spread, 1.0) * depth**2 / 100
        return Hyperparameters(
            noise_nt=max(spread, 5.0) / 50,
            position_m=0.01,
            heading_rad=0.02 if np.any(self.rest_sd[3:]) else 0.0,
            freedom=8.0,
            strength=density * np.sqrt(self.layers.area_m2) * np.where(above, WEAK, 1.0),
        )
