"""Recording: what a robot recorded, as roles, frames and one timeline, and the run in it.

The topic of each role is found by its name or its type. Its messages are put in order, brought into the
frames and units of a Run, and held at the times of the magnetometer's readings.
"""

import os
import warnings
from collections.abc import Mapping
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, RepairWarning
from magtwin.field.units import NT_PER, Unit, check_factor, nt_per
from magtwin.files.file import sha256
from magtwin.frames import IDENTITY_XYZW, canonical, quat_conjugate, quat_multiply, rotate, yaw_from_quat
from magtwin.io.bags.bag import Bag
from magtwin.io.bags.cdr import NS, Messages
from magtwin.io.bags.topics import IMU, MAGNITUDE, ODOMETRY, PATH_KIND, POSE, SCAN, TF, VECTOR, Topic
from magtwin.io.recording.frames import Frames, frames_of, in_base, kind_of, mount_of
from magtwin.io.recording.poses import UNIT_WITHIN, check_poses, poses_at, sound_poses
from magtwin.io.recording.roles import (
    LEAST,
    ROLES,
    VITAL,
    candidates,
    check_kind,
    check_roles,
    chosen,
    role_of,
)
from magtwin.io.recording.signal import Signal, read_signal
from magtwin.io.recording.tree import Tree, topics_of_frames
from magtwin.io.recording.unit import field_nt, unit_of
from magtwin.run.run import COLUMNS, Run

Array = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

SCAN_S = 0.5  # Time after a scan during which a LiDAR counts as on [s]
GRAVITY = 9.80665  # Standard gravity [m/s2]
MOVED_M, MOVED_RAD = 0.001, 0.002  # Correction of odometry by transforms below which there is none [m], [rad]
TRANSFORMS = "tf"  # Given in place of a topic of poses: the pose of the robot's base by /tf


def read_recording(
    path: str | os.PathLike[str],
    *,
    topics: Mapping[str, str] | None = None,
    unit: Unit | None = None,
    scale: float | None = None,
) -> "Recording":
    """What a robot recorded, in a rosbag2 or a bag of ROS 1 (.bag).

    Arguments and errors are those of `magtwin.io.bags.read_bag`.
    """
    check_roles(topics or {})
    with Bag(Path(path)) as bag, np.errstate(over="ignore", invalid="ignore"):
        recording = Recording(bag, topics or {})
        recording.read(unit=unit, scale=scale)
        return recording


class Recording:
    """A robot's recording.

    Attributes:
        roles: Topic of each role: field, vector field, pose, odometry, IMU, battery, commands, scan.
        frames: Frames of the messages of each role: that of their header, and the child frame.
        timeline: What was done to put the messages of each topic in order; topics in order are left out.
        doubts: What was taken for granted, in lines.
        run: Its run, see `magtwin.io.bags.read_bag`.
    """

    def __init__(
        self, bag: Bag, names: Mapping[str, str], *, survey: bool = False, most: int | None = None
    ) -> None:
        """Find the roles; `most` are the bytes of the beginning that are read, None for all of the bag."""
        self._bag, self._names, self._survey, self._most = bag, names, survey, most
        self._columns: Columns = {}
        self._signals: dict[str, Signal] = {}
        self._known: dict[str, Frames] = {}
        self._read: set[str] = set()
        self._frameless: dict[str, list[str]] = {}
        self._by_tf = names.get(POSE.name) == TRANSFORMS
        self.roles: dict[str, str] = {}
        self.frames: dict[str, Frames] = {}
        self.timeline: dict[str, str] = {}
        self.doubts: list[str] = []
        self._metadata: dict[str, Any] = {"bag": bag.path.name}
        self._topics, self._messages = self._found()
        self.roles = {ROLES[topic].noun: name for topic, name in self._topics.items()}

    @cached_property
    def tree(self) -> Tree:
        """The frames of the robot."""
        return Tree(self._bag, self._messages)

    def read(self, unit: Unit | None, scale: float | None, *, summed: bool = True) -> None:
        """Read all roles; `summed` puts the checksum of the bag into the metadata."""
        check_factor(unit, scale)
        self._told = unit is not None or scale is not None
        self._unit, self._scale = unit, scale
        self._read_field()
        self._read_pose()
        if not self._survey:
            self._read_rest()
        metadata = self._metadata
        if summed:
            metadata["bag_sha256"] = " ".join(sha256(file) for file in self._bag.files)
        metadata["topics"] = " ".join(sorted(self._read))
        if self.timeline:
            metadata["timeline"] = "; ".join(f"{name}: {text}" for name, text in self.timeline.items())
        if self._frameless:
            self._warn_of_frames()
        self.doubts = [note for note in self.doubts if note]
        if self._bag.damaged:
            self.doubts.append(f"{self._bag.damaged} damaged chunks or records as missing")
        notes = [*self.doubts, *(f"messages of {name}: {text}" for name, text in self.timeline.items())]
        if notes:
            metadata["taken"] = "; ".join(notes)
        self.run = Run({name: self._columns[name] for name in COLUMNS if name in self._columns}, metadata)

    def _read_field(self) -> None:
        """The field, whose times are those of the run."""
        if MAGNITUDE not in self._topics:
            raise self._none_of(MAGNITUDE)
        path, clock = self._bag.path, self._signal(MAGNITUDE)
        self._by_header = clock.stamps is not None
        ns = clock.received if clock.stamps is None else clock.stamps
        self._delay = int(np.median(clock.received - ns))
        clock, order = clock.in_order(ns, path)
        self._order(clock, str(order))
        self._start = int(order.ns[0])
        first = np.flatnonzero(np.diff(order.ns, prepend=self._start - 1) > 0)  # of messages of one time
        self._t: Array = (order.ns[first] - self._start) / NS
        standard = clock.kind == MAGNITUDE.kind
        values = clock.columns()["magnetic_field"]
        field = field_nt(values, str(path), clock.name, unit=self._unit, scale=self._scale, standard=standard)
        self._columns |= {"t": self._t, "b_measured_nt": field.b_nt[first]}
        self._metadata |= {"clock": clock.name, "stamps": "header" if self._by_header else "receipt"}
        self._metadata |= {"start_ns": str(self._start), "field_unit": field.label}
        self._metadata |= {"field_unit_told": "given" if self._told else "by its size"}
        self.doubts.append(field.left_out)
        if field.vector_nt is not None:
            turned = self._in_base(clock, {"magnetic_field": field.vector_nt})
            self._columns["b_vector_measured_nt"] = turned["magnetic_field"][first]
        if mount := self.tree.static.mount(self._frames(clock)[0]):
            self._metadata["tf_sensor_m"] = ", ".join(f"{part:.6g}" for part in mount.p)

    def _read_pose(self) -> None:
        """The true pose of base_link: of a topic of poses, of /tf, or of odometry that /tf moves in the map.

        A survey takes odometry as it is if nothing else gives poses.
        """
        told = POSE.name in self._names and not self._by_tf
        signal = self._signal(POSE) if POSE in self._topics else None
        rank = ROLES[POSE].rank
        estimated = signal is not None and not told
        if signal is not None and signal.kind != PATH_KIND:
            estimated &= rank(signal.name) > rank("/pose")
        placed = self._pose_by_tf() if signal is None or estimated else None
        if signal is not None and placed is None:
            if signal.kind in ODOMETRY.reads:
                moved = self._corrected(signal)
                if moved and told:
                    self.doubts.append(f"poses of {moved[1]}, which is not applied, as their topic was named")
                if signal.name == self._topics.get(ODOMETRY):
                    text = "is both the odometry and the true pose, so the odometry seems to have no errors"
                    self._warn(f"{signal.name} {text}")
            self._place(signal, f"topic {signal.name}")
        elif placed is not None:
            if estimated and signal is not None:
                text = f"which are an estimate (--pose-topic {signal.name})"
                self.doubts.append(f"not the poses of {signal.name}, {text}")
            self.doubts.append(f"poses of {placed[1]}")
            self.roles[ROLES[POSE].noun] = TF.name
            self._place(placed[0], f"topic {placed[1]}" if placed[0].name != TF.name else placed[1])
        elif self._by_tf:
            known = ", ".join({*self.tree.moving, *self.tree.static.parents}) or "none"
            text = "/tf does not move a base of the robot in a map"
            raise InputError(f"{self._bag.path}: {text}; frames: {known}")
        elif self._survey:
            if ODOMETRY not in self._topics:
                raise self._none_of(POSE)
            signal = self._signal(ODOMETRY)
            self.doubts.append(f"poses of {signal.name}, which is odometry and drifts")
            self._place(signal, f"topic {signal.name}")

    def _pose_by_tf(self) -> tuple[Signal, str] | None:
        """Poses by transforms from a map to the robot's base, and how; None if there are none."""
        if ODOMETRY in self._topics and not self._by_tf:
            return self._corrected(self._signal(ODOMETRY))
        base = self.tree.base(self._frames(self._signal(MAGNITUDE))[0])
        way = self.tree.up(base) if base else []
        if not way or ((kind_of(way[-1]) != "fixed" or "odom" in way[-1]) and not self._by_tf):
            return self._corrected(self._signal(ODOMETRY)) if ODOMETRY in self._topics else None
        ns = self.tree.stamps(base)
        p, q = self.tree.at(base, ns)
        fields = {"pose.position": p, "pose.orientation": q}
        none = Messages(ns, np.zeros(0, np.uint8), ns, ns)
        text = f"{' to '.join(repr(name)[:40] for name in (way[-1], base))} by {TF.name}"
        return Signal(TF.name, POSE, POSE.kind, none, fields, ns), text

    def _corrected(self, odometry: Signal) -> tuple[Signal, str] | None:
        """Odometry in the frame to which transforms of the bag move its own, and how; None if none do.

        With map to odom of a localizer or SLAM, p_map_base = p_map_odom + rotate(q_map_odom, p_odom_base).
        """
        frame = self._frames(odometry)[0]
        way = self.tree.up(frame) if frame else []
        if len(way) < 2 or kind_of(way[-1]) == "base" or odometry.stamps is None:
            return None  # a robot whose body is the root moves the world
        p, q = self.tree.at(frame, odometry.stamps)
        far = float(np.hypot(p[:, 0], p[:, 1]).max())
        turn = float(np.abs(yaw_from_quat(q)).max())
        if not (far > MOVED_M or turn > MOVED_RAD):
            return None
        values = odometry._replace(topic=POSE).columns()
        fields = {"pose.position": p + rotate(q, values["mocap_p"])}
        fields["pose.orientation"] = quat_multiply(q, values["mocap_q_xyzw"])
        by = f"by up to {far:.3g} m and {np.degrees(turn):.3g} deg"
        text = f"{odometry.name} from {frame!r:.40} to {way[-1]!r:.40}, by {TF.name} ({by})"
        return odometry._replace(topic=POSE, kind=POSE.kind, fields=fields), text

    def _place(self, signal: Signal, truth: str) -> None:
        """The columns of the true pose, from poses; `truth` says of what."""
        whole, (signal, when) = signal, self._timed(signal)
        poses = signal._replace(topic=POSE).columns()
        values = poses if signal.name == TF.name else self._in_base(whole, poses)
        first = np.flatnonzero(np.diff(when, prepend=-np.inf) > 0)
        pose = np.concatenate([values["mocap_p"], values["mocap_q_xyzw"]], axis=1)[first]
        check_poses(when[first], pose, str(self._bag.path), signal.name)
        bad = np.count_nonzero(~sound_poses(pose))
        text = f"{bad} of {len(pose)} poses as missing, whose quaternion is not of length 1"
        self.doubts.append(text * bool(bad))
        values["mocap_q_xyzw"] = canonical(values["mocap_q_xyzw"])
        held = self._held(values, when)
        p, q, inside = poses_at(self._t, when[first], pose)
        p = np.where(inside[:, None], p, held["mocap_p"])
        q = np.where(inside[:, None], q, held["mocap_q_xyzw"])
        self._columns |= held | {"p_world_base": p, "q_world_base_xyzw": q, "yaw": yaw_from_quat(q)}
        self._columns["flag_pose_lost"] = ~inside
        self._metadata["truth"] = truth

    def _read_rest(self) -> None:
        """The columns of all other roles."""
        readers = {SCAN: self._scanned, VECTOR: self._vector, IMU: self._inertial}
        for topic in [topic for topic in self._topics if topic not in (MAGNITUDE, POSE)]:
            try:
                signal, when = self._timed(self._signal(topic))
                self._columns |= readers.get(topic, self._plain)(signal, when)
            except InputError as error:
                if topic in VITAL:
                    raise
                text = str(error).removeprefix(f"{self._bag.path}: ")
                self._warn(f"{ROLES[topic].noun} topic left out: {text}")

    def _found(self) -> tuple[dict[Topic, str], dict[str, Messages]]:
        """The topic of each role, and the messages of all of them.

        A topic that is named, or has the name of `TOPICS`, is that of its role. Else it is found by its type,
        then by its name.
        """
        bag, names = self._bag, self._names
        roles = (MAGNITUDE, POSE, ODOMETRY) if self._survey else tuple(ROLES)
        told = {topic: names.get(topic.name, topic.name) for topic in roles}
        told = {t: n for t, n in told.items() if n in bag.kinds or t.name in names}
        if self._by_tf:
            del told[POSE]
        for topic, name in told.items():
            check_kind(topic, bag, name)
        fitting = {t: [told[t]] if t in told else candidates(t, bag, told.values()) for t in roles}
        fitting[POSE] = [] if self._by_tf else fitting[POSE]
        messages = bag.messages(chain(*fitting.values(), topics_of_frames(bag)), self._most)
        found: dict[Topic, str] = {}
        notes: dict[str, list[str]] = {"its type": [], "its name": []}
        for topic, several in fitting.items():
            heard = [name for name in several if len(messages[name])]
            streams = [name for name in heard if len(messages[name]) >= LEAST] or heard
            streams = [name for name in streams if name not in found.values() or topic in told]
            if topic is VECTOR and topic not in told and ROLES[MAGNITUDE].rank(found.get(MAGNITUDE, "")) > 0:
                continue
            if self._survey and topic is ODOMETRY and POSE in found and topic not in told:
                continue
            best = chosen(topic, streams, found.get(MAGNITUDE, "")) if streams else []
            if len(best) > 1:
                self._several(topic, {name: messages[name] for name in best})
            elif best:
                (found[topic],) = best
                if topic not in told:
                    others = ", ".join(sorted(set(streams) - set(best)))
                    text = f"{ROLES[topic].noun} {best[0]}" + f" (not {others})" * bool(others)
                    by_name = others or bag.kinds[best[0]] not in ROLES[topic].kinds
                    notes["its name" if by_name else "its type"].append(text)
            elif several and (topic is MAGNITUDE or topic.name in names):
                raise InputError(f"{bag.path}: topic {several[0]} has no message")
        for by, texts in notes.items():
            by = by if len(texts) == 1 else by.replace("its", "their") + "s"
            self.doubts.append(f"{', '.join(texts)} by {by}" * bool(texts))
        return found, messages

    def _several(self, topic: Topic, several: Mapping[str, Messages]) -> None:
        """Refuse a role of several topics, or warn of it if the role is not vital."""
        listed = []
        for name, messages in sorted(several.items()):
            span = max(int(messages.received[-1] - messages.received[0]) / NS, 1e-9)
            rate = f"{(len(messages) - 1) / span:.3g} Hz"
            listed.append(f"{name} ({self._bag.kinds[name]}, {rate if len(messages) > 1 else '1 message'})")
        option = f"{ROLES[topic].option} TOPIC" if ROLES[topic].option else f"--remap {topic.name}:=TOPIC"
        if self._survey and topic is ODOMETRY:
            option = "--pose-topic TOPIC"
        text = f"{len(several)} {ROLES[topic].noun} topics, {', '.join(listed)}; choose with {option}"
        if topic in VITAL:
            raise InputError(f"{self._bag.path}: {text}")
        self._warn(f"{text}; none is read")

    def _none_of(self, topic: Topic) -> InputError:
        """The refusal of a recording without a role."""
        bag = self._bag
        kinds, listed = ", ".join(kind for kind in topic.reads if "px4" not in kind), bag.listed()
        option = f" or choose one with {ROLES[topic].option}" * bool(ROLES[topic].option)
        encodings = {one.encoding for one in bag.topics.values()}
        if encodings and not encodings & {"cdr", "ros1"}:
            text = "those of ROS 1 and 2 (ros1, cdr) are read: write time, x, y and field as CSV for"
            text = f"its messages are encoded as {' and '.join(sorted(encodings))}; {text}"
            return InputError(f"{bag.path}: {text} magtwin map import, or record ROS messages")
        noun = ROLES[topic].noun
        return InputError(f"{bag.path}: no {noun} topic ({kinds}){option}; topics in it: {listed}")

    def _warn(self, text: str) -> None:
        warnings.warn(f"{self._bag.path}: {text}", RepairWarning, stacklevel=6)

    def _warn_of_frames(self) -> None:
        """Warn once of the frames of sensors whose place on the robot is not known."""
        frames = ", ".join(f"{name!r:.40}" for name in self._frameless)
        topics = ", ".join(name for names in self._frameless.values() for name in names)
        text = f"vectors of {topics} are taken as in the axes of base_link"
        self._warn(f"no /tf, /tf_static or robot_description joins {frames} to base_link: {text}")

    def _signal(self, topic: Topic) -> Signal:
        name, noun = self._topics[topic], ROLES[topic].noun
        if noun not in self._signals:
            signal = read_signal(self._bag, name, topic, self._messages[name])
            if signal.broken:
                self._order(signal, f"{signal.broken} damaged left out")
            self._signals[noun], self.frames[noun] = signal, self._frames(signal)
        return self._signals[noun]

    def _frames(self, signal: Signal) -> Frames:
        """The frames of a signal."""
        if signal.name not in self._known:
            try:
                self._known[signal.name] = frames_of(self._bag.layout(signal.name), signal.messages)
            except InputError as error:
                raise InputError(f"{self._bag.path}: topic {signal.name}: {error}") from error
        return self._known[signal.name]

    def _order(self, signal: Signal, text: str) -> None:
        """Note what was done to put a topic in order."""
        if text:
            known = self.timeline.get(signal.name, "")
            self.timeline[signal.name] = known if text in known else ", ".join([known, text][not known :])
        self._read.add(signal.name)

    def _timed(self, signal: Signal) -> tuple[Signal, Array]:
        """The messages in order, and their times since the first reading [s]."""
        received = signal.stamps is None or not self._by_header
        ns = signal.received - self._delay if received else np.asarray(signal.stamps)
        signal, order = signal.in_order(ns, self._bag.path)
        when = (order.ns - self._start) / NS
        if when[-1] < 0 or when[0] > self._t[-1]:
            span = f"{signal.name} spans {when[0]:.3f}..{when[-1]:.3f} s since the first of"
            clock = f"{self._metadata['clock']}, whose last is at {self._t[-1]:.3f} s"
            raise InputError(f"{self._bag.path}: {span} {clock}; are they of one clock?")
        self._order(signal, str(order))
        return signal, when

    def _in_base(self, signal: Signal, columns: Columns) -> Columns:
        """Columns of a signal as those of base_link. Warns if its frame cannot be that of such a signal."""
        role, frames = role_of(columns), self._frames(signal)
        if role is None:
            return columns
        mount, fault = mount_of(role, frames, self.tree.static)
        about = f"{role.noun} of {signal.name}"
        if fault:
            self._warn(f"{about}: {fault}; it is read as that of base_link")
        if mount is not None:
            self.doubts.append(f"{about} from {mount}, by /tf_static")
            return in_base(role, columns, mount)
        base = kind_of(frames[0]) == "base" or frames[0] in self.tree.moving
        if frames[0] and not (role.position or fault or base):
            self._frameless.setdefault(frames[0], []).append(signal.name)
        return columns

    def _held(self, values: Columns, when: Array) -> Columns:
        """Columns of a signal, held causally at the times of readings."""
        at = np.searchsorted(when, self._t, side="right") - 1
        return {name: taken(array, at, at >= 0) for name, array in values.items()}

    def _plain(self, signal: Signal, when: Array) -> Columns:
        return self._held(self._in_base(signal, signal.columns()), when)

    def _vector(self, signal: Signal, when: Array) -> Columns:
        b = self._in_base(signal, signal.columns())["magnetic_field"]
        if not np.any(b[:, 1:]):  # a magnitude, in x
            self._read.discard(signal.name)
            return {}
        size = np.linalg.norm(b, axis=1)
        if not np.isfinite(size).any():
            return {}
        if self._told and signal.kind == self._bag.kinds[self._topics[MAGNITUDE]]:
            unit, factor = self._metadata["field_unit"], nt_per(self._unit, self._scale)
        else:  # it may differ from the clock's
            unit = unit_of(float(np.median(size)), str(self._bag.path), signal.name)
            factor = NT_PER[unit]
        self._metadata["vector_unit"] = unit
        return self._held({"b_vector_measured_nt": b * factor}, when)

    def _inertial(self, signal: Signal, when: Array) -> Columns:
        """An IMU, without gravity in its accelerations; one without orientation is upright."""
        values = self._in_base(signal, signal.columns())
        q, a = values["imu_q_xyzw"], values["imu_a"]
        sound = (np.abs(np.linalg.norm(q, axis=1) - 1) < UNIT_WITHIN)[:, None]
        values["imu_q_xyzw"] = np.where(sound, canonical(q), np.nan)
        if not sound.all():
            text = f"{np.count_nonzero(~sound)} of {len(q)} orientations of {signal.name} as missing"
            self.doubts.append(f"{text}, whose quaternion is not of length 1")
        finite = a[np.isfinite(a).all(axis=1)]
        mean = float(np.linalg.norm(finite.mean(axis=0))) if len(finite) else 0.0
        if abs(mean - GRAVITY) < GRAVITY / 10:
            upright = np.where(sound, q, IDENTITY_XYZW)
            values["imu_a"] = a - rotate(quat_conjugate(upright), (0.0, 0.0, GRAVITY))
            self._metadata["imu_gravity"] = "removed"
        return self._held(values, when)

    def _scanned(self, signal: Signal, when: Array) -> Columns:
        at = np.searchsorted(when, self._t, side="right") - 1
        since = np.where(at >= 0, self._t - when[np.maximum(at, 0)], np.inf)
        return {"lidar_on": since < SCAN_S}


def taken(values: NDArray[Any], at: NDArray[np.intp], known: NDArray[np.bool_]) -> NDArray[Any]:
    """Rows `at` of values; nan where they are not known."""
    if known.all() and len(values):
        return values[at]
    out = np.full((len(at), *values.shape[1:]), np.nan)
    out[known] = values[at[known]]
    return out
