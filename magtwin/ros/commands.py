"""Commands: the velocity commands of a robot on cmd_vel, as Twist or TwistStamped.

Robots of Jazzy and later take TwistStamped, those before take Twist, and a subscriber of one type receives
nothing of the other. By default the type is therefore that of the robot's subscription.
"""

import os
import time
from typing import Any, Literal

import numpy as np

from magtwin.errors import InputError
from magtwin.io.bags.topics import COMMAND
from magtwin.ros.bus import Bus, Publisher, to_bytes

CommandType = Literal["auto", "Twist", "TwistStamped"]

KINDS = {name: f"geometry_msgs/msg/{name}" for name in ("Twist", "TwistStamped")}
"""Message type by name."""

UNSTAMPED = ("foxy", "galactic", "humble", "iron")
"""Distributions whose robots take Twist."""

LOOK_S = 0.5
"""Time between searches for subscribers [s]."""

ALONE_S = 1.0
"""Time after which commands are sent although nobody subscribes [s]."""


class Commands:
    """Sends commands, in the type that is subscribed to."""

    def __init__(self, bus: Bus, kind: CommandType = "auto") -> None:
        """Prepare.

        Args:
            bus: The node.
            kind: Type of the commands. auto: the type of the subscribers; if they take both, or there are
                none, that of the distribution in ROS_DISTRO, Twist if it is not set.

        Raises:
            InputError: The type is unknown.
        """
        if kind != "auto" and kind not in KINDS:
            raise InputError(f"commands are {' or '.join(KINDS)}, or auto; got {kind!r}")
        self._bus, self._auto = bus, kind == "auto"
        self._publishers: dict[str, Publisher] = {}
        self._kind = KINDS[preferred() if kind == "auto" else kind]
        self._begun, self._looked = time.monotonic(), -LOOK_S
        if not self._auto:
            self._advertise()

    @property
    def offered(self) -> int:
        """Number of types that are advertised."""
        return len(self._publishers)

    def send(self, v: float, w: float) -> None:
        """Send a forward speed [m/s] and a yaw rate [rad/s]."""
        self._look()
        if self._kind in self._publishers:
            self._publishers[self._kind].publish(command_bytes(self._kind, v, w, self._bus.now_ns()))

    def _look(self) -> None:
        now = time.monotonic()
        if not self._auto or now - self._looked < LOOK_S:
            return
        self._looked = now
        wanted = {end.kind for end in self._bus.wants(COMMAND.name)} & set(KINDS.values())
        if len(wanted) == 1:
            (self._kind,) = wanted
        elif wanted and not self._publishers:
            self._kind = KINDS[preferred()]
        if wanted or now - self._begun > ALONE_S:
            self._advertise()

    def _advertise(self) -> None:
        if self._kind not in self._publishers:
            self._publishers[self._kind] = self._bus.publisher(COMMAND.name, self._kind, COMMAND.qos)


def preferred() -> str:
    """The type for a robot that takes both: that of the distribution in ROS_DISTRO."""
    distribution = os.environ.get("ROS_DISTRO", "").lower()
    return "TwistStamped" if distribution and distribution not in UNSTAMPED else "Twist"


def command_bytes(kind: str, v: float, w: float, now_ns: int) -> bytes:
    """A command of forward speed [m/s] and yaw rate [rad/s], as a Twist or a TwistStamped."""
    linear, angular = COMMAND.leaves(kind)
    fields: dict[str, Any] = {linear: [v, 0.0, 0.0], angular: [0.0, 0.0, w]}
    if kind.endswith("Stamped"):
        fields |= {"header.stamp": np.int64(now_ns), "header.frame_id": "base_link"}
    return to_bytes(kind, fields)
