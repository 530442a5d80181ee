"""Poses: of base_link at any time, from the poses of a bag."""

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import quat_multiply, rotate, yaw_from_quat
from magtwin.io.bags.bag import Bag, Signal
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.frames import plain
from magtwin.io.bags.topics import TF, TF_STATIC
from magtwin.run.resample import linear, quaternion

Array = NDArray[np.float64]

GAP = 5.0
"""Poses further apart than this multiple of their median interval are not interpolated between."""

LEAST_GAP_S = 0.1
"""Poses closer than this are always interpolated between [s]."""

MOVED_M, MOVED_RAD = 0.001, 0.002
"""Correction of odometry by transforms below which there is none [m], [rad]."""

UNIT_WITHIN = 0.01
"""Largest error of the length of a quaternion."""


def corrected(bag: Bag, odometry: Signal) -> tuple[Signal, str] | None:
    """Odometry in the frame against which transforms of the bag move its own, and how; None if none do.

    With map to odom of a localizer or SLAM, p_map_base = p_map_odom + rotate(q_map_odom, p_odom_base).
    Between transforms it is interpolated, and beyond them it is the nearest one.
    """
    frame = bag.frames(odometry)[0]
    found: dict[str, list[tuple[int, Array]]] = {}
    for each in bag.transforms(TF.name, TF_STATIC.name) if frame else ():
        for row, child in enumerate(each.children):
            if plain(child) == frame:
                pose = np.append(each.p[row], each.q_xyzw[row])
                found.setdefault(plain(each.parents[row]), []).append((int(each.stamps[row]), pose))
    if len(found) != 1 or odometry.stamps is None:
        return None
    ((parent, moves),) = found.items()
    ns, first = np.unique([stamp for stamp, _ in moves], return_index=True)
    pose = np.array([moves[row][1] for row in first])
    if len(ns) == 1:
        ns, pose = np.append(ns, ns + NS), np.repeat(pose, 2, axis=0)
    # from the first stamp, so that a float holds the times to the nanosecond
    p, q, _ = poses_at((odometry.stamps - ns[0]) / NS, (ns - ns[0]) / NS, pose)
    far = float(np.hypot(p[:, 0], p[:, 1]).max())
    turn = float(np.abs(yaw_from_quat(q)).max())
    if not (far > MOVED_M or turn > MOVED_RAD):
        return None
    leaves = [f"pose.pose.{leaf}" for leaf in ("position", "orientation")]
    p_odom, q_odom = (odometry.fields[leaf] for leaf in leaves)
    moved = dict(zip(leaves, (p + rotate(q, p_odom), quat_multiply(q, q_odom)), strict=True))
    by = f"by up to {far:.3g} m and {np.degrees(turn):.3g} deg"
    text = f"{odometry.name} from {frame!r:.40} to {parent!r:.40}, by {TF.name} ({by})"
    return odometry._replace(fields={**odometry.fields, **moved}), text


def poses_at(t: Array, pose_t: Array, pose: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Interpolate poses; positions linearly, orientations by slerp.

    Args:
        t: Times [s], shape (N,).
        pose_t: Times of the poses, ascending [s], shape (M,).
        pose: Positions and orientations xyzw, shape (M, 7).

    Returns:
        Positions (N, 3), orientations xyzw (N, 4), and whether each time lies between two poses (N,).
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
    """Refuse poses of which less than two are sound; arguments as for `poses_at` and `field_nt`.

    Raises:
        InputError: So it is; the text says what is wrong with the first.
    """
    bad = ~sound_poses(pose)
    if len(pose) < 2 or np.count_nonzero(~bad) >= 2:
        return
    first = int(np.argmax(bad))
    length = float(np.linalg.norm(pose[first, 3:]))
    fault = "its quaternion is 0,0,0,0" if length == 0 else f"the length of its quaternion is {length:.3g}"
    raise InputError(
        f"{where}: {np.count_nonzero(bad)} of {len(pose)} poses of {topic} cannot be used, the first at "
        f"{pose_t[first]:.3f} s: {fault}; record the orientation too, or choose another topic of poses"
    )
