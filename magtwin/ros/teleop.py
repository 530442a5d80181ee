"""Teleop: a robot driven by hand over ROS."""

import os
import select
from collections.abc import Callable

from magtwin.io.bags.topics import COMMAND
from magtwin.ros.bus import Bus
from magtwin.ros.follow import command_bytes
from magtwin.sim.motion.manual import Hand

RATE_HZ = 20.0
"""Commands a second, far above what a robot's timeout asks for [Hz]."""


class Teleop:
    """The node: what a hand says last is commanded again and again."""

    def __init__(self, bus: Bus, hand: Hand, source: int, *, stamped_commands: bool = False) -> None:
        """Offer commands.

        Args:
            bus: The node.
            hand: Who drives.
            source: Descriptor of the terminal or gamepad that tells of it.
            stamped_commands: Whether commands are TwistStamped, and not Twist.
        """
        self._bus, self._hand, self._source = bus, hand, source
        self._kind = "geometry_msgs/msg/TwistStamped" if stamped_commands else COMMAND.kind
        self._commands = bus.publisher(COMMAND.name, self._kind, COMMAND.qos)
        self.sent = 0
        """Commands so far."""
        self._timer = bus.timer(1 / RATE_HZ, self._command)

    def run(self, step: Callable[[], None] = lambda: None) -> None:
        """Drive until the hand has done; `step` is called often."""
        while not self._hand.done:
            if select.select([self._source], [], [], 0.0)[0]:
                self._hand.feed(os.read(self._source, 1024))
            step()
            self._bus.spin_once(1 / RATE_HZ / 4)

    def listeners(self) -> int:
        """How many hear the commands."""
        return self._commands.subscribers()

    def stop(self) -> None:
        """Tell the robot to stand, as before this node leaves."""
        self._timer.cancel()
        self._commands.publish(command_bytes(self._kind, 0.0, 0.0, self._bus.now_ns()))

    def _command(self) -> None:
        self.sent += 1
        self._commands.publish(command_bytes(self._kind, *self._hand.command, self._bus.now_ns()))
