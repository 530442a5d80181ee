"""Recording: the run in a robot's own bag.

The topic of each role is found by its name or its type. Its messages are put in order, brought into the
frames and units of a Run, and held at the times of the magnetometer's readings.
"""

import warnings
from collections.abc import Mapping
from itertools import chain
from re import findall
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, RepairWarning
from magtwin.field.units import NT_PER, Unit
from magtwin.files.file import sha256
from magtwin.frames import IDENTITY_XYZW, canonical, quat_conjugate, rotate, yaw_from_quat
from magtwin.io.bags.bag import Bag, Signal
from magtwin.io.bags.cdr import NS, Messages
from magtwin.io.bags.poses import UNIT_WITHIN, check_poses, corrected, poses_at, sound_poses
from magtwin.io.bags.topics import (
    BATTERY,
    COMMAND,
    IMU,
    MAGNITUDE,
    ODOMETRY,
    POSE,
    SCAN,
    VECTOR,
    Topic,
)
from magtwin.io.bags.unit import field_nt, unit_of
from magtwin.run.run import COLUMNS, Run

Array = NDArray[np.float64]
Columns = dict[str, NDArray[Any]]

SCAN_S = 0.5
"""Time after a scan during which a LiDAR counts as on [s]."""

GRAVITY = 9.80665
"""Standard gravity [m/s2]."""

LEAST = 2
"""Messages from which a topic is a stream. One with fewer is found by its type only if there is no stream."""


class Sought(NamedTuple):
    """How the topic of a role is found if it does not have the name of `TOPICS`."""

    noun: str
    kinds: tuple[str, ...] = ()
    """Message types of this role alone."""

    words: tuple[str, ...] = ()
    """Beginnings of words in the name of a topic that make it one of the role in any type that is read, if
    there is none of `kinds`."""

    def fitting(self, topic: Topic, kinds: Mapping[str, str]) -> list[str]:
        """The topics of a fitting type, of topics with their types."""
        return [name for name, kind in kinds.items() if kind in self.kinds] or [
            name
            for name, kind in kinds.items()
            if kind in topic.reads
            and any(word.startswith(self.words) for word in findall("[a-z]+", name.lower()))
        ]


ROLES: Mapping[Topic, Sought] = {
    MAGNITUDE: Sought("field", (MAGNITUDE.kind,), ("mag", "compass", "field", "bfield")),
    POSE: Sought("pose", tuple(kind for kind in POSE.reads if kind != ODOMETRY.kind)),
    ODOMETRY: Sought("odometry", (ODOMETRY.kind,)),
    VECTOR: Sought("vector field"),
    IMU: Sought("IMU", (IMU.kind,)),
    BATTERY: Sought("battery", (BATTERY.kind,)),
    COMMAND: Sought("command", (), ("cmd", "command")),
    SCAN: Sought("scan"),
}
"""Topics that are read from a robot's recording."""

VITAL = (MAGNITUDE, POSE, ODOMETRY, VECTOR)
"""Roles of which a fault refuses the recording. Others are left out with a warning."""


def read_recording(
    bag: Bag, names: Mapping[str, str], *, unit: Unit | None, scale: float | None, survey: bool
) -> Run:
    """The run that a robot recorded; arguments as for `magtwin.io.bags.read_bag`."""
    recording = _Recording(bag, names, survey)
    recording.read_field(unit, scale)
    recording.read_pose()
    if not survey:
        recording.read_rest()
    return recording.run()


class _Recording:
    """A recording as it is read: the columns and metadata of its run so far, and what was done (`taken`)."""

    def __init__(self, bag: Bag, names: Mapping[str, str], survey: bool) -> None:
        self.bag, self.names, self.survey = bag, names, survey
        sums = " ".join(sha256(file) for file in bag.files)
        self.metadata: dict[str, Any] = {"bag": bag.path.name, "bag_sha256": sums}
        self.columns: Columns = {}
        self.taken: list[str] = []
        self.read: set[str] = set()
        self.topics, self.messages = self._found()

    def run(self) -> Run:
        """The run."""
        self.metadata["topics"] = " ".join(sorted(self.read))
        if taken := [note for note in self.taken if note]:
            self.metadata["taken"] = "; ".join(taken)
        return Run({name: self.columns[name] for name in COLUMNS if name in self.columns}, self.metadata)

    def read_field(self, unit: Unit | None, scale: float | None) -> None:
        """The field, whose times are those of the run."""
        if MAGNITUDE not in self.topics:
            raise self._none_of(MAGNITUDE)
        bag, path, clock = self.bag, self.bag.path, self._signal(MAGNITUDE)
        self.by_header = clock.stamps is not None
        ns = clock.received if clock.stamps is None else clock.stamps
        self.delay = int(np.median(clock.received - ns))
        clock, ns, repaired = clock.in_order(ns, path)
        first = np.flatnonzero(np.diff(ns, prepend=ns[0] - 1) > 0)  # a repeated message counts once
        self.start = int(ns[0])
        self.t: Array = (ns[first] - self.start) / NS
        field = field_nt(clock.columns()["magnetic_field"], str(path), clock.name, unit=unit, scale=scale)
        self.columns |= {"t": self.t, "b_measured_nt": field.b_nt[first]}
        self.metadata |= {"clock": clock.name, "stamps": "header" if self.by_header else "receipt"}
        self.metadata |= {"start_ns": str(self.start), "field_unit": field.label}
        self.metadata |= {"field_unit_told": "given" if unit or scale is not None else "by its size"}
        self.taken += [repaired, field.left_out]
        self.read.add(clock.name)
        if field.vector_nt is not None:
            turned, placed = bag.in_base(clock, {"magnetic_field": field.vector_nt})
            self.columns["b_vector_measured_nt"] = turned["magnetic_field"][first]
            self.taken.append(placed)
        if mount := bag.static.mount(bag.frames(clock)[0]):
            self.metadata["tf_sensor_m"] = ", ".join(f"{part:.6g}" for part in mount.p)

    def read_pose(self) -> None:
        """The true pose of base_link: of a topic of poses, or of odometry that /tf moves in the map.

        A survey takes odometry as it is if nothing else gives poses.
        """
        source = next((topic for topic in (POSE, ODOMETRY) if topic in self.topics), None)
        if source is None:
            if self.survey:
                raise self._none_of(POSE)
            return
        signal = self._signal(source)
        moved = corrected(self.bag, signal) if signal.kind == ODOMETRY.kind else None
        truth = f"topic {signal.name}"
        if source is POSE:
            if moved:
                self.taken.append(f"poses of {moved[1]}, which is not applied, as their topic was named")
            if signal.name == self.topics.get(ODOMETRY):
                text = "is both the odometry and the true pose, so the odometry seems to have no errors"
                self._warn(f"{signal.name} {text}")
        elif moved:
            signal, truth = moved[0], f"topic {moved[1]}"
            self.taken.append(f"poses of {moved[1]}")
        elif self.survey:
            self.taken.append(f"poses of {signal.name}, which is odometry and drifts")
        else:
            return
        signal, when = self._timed(signal)
        values, placed = self.bag.in_base(signal, signal._replace(topic=POSE).columns())
        first = np.flatnonzero(np.diff(when, prepend=-np.inf) > 0)
        pose = np.concatenate([values["mocap_p"], values["mocap_q_xyzw"]], axis=1)[first]
        check_poses(when[first], pose, str(self.bag.path), signal.name)
        bad = np.count_nonzero(~sound_poses(pose))
        text = f"{bad} of {len(pose)} poses as missing, whose quaternion is not of length 1"
        self.taken += [placed, text * bool(bad)]
        values["mocap_q_xyzw"] = canonical(values["mocap_q_xyzw"])
        held = self._held(values, when)
        p, q, inside = poses_at(self.t, when[first], pose)
        p, q = (
            np.where(inside[:, None], at, held[name]) for at, name in ((p, "mocap_p"), (q, "mocap_q_xyzw"))
        )
        self.columns |= held | {"p_world_base": p, "q_world_base_xyzw": q, "yaw": yaw_from_quat(q)}
        self.columns["flag_pose_lost"] = ~inside
        self.metadata["truth"] = truth

    def read_rest(self) -> None:
        """The columns of all other roles."""
        readers = {SCAN: self._scanned, VECTOR: self._vector, IMU: self._inertial}
        for topic in [topic for topic in self.topics if topic not in (MAGNITUDE, POSE)]:
            try:
                signal, when = self._timed(self._signal(topic))
                self.columns |= readers.get(topic, self._plain)(signal, when)
            except InputError as error:
                if topic in VITAL:
                    raise
                text = str(error).removeprefix(f"{self.bag.path}: ")
                self._warn(f"{ROLES[topic].noun} topic left out: {text}")

    def _found(self) -> tuple[dict[Topic, str], dict[str, Messages]]:
        """The topic of each role, and the messages of all of them.

        A topic that is named, or has the name of `TOPICS`, is that of its role. Else it is the only one of a
        fitting type.
        """
        bag, kinds = self.bag, self.bag.kinds
        roles = (MAGNITUDE, POSE, ODOMETRY) if self.survey else tuple(ROLES)
        told = {topic: self.names.get(topic.name, topic.name) for topic in roles}
        told = {topic: name for topic, name in told.items() if name in kinds or topic.name in self.names}
        for topic, name in told.items():
            if name not in kinds:
                raise bag.missing(name)
            if kinds[name] not in topic.reads:
                fit = " or ".join(topic.reads)
                raise InputError(f"{bag.path}: topic {name} is a {kinds[name]}; it must be {fit}")
        others = {name: kind for name, kind in kinds.items() if name not in told.values()}
        fitting = {t: [told[t]] if t in told else ROLES[t].fitting(t, others) for t in roles}
        messages = bag.messages(chain(*fitting.values()))
        found: dict[Topic, str] = {}
        by_type = []
        for topic, names in fitting.items():
            heard = [name for name in names if len(messages[name])]
            streams = [name for name in heard if len(messages[name]) >= LEAST]
            if self.survey and topic is ODOMETRY and POSE in found:
                continue
            if len(streams or heard) > 1:
                self._several(topic, {name: messages[name] for name in streams or heard})
            elif heard:
                (found[topic],) = streams or heard
                by_type += [f"{ROLES[topic].noun} {found[topic]}"] * (topic not in told)
            elif names and (topic is MAGNITUDE or topic.name in self.names):
                raise InputError(f"{bag.path}: topic {names[0]} has no message")
        types = "its type" if len(by_type) == 1 else "their types"
        self.taken.append(f"{', '.join(by_type)} by {types}" * bool(by_type))
        return found, messages

    def _several(self, topic: Topic, several: Mapping[str, Messages]) -> None:
        """Refuse a role of several topics, or warn of it if the role is not vital."""
        listed = []
        for name, messages in sorted(several.items()):
            span = max(int(messages.received[-1] - messages.received[0]) / NS, 1e-9)
            rate = f"{(len(messages) - 1) / span:.3g} Hz"
            listed.append(f"{name} ({self.bag.kinds[name]}, {rate if len(messages) > 1 else '1 message'})")
        option = f"--{'field' if topic is MAGNITUDE else 'pose'}-topic TOPIC"
        option = option if self.survey else f"--remap {topic.name}:=TOPIC of magtwin convert"
        text = f"{len(several)} {ROLES[topic].noun} topics, {', '.join(listed)}; choose with {option}"
        if topic in VITAL:
            raise InputError(f"{self.bag.path}: {text}")
        self._warn(f"{text}; none is read")

    def _none_of(self, topic: Topic) -> InputError:
        """The refusal of a recording without a role."""
        kinds, listed = ", ".join(topic.reads), self.bag.listed()
        return InputError(f"{self.bag.path}: no {ROLES[topic].noun} topic ({kinds}); topics in it: {listed}")

    def _warn(self, text: str) -> None:
        warnings.warn(f"{self.bag.path}: {text}", RepairWarning, stacklevel=5)

    def _signal(self, topic: Topic) -> Signal:
        name = self.topics[topic]
        return self.bag.signal(name, topic, self.messages[name])

    def _timed(self, signal: Signal) -> tuple[Signal, Array]:
        """The messages in order, and their times since the first reading [s]."""
        received = signal.stamps is None or not self.by_header
        ns = signal.received - self.delay if received else np.asarray(signal.stamps)
        signal, ns, repaired = signal.in_order(ns, self.bag.path)
        when = (ns - self.start) / NS
        if when[-1] < 0 or when[0] > self.t[-1]:
            raise InputError(
                f"{self.bag.path}: {signal.name} spans {when[0]:.3f}..{when[-1]:.3f} s since the first of "
                f"{self.metadata['clock']}, whose last is at {self.t[-1]:.3f} s; are they of one clock?"
            )
        self.taken.append(repaired)
        self.read.add(signal.name)
        return signal, when

    def _held(self, values: Columns, when: Array) -> Columns:
        """Columns of a signal, held causally at the times of readings."""
        at = np.searchsorted(when, self.t, side="right") - 1
        return {name: taken(array, at, at >= 0) for name, array in values.items()}

    def _in_base(self, signal: Signal) -> Columns:
        values, placed = self.bag.in_base(signal, signal.columns())
        self.taken.append(placed)
        return values

    def _plain(self, signal: Signal, when: Array) -> Columns:
        return self._held(self._in_base(signal), when)

    def _vector(self, signal: Signal, when: Array) -> Columns:
        b = self._in_base(signal)["magnetic_field"]
        size = np.linalg.norm(b, axis=1)
        size = size[np.isfinite(size)]
        if not len(size):
            return {}
        unit = unit_of(float(np.median(size)), str(self.bag.path), signal.name)  # may differ from the clock's
        self.metadata["vector_unit"] = unit
        return self._held({"b_vector_measured_nt": b * NT_PER[unit]}, when)

    def _inertial(self, signal: Signal, when: Array) -> Columns:
        """An IMU, without gravity in its accelerations; one without orientation is upright."""
        values = self._in_base(signal)
        q, a = values["imu_q_xyzw"], values["imu_a"]
        sound = (np.abs(np.linalg.norm(q, axis=1) - 1) < UNIT_WITHIN)[:, None]
        values["imu_q_xyzw"] = np.where(sound, canonical(q), np.nan)
        if not sound.all():
            text = f"{np.count_nonzero(~sound)} of {len(q)} orientations of {signal.name} as missing"
            self.taken.append(f"{text}, whose quaternion is not of length 1")
        finite = a[np.isfinite(a).all(axis=1)]
        mean = float(np.linalg.norm(finite.mean(axis=0))) if len(finite) else 0.0
        if abs(mean - GRAVITY) < GRAVITY / 10:
            upright = np.where(sound, q, IDENTITY_XYZW)
            values["imu_a"] = a - rotate(quat_conjugate(upright), (0.0, 0.0, GRAVITY))
            self.metadata["imu_gravity"] = "removed"
        return self._held(values, when)

    def _scanned(self, signal: Signal, when: Array) -> Columns:
        at = np.searchsorted(when, self.t, side="right") - 1
        since = np.where(at >= 0, self.t - when[np.maximum(at, 0)], np.inf)
        return {"lidar_on": since < SCAN_S}


def taken(values: NDArray[Any], at: NDArray[np.intp], known: NDArray[np.bool_]) -> NDArray[Any]:
    """Rows `at` of values; nan where they are not known."""
    if known.all() and len(values):
        return values[at]
    out = np.full((len(at), *values.shape[1:]), np.nan)
    out[known] = values[at[known]]
    return out
