"""RosNode: a localizer that is a ROS node elsewhere, run in step with recorded or simulated readings."""

import time
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.sender import Sender
from magtwin.io.bags.topics import (
    BATTERY,
    CLOCK,
    COMMAND,
    IMU,
    MAGNITUDE,
    ODOMETRY,
    VECTOR,
    Qos,
    Topic,
)
from magtwin.localization.problem import Estimate, Problem, Reading
from magtwin.ros.bus import Backend, Bus, Message, Publisher, names_of, open_bus, to_bytes
from magtwin.ros.localization.poses import (
    ESTIMATE,
    INITIAL,
    LOST,
    LOST_KIND,
    POSE_KIND,
    pose_bytes,
    read_pose,
)

SENT: tuple[Topic, ...] = (ODOMETRY, IMU, BATTERY, COMMAND, VECTOR, MAGNITUDE)
"""Topics of the readings, in the order of sending. The magnetometer's is last: it completes a reading."""

WITHIN_NS = 1_000
"""Largest difference between the stamps of a reading and of its estimate [ns]."""

MANY = Qos(depth=1000)


class RosNode:
    """Publishes readings on the robot's topics and takes the estimates of a node.

    Each reading is published with its stamp: /clock, odometry, IMU, battery, commands, and last the
    magnetometer. The estimate is the geometry_msgs/PoseWithCovarianceStamped that has the same stamp; a
    covariance of zeros is unknown. std_msgs/Bool on `estimate/lost`, sent before the estimate, flags a pose
    that is not to be trusted. A start that is known is published on /initialpose; the node must begin anew
    when it gets one. It should use the time of /clock (use_sim_time), which restarts with each run.

    The node needs its own map, and its own noise models: they are not sent.
    """

    def __init__(
        self,
        *,
        topic: str = ESTIMATE,
        namespace: str = "robot",
        domain: int | None = None,
        backend: Backend = "auto",
        timeout_s: float = 5.0,
        connect_s: float = 20.0,
    ) -> None:
        """Options.

        Args:
            topic: Topic of the node's estimates.
            namespace: Namespace of the topics.
            domain: ROS domain. Default: ROS_DOMAIN_ID.
            backend: ROS client library.
            timeout_s: Longest wall time that an estimate may take [s].
            connect_s: Longest wall time in which the node must be found [s].

        Raises:
            InputError: A time is not above 0, or no ROS can be imported.
        """
        for name, value in (("timeout_s", timeout_s), ("connect_s", connect_s)):
            if not value > 0:
                raise InputError(f"{name} of the localizer ros must be above 0 s, got {value!r}")
        self._topic, self._timeout_s, self._connect_s = topic, timeout_s, connect_s
        self._open: dict[str, Any] = {"names": names_of(namespace), "backend": backend, "domain": domain}
        self._bus: Bus | None = None

    def reset(self, problem: Problem) -> None:
        """Join the network, wait for the node, and send it the start.

        Raises:
            InputError: There is no such node within `connect_s`.
        """
        self.close()
        bus = self._bus = open_bus("magtwin_benchmark", **self._open)
        self._sender = Sender(unit="T")
        self._clock = bus.publisher(CLOCK.name, CLOCK.kind, MANY)
        self._publishers: dict[str, Publisher] = {
            topic.name: bus.publisher(topic.name, topic.kind, MANY) for topic in SENT
        }
        initial = bus.publisher(INITIAL, POSE_KIND, Qos())
        self._estimates: dict[int, Estimate] = {}
        self._lost = False
        bus.subscribe(LOST, LOST_KIND, self._hear_lost, MANY.heard)
        self._source = bus.subscribe(self._topic, POSE_KIND, self._hear, MANY.heard)
        known = not any(map(np.isinf, problem.prior.sd))
        needed = [self._publishers[topic.name] for topic in (ODOMETRY, MAGNITUDE)] + [initial] * known
        last = time.monotonic() + self._connect_s
        while waited := self._missing(needed):
            if time.monotonic() > last:
                raise InputError(
                    f"{waited} after {self._connect_s:g} s; start the node, and check domain and namespace"
                )
            bus.spin_once(0.02)
        if known:
            p = problem.prior
            initial.publish(pose_bytes(0, self._sender.map_frame, p.mean, np.diag(np.square(p.sd))))

    def _missing(self, needed: list[Publisher]) -> str:
        """What of the node is not there; "" if all is."""
        if not self._source.publishers():
            return f"nobody publishes {self._source.topic}"
        silent = [publisher.topic for publisher in needed if not publisher.subscribers()]
        return f"nobody subscribes to {', '.join(silent)}" if silent else ""

    def step(self, reading: Reading) -> Estimate:
        """Publish a reading and wait for its estimate.

        Raises:
            InputError: There is none within `timeout_s`.
        """
        assert self._bus is not None
        stamp = round(reading.t * NS)
        self._clock.publish(to_bytes(CLOCK.kind, {"clock": np.int64(stamp)}))
        columns = {name: np.asarray(value, float)[None] for name, value in reading.signals.items()}
        columns["b_measured_nt"] = np.array([reading.b_nt])
        zero = np.zeros((1, 3))
        columns = {"odom_v": zero, "odom_w": zero, **columns}
        for topic in SENT:
            if all(name in columns for name in topic.needs):
                fields = topic.write(columns, np.array([stamp]), self._sender)
                self._publishers[topic.name].publish(to_bytes(topic.kind, fields))
        last = time.monotonic() + self._timeout_s
        while (estimate := self._estimate_at(stamp)) is None:
            if time.monotonic() > last:
                raise InputError(
                    f"{self._source.topic} had no estimate with the stamp of this reading within "
                    f"{self._timeout_s:g} s; does the node answer each reading with its stamp?"
                )
            self._bus.spin_once(min(0.05, self._timeout_s))
        self._estimates.clear()
        return Estimate(
            reading.t, estimate.x, estimate.y, estimate.yaw, estimate.covariance, lost=estimate.lost
        )

    def _estimate_at(self, stamp_ns: int) -> Estimate | None:
        near = [stamp for stamp in self._estimates if abs(stamp - stamp_ns) <= WITHIN_NS]
        return self._estimates[near[0]] if near else None

    def _hear_lost(self, message: Message) -> None:
        self._lost = bool(message.read(["data"])["data"])

    def _hear(self, message: Message) -> None:
        stamp, _, pose, covariance = read_pose(message)
        x, y, yaw = pose.tolist()
        self._estimates[stamp] = Estimate(stamp / NS, x, y, yaw, covariance, lost=self._lost)

    def close(self) -> None:
        """Leave the network."""
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def __del__(self) -> None:
        if getattr(self, "_bus", None) is not None:
            self.close()
