"""Survey: field readings at known poses, from a bag."""

import math
import os
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, hint
from magtwin.field.survey.readings import TAKEN, Readings
from magtwin.field.units import Unit
from magtwin.files import sha256
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate, yaw_from_quat
from magtwin.io.bags.bag import Bag, Signal, check_poses, field_nt, poses_at, sound_poses
from magtwin.io.bags.cdr import Leaf, Messages, decode
from magtwin.io.bags.topics import MAGNITUDE, ODOMETRY, POSE, TF, Topic
from magtwin.io.bags.types import layout

Array = NDArray[np.float64]

MOVED_M, MOVED_DEG = 0.001, 0.1
"""Correction of odometry above which it is reported [m], [deg]."""

MOST_TRANSFORMS = 256
"""Messages of more transforms are not read."""

_TRANSFORM = ("header.frame_id", "child_frame_id", "transform.translation", "transform.rotation")


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
    number are left out. Corrections of odometry by transforms are not applied; `source` reports them. Stamps
    are those of the headers. If a topic has no stamps, times of receipt are used for both topics.

    Args:
        path: Folder of a rosbag2, or its storage file (.db3, .mcap).
        pose_topic: Topic of the poses. Default: the only one, or the only one that is not odometry.
        field_topic: Topic of the field. Default: the only one.
        unit: Unit of the field. Default: the unit that makes it the Earth's field.
        scale: Factor from the bag's values to nT, in place of a unit.

    Returns:
        Readings in the order of their stamps. A MagneticField with y = z = 0 is a magnitude in x, as
        APRILab's robot publishes it. Otherwise it is a vector in the robot's axes, which the pose
        rotates level.

    Raises:
        InputError: There is no bag, or it is damaged; a topic is missing, or there are several to choose
            from; no message of the field lies between poses; no unit makes it the Earth's field.
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
        taken = [_correction(bag, pose_name, messages[pose_name])]
        files = [path] if path.is_file() else sorted(path.iterdir())
        sums = "; ".join(f"{f.name} sha256:{sha256(f)}" for f in files if f.is_file())
    by_header = poses.stamps is not None and fields.stamps is not None
    clock = "header" if by_header else "receipt"
    pose_t, pose = _in_order(poses, by_header, poses.columns().values())
    t, b = _in_order(fields, by_header, fields.columns().values())
    check_poses(pose_t, pose, str(path), poses.name)
    if bad := np.count_nonzero(~sound_poses(pose)):
        taken.append(f"{bad} of {len(pose)} poses as missing, whose quaternion is not of length 1")
    p, q, inside = poses_at(t, pose_t, pose)
    known = np.isfinite(b).all(axis=1) & inside
    if not known.any():
        raise InputError(
            f"{path}: no field lies between poses: by the stamps of {clock} poses span {_span(pose_t)}, the "
            f"field {_span(t)}; are they of one clock?"
        )
    t, b, p, q = t[known], b[known], p[known], q[known]
    field = field_nt(b if b.shape[1] == 3 else b[:, 0], str(path), fields.name, unit=unit, scale=scale)
    zero = np.flatnonzero(field.b_nt == 0)
    if len(zero):
        raise InputError(
            f"{path}: {fields.name} is 0 {field.label} at {t[zero[0]]:.3f} s; a magnitude is above 0"
        )
    level = None
    if field.vector_nt is not None:
        level = rotate(quat_conjugate(quat_from_yaw(yaw_from_quat(q))), rotate(q, field.vector_nt))
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
        + "".join(f"; {TAKEN}{text}" for text in taken if text),
    )


def _correction(bag: Bag, name: str, messages: Messages) -> str:
    """What transforms of the bag do to the frame of its odometry, which is not applied; "" if nothing."""
    tf = [topic for topic, kind in bag.kinds.items() if kind == TF.kind]
    if bag.kinds[name] != ODOMETRY.kind or not tf:
        return ""
    frame = decode(layout(ODOMETRY.kind), messages, ["header.frame_id"])["header.frame_id"][0].strip("/")
    far, turn = dict[str, float](), dict[str, float]()
    with (
        suppress(InputError),
        np.errstate(over="ignore", invalid="ignore"),
    ):  # a damaged one hinders no survey
        for parents, children, p, q in chain(*map(_transforms, bag.messages(tf).values())):
            rows = [row for row, child in enumerate(children) if child.strip("/") == frame != ""]
            size, yaw = np.hypot(*p[rows, :2].T), np.abs(yaw_from_quat(q[rows]))
            for row, metres, angle in zip(rows, size.tolist(), yaw.tolist(), strict=True):
                parent = parents[row].strip("/")
                far[parent] = max(far.get(parent, 0.0), metres)
                turn[parent] = max(turn.get(parent, 0.0), angle)
    for parent in far:
        if far[parent] > MOVED_M or turn[parent] > math.radians(MOVED_DEG):
            return (
                f"poses of {name} in {frame!r:.40}, though {', '.join(tf)} moves it against {parent!r:.40} "
                f"by up to {far[parent]:.3g} m and {math.degrees(turn[parent]):.3g} deg, which is not "
                "applied: give the topic of a corrected pose (--pose-topic)"
            )
    return ""


def _transforms(messages: Messages) -> Iterator[tuple[list[str], list[str], Array, Array]]:
    """Parents, children, translations and rotations (xyzw) of transforms of TFMessages."""
    counts = decode([Leaf("transforms", "u4")], messages, ["transforms"])["transforms"]
    for count in np.unique(counts[counts <= MOST_TRANSFORMS]).tolist():
        rows = np.flatnonzero(counts == count)
        some = Messages(messages.received[rows], messages.buffer, messages.start[rows], messages.size[rows])
        names = [[f"transforms.{k}.{leaf}" for leaf in _TRANSFORM] for k in range(count)]
        fields = decode(layout(TF.kind, {"transforms": count}), some, chain(*names))
        for parent, child, p, q in names:
            yield fields[parent], fields[child], fields[p], fields[q]


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


def _in_order(signal: Signal, by_header: bool, columns: Iterable[Array]) -> tuple[Array, Array]:
    """Times [s], ascending, each once, and the columns side by side."""
    stamps = signal.stamps if by_header and signal.stamps is not None else signal.received
    ns, first = np.unique(stamps, return_index=True)
    parts = [column if column.ndim == 2 else column[:, None] for column in columns]
    return ns / 1e9, np.concatenate(parts, axis=1)[first]


def _span(t: Array) -> str:
    return f"{t[0]:.3f}..{t[-1]:.3f} s"
