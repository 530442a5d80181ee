"""PoseError: the error of the pose that a path follower gets, as from a real robot's localization."""

import math
from dataclasses import dataclass

import numpy as np

from magtwin.sim.motion import loop
from magtwin.spec.drive import DriveSpec

FASTEST = 4.0
"""Highest W T of a wave."""


@dataclass(frozen=True)
class PoseError:
    """Latency and error of the pose in one run; `magtwin.sim.motion.loop.perceived` applies them."""

    figures: tuple[float, ...] = (0.0,) * (4 + 6 * loop.WAVES)
    """Figures for `perceived`; all 0 for an exact pose."""

    def perceived(
        self, t: float, pose: tuple[float, float, float], v: float, w: float
    ) -> tuple[float, float, float]:
        """The pose that a controller gets.

        Args:
            t: Time since the start [s].
            pose: True x [m], y [m], yaw [rad] in world.
            v: Forward speed [m/s].
            w: Yaw rate [rad/s].
        """
        return loop.perceived(self.figures, t, *pose, v, w)

    def reach_m(self, v_max: float) -> float:
        """Distance by which the pose that a controller gets may well be off at a speed [m]."""
        latency, position, *_ = self.figures
        return latency * v_max + 4 * position * math.sqrt(loop.WAVES / 2)


EXACT = PoseError()
"""No error."""


def draw_pose_error(drive: DriveSpec, rng: np.random.Generator) -> PoseError:
    """The error of one run, from the figures `localization_*` of a drive.

    A Gauss-Markov process of correlation time T has the spectrum 1 / (1 + (W T)^2), so the frequencies of its
    waves are W = tan(u) / T with u drawn evenly, one from each third of its range. W T is at most `FASTEST`,
    since localizations are filtered.
    """
    waves = loop.WAVES
    u = (np.arange(waves) + rng.random((3, waves))) / waves
    frequency = np.tan(u * math.atan(FASTEST)) / drive.localization_time_s
    phase = rng.uniform(0.0, 2 * np.pi, (3, waves))
    share = math.sqrt(2.0 / waves)
    position, yaw = share * drive.localization_std_m, share * drive.localization_yaw_std
    drawn = np.stack([frequency, phase], axis=-1).ravel().tolist()
    return PoseError((drive.localization_latency_s, position, position, yaw, *drawn))
