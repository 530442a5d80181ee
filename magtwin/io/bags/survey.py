"""Survey: field readings at known poses, from a bag."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, hint
from magtwin.field.survey.readings import TAKEN, Readings
from magtwin.field.units import Unit
from magtwin.files import sha256
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate, yaw_from_quat
from magtwin.io.bags.bag import Bag, Signal, field_nt
from magtwin.io.bags.poses import check_poses, corrected, poses_at, sound_poses
from magtwin.io.bags.topics import MAGNITUDE, ODOMETRY, POSE, Topic

Array = NDArray[np.float64]


def read_bag_readings(
    path: str | os.PathLike[str],
    *,
    pose_topic: str | None = None,
    field_topic: str | None = None,
    unit: Unit | None = None,
    scale: float | None = None,
) -> Readings:
    """The readings of a bag: each message of the field, at the robot's pose at its stamp.

    Positions are interpolated linearly between poses, orientations by slerp (Shoemake 1985, section 3.3).
    Messages of the field before the first pose, after the last one, in a gap of the poses, or without a
    number are left out. Odometry, unless `pose_topic` names it, is corrected by /tf from map to odom. Poses
    of a part of the robot and vectors of a sensor become those of base_link by /tf_static. `source` has both.
    Stamps are those of the headers. If a topic has no stamps, times of receipt are used for both topics.

    Args:
        path: Folder of a rosbag2, or its storage file (.db3, .mcap).
        pose_topic: Topic of the poses. Default: the only one, or the only one that is not odometry.
        field_topic: Topic of the field. Default: the only one.
        unit: Unit of the field. Default: the unit that makes it the Earth's field.
        scale: Factor from the bag's values to nT, in place of a unit.

    Returns:
        Readings in the order of their stamps. A MagneticField with y = z = 0 is a magnitude in x, as
        APRILab's robot publishes it. Otherwise it is a vector, which the pose rotates level.

    Raises:
        InputError: There is no bag, or it is damaged; a topic is missing, or there are several to choose
            from; no message of the field lies between poses; no unit makes it the Earth's field; stamps run
            backwards.
    """
    path = Path(path)
    with Bag(path) as bag:
        pose_name = _choose(bag, "pose", pose_topic, POSE)
        field_name = _choose(bag, "field", field_topic, MAGNITUDE)
        messages = bag.messages((pose_name, field_name))
        for name in (pose_name, field_name):
            if not len(messages[name]):
                raise InputError(f"{path}: topic {name} has no message")
        poses = bag.signal(pose_name, POSE, messages[pose_name])
        fields = bag.signal(field_name, MAGNITUDE, messages[field_name])
        by_header = poses.stamps is not None and fields.stamps is not None
        pose_t, pose, taken = _poses(bag, poses, by_header, told=pose_topic is not None)
        files = [path] if path.is_file() else sorted(path.iterdir())
        sums = "; ".join(f"{f.name} sha256:{sha256(f)}" for f in files if f.is_file())
    clock = "header" if by_header else "receipt"
    fields, once, t, late = _in_order(fields, path, by_header)
    b = fields.columns()["magnetic_field"][once]
    check_poses(pose_t, pose, str(path), poses.name)
    if bad := np.count_nonzero(~sound_poses(pose)):
        taken.append(f"{bad} of {len(pose)} poses as missing, whose quaternion is not of length 1")
    p, q, inside = poses_at(t, pose_t, pose)
    known = np.isfinite(b if b.ndim == 1 else b.sum(axis=1)) & inside
    if not known.any():
        raise InputError(
            f"{path}: no field lies between poses: by the stamps of {clock} poses span {_span(pose_t)}, the "
            f"field {_span(t)}; are they of one clock?"
        )
    t, b, p, q = t[known], b[known], p[known], q[known]
    field = field_nt(b, str(path), fields.name, unit=unit, scale=scale)
    zero = np.flatnonzero(field.b_nt == 0)
    if len(zero):
        raise InputError(
            f"{path}: {fields.name} is 0 {field.label} at {t[zero[0]]:.3f} s; a magnitude is above 0"
        )
    level = None
    if field.vector_nt is not None:
        columns, placed = bag.in_base(fields, {"magnetic_field": field.vector_nt})
        taken.append(placed)
        level = rotate(quat_conjugate(quat_from_yaw(yaw_from_quat(q))), rotate(q, columns["magnetic_field"]))
    left = f", {np.count_nonzero(~known)} of {len(known)} fields not between poses or not a number left out"
    how = "given" if unit or scale is not None else "told by its size"
    about = f"poses {poses.name}, field {fields.name} in {field.label}, {how}; stamps of {clock}"
    return Readings(
        p_xy=p[:, :2],
        yaw=yaw_from_quat(q),
        b_nt=field.b_nt,
        b_body_nt=level,
        t=t - t[0],
        runs=(path.stem,),
        name=path.stem,
        source=f"{sums} ({about}{left if not known.all() else ''})"
        + "".join(f"; {TAKEN}{text}" for text in (late, *taken) if text),
    )


def _choose(bag: Bag, kind: str, name: str | None, topic: Topic) -> str:
    """The topic of that name, or the only one of a fitting type, odometry last."""
    fitting = sorted(t for t, of in bag.kinds.items() if of in topic.reads)
    kinds = ", ".join(topic.reads)
    if name is not None:
        if name not in bag.kinds:
            raise InputError(f"{bag.path}: no topic {name!r}; {hint(name, bag.kinds)}")
        if name not in fitting:
            raise InputError(f"{bag.path}: topic {name} is a {bag.kinds[name]}; a {kind} is one of {kinds}")
        return name
    if not fitting:
        raise InputError(f"{bag.path}: no topic of a {kind} ({kinds}); topics in it: {bag.listed()}")
    fixed = fitting if len(fitting) == 1 else [t for t in fitting if bag.kinds[t] != ODOMETRY.kind]
    if len(fixed) != 1:
        raise InputError(
            f"{bag.path}: {len(fitting)} topics of a {kind}, {', '.join(fitting)}; choose with --{kind}-topic"
        )
    return fixed[0]


def _poses(bag: Bag, poses: Signal, by_header: bool, *, told: bool) -> tuple[Array, Array, list[str]]:
    """Times of poses [s], ascending, and poses of base_link, xyz and xyzw; and what was done to them.

    `told` keeps odometry as it is, since its topic was named.
    """
    poses, once, t, late = _in_order(poses, bag.path, by_header)
    taken = [late]
    if poses.kind == ODOMETRY.kind and (moved := corrected(bag, poses)):
        poses = poses if told else moved[0]
        taken.append(moved[1] + ", which is not applied, as --pose-topic names it" * told)
    columns, placed = bag.in_base(poses, poses.columns())
    pose = np.concatenate([columns["mocap_p"], columns["mocap_q_xyzw"]], axis=1)
    return t, pose[once], [*taken, placed]


def _in_order(signal: Signal, path: Path, by_header: bool) -> tuple[Signal, NDArray[np.intp], Array, str]:
    """The messages by their times, the first one of each time, these times [s], and what was repaired."""
    ns = signal.stamps if by_header and signal.stamps is not None else signal.received
    signal, ns, repaired = signal.in_order(ns, path)
    times, once = np.unique(ns, return_index=True)
    return signal, once, times / 1e9, repaired


def _span(t: Array) -> str:
    return f"{t[0]:.3f}..{t[-1]:.3f} s"
