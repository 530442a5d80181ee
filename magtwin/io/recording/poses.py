"""Poses: of base_link at any time, from the poses of a bag."""

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.run.resample import linear, quaternion

Array = NDArray[np.float64]

GAP = 5.0  # Poses further apart than this multiple of their median interval are not interpolated between
LEAST_GAP_S = 0.1  # Poses closer than this are always interpolated between [s]
UNIT_WITHIN = 0.01  # Largest error of the length of a quaternion


def poses_at(t: Array, pose_t: Array, pose: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Interpolate poses (M, 7) at ascending times [s] (M,): positions linearly, orientations by slerp.

    Returns positions (N, 3), orientations xyzw (N, 4), and whether each time lies between two poses (N,).
    """
    sound = sound_poses(pose)
    pose_t, pose = pose_t[sound], pose[sound]
    if len(pose_t) < 2:
        return np.zeros((len(t), 3)), np.zeros((len(t), 4)), np.zeros(len(t), bool)
    steps = np.diff(pose_t)
    widest = max(GAP * float(np.median(steps)), LEAST_GAP_S)
    low = np.clip(np.searchsorted(pose_t, t, side="right") - 1, 0, len(steps) - 1)
    part = (t - pose_t[low]) / steps[low]
    bridged = (steps[low] <= widest) | (part == 0) | (part == 1)
    inside = (part >= 0) & (part <= 1) & bridged
    share = np.clip(part, 0, 1)
    q = pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    return linear(pose[:, :3], low, share), quaternion(q, low, share), inside


def sound_poses(pose: Array) -> NDArray[np.bool_]:
    """Whether each pose is finite and its quaternion of length 1, shape (M, 7) -> (M,)."""
    return np.isfinite(pose).all(axis=1) & (np.abs(np.linalg.norm(pose[:, 3:], axis=1) - 1) < UNIT_WITHIN)


def check_poses(pose_t: Array, pose: Array, where: str, topic: str) -> None:
    """Refuse poses of which less than two are sound, by what is wrong with the first."""
    bad = ~sound_poses(pose)
    if len(pose) < 2 or np.count_nonzero(~bad) >= 2:
        return
    first = int(np.argmax(bad))
    length = float(np.linalg.norm(pose[first, 3:]))
    fault = "its quaternion is 0,0,0,0" if length == 0 else f"the length of its quaternion is {length:.3g}"
    text = f"{np.count_nonzero(bad)} of {len(pose)} poses of {topic} cannot be used"
    advice = "record the orientation too, or choose another topic of poses"
    raise InputError(f"{where}: {text}, the first at {pose_t[first]:.3f} s: {fault}; {advice}")
