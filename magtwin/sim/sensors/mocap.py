"""Motion capture: the pose that cameras in the room measure of a robot's markers."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.frames import canonical, quat_from_rpy, quat_from_yaw, quat_multiply
from magtwin.sim.motion.drive import Moment
from magtwin.sim.motion.sampling import check_count
from magtwin.sim.sensors.clock import Array, Columns, SampleClock, SampledSensor
from magtwin.spec.sensors import MocapSpec

_ROUND = 64
"""Dropouts drawn at a time."""


class Mocap(SampledSensor):
    """Pose of base_link in world with white noise, a constant offset, and dropouts.

    In a dropout the last pose is held. Columns: mocap_p, mocap_q_xyzw (w >= 0), and flag_pose_lost, true if
    the newest sample that should have arrived was lost.
    """

    def __init__(self, spec: MocapSpec, height_m: float, rng: np.random.Generator) -> None:
        """Begin before the first sample."""
        delays, noise, gaps = rng.spawn(3)
        super().__init__(noise)
        self._spec, self._height = spec, height_m
        self._dropouts = Dropouts(spec, gaps)
        self._seen = np.zeros((1, 7))
        self.clock = SampleClock(spec.rate_hz, spec.latency_s, spec.jitter_s, delays)

    def sample(self, stamps: Array, now: Moment) -> Columns:
        """As for `SampledSensor`, for one robot."""
        spec, pose = self._spec, now.pose
        white = self.normal(len(stamps), 6)
        p = markers_p_world(spec, pose, self._height) + spec.p_noise_std_m * white[:, :3]
        q = quat_multiply(quat_from_yaw(pose[:, 2]), quat_from_rpy(spec.angle_noise_std * white[:, 3:]))
        lost = self._dropouts.lost(stamps)
        latest = np.maximum.accumulate(np.where(lost, 0, np.arange(1, len(stamps) + 1)))
        held = np.concatenate([self._seen, np.concatenate([p, canonical(q)], axis=1)])[latest]
        self._seen = held[-1:]
        return {"mocap_p": held[:, :3], "mocap_q_xyzw": held[:, 3:], "flag_pose_lost": lost}


def markers_p_world(spec: MocapSpec, pose: Array, height_m: float) -> Array:
    """Where motion capture sees base_link in world [m], for true poses x, y, yaw; (N, 3) -> (N, 3)."""
    forward, left = spec.offset_m
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y = pose[:, 0] - forward * cos + left * sin, pose[:, 1] - forward * sin - left * cos
    return np.column_stack([x, y, np.full(len(pose), height_m)])


class Dropouts:
    """Which samples are lost: times of sight and dropouts alternate, each exponentially distributed."""

    def __init__(self, spec: MocapSpec, rng: np.random.Generator) -> None:
        """Begin in sight."""
        self._means_s, self._rng = (spec.dropout_every_s, spec.dropout_s), rng
        self._edges = np.zeros(0)

    def lost(self, stamps: ArrayLike) -> NDArray[np.bool_]:
        """Whether each of the next samples is lost; the first of all is not."""
        stamps = np.asarray(stamps, float)
        if not all(self._means_s) or not len(stamps):
            return np.zeros(len(stamps), bool)
        check_count("dropouts", stamps[-1] - stamps[0], 1 / sum(self._means_s))
        if not len(self._edges):
            self._edges = stamps[:1]
        while self._edges[-1] <= stamps[-1]:
            lengths = self._rng.exponential(self._means_s, (_ROUND, 2))
            self._edges = np.concatenate([self._edges, self._edges[-1] + np.cumsum(lengths)])
        return np.asarray(np.searchsorted(self._edges, stamps, side="right") % 2 == 0)
