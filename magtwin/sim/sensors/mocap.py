"""Motion capture: the pose that cameras about the room make of a robot's markers."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.frames import canonical, quat_from_rpy, quat_from_yaw, quat_multiply
from magtwin.sim.motion.sampling import Moving, check_count, held, moment_at
from magtwin.spec.sensors import MocapSpec

_ROUND = 64
"""Dropouts drawn at a time."""


def sense_mocap(
    spec: MocapSpec, height_m: float, motion: Moving, t: ArrayLike, rng: np.random.Generator
) -> dict[str, NDArray]:
    """Pose of base_link in world, off by where it is taken to be, with white noise, and dropouts in which
    the last pose is held.

    Args:
        spec: Rate, delays, offset, noise, and how often and how long the markers are not seen.
        height_m: Height of base_link above the floor [m].
        motion: What the robot did.
        t: Times of the readings [s], shape (N,).
        rng: Source of delays, noise and dropouts.

    Returns:
        mocap_p, mocap_q_xyzw (w >= 0) at `rate_hz`, held; flag_pose_lost, whether the newest sample that
        should have arrived was lost.
    """
    delays, noise, gaps = rng.spawn(3)
    stamps, latest = held(t, spec.rate_hz, latency_s=spec.latency_s, jitter_s=spec.jitter_s, rng=delays)
    pose = moment_at(motion, stamps).pose
    p = taken_for_base(spec, pose, height_m)
    white = noise.standard_normal((len(stamps), 6))
    q = quat_multiply(quat_from_yaw(pose[:, 2]), quat_from_rpy(spec.angle_noise_std * white[:, 3:]))
    lost = dropouts(spec, stamps, gaps)
    seen = np.maximum.accumulate(np.where(lost, 0, np.arange(len(stamps))))[latest]
    return {
        "mocap_p": (p + spec.p_noise_std_m * white[:, :3]).take(seen, axis=0),
        "mocap_q_xyzw": canonical(q).take(seen, axis=0),
        "flag_pose_lost": lost[latest],
    }


def taken_for_base(spec: MocapSpec, pose: NDArray[np.float64], height_m: float) -> NDArray[np.float64]:
    """Where base_link is taken to be in world [m], shape (N, 3), of where it is: x, y, yaw, shape (N, 3)."""
    forward, left = spec.offset_m
    cos, sin = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    x, y = pose[:, 0] - forward * cos + left * sin, pose[:, 1] - forward * sin - left * cos
    return np.column_stack([x, y, np.full(len(pose), height_m)])


def dropouts(spec: MocapSpec, stamps: ArrayLike, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Which samples are lost: times of sight and dropouts in turn, each exponentially distributed.

    Args:
        spec: Mean length of a dropout, and of the time between two.
        stamps: Times of the samples [s], shape (N,); the first is seen.
        rng: Source of the lengths, as many as it takes.
    """
    stamps = np.asarray(stamps, float)
    if not (spec.dropout_every_s and spec.dropout_s):
        return np.zeros(len(stamps), bool)
    each_s = spec.dropout_every_s + spec.dropout_s
    check_count("dropouts", stamps[-1] - stamps[0], 1 / each_s)
    edges = stamps[:1]
    while edges[-1] <= stamps[-1]:
        lengths = rng.exponential((spec.dropout_every_s, spec.dropout_s), (_ROUND, 2))
        edges = np.concatenate([edges, edges[-1] + np.cumsum(lengths)])
    lost = np.searchsorted(edges, stamps, side="right") % 2 == 0
    lost[0] = False
    return lost
