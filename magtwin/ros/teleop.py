"""Teleop: drive a robot by hand over ROS."""

import os
import select
from collections.abc import Callable

from magtwin.ros.bus import Bus
from magtwin.ros.commands import Commands, CommandType
from magtwin.sim.motion.manual import Hand

RATE_HZ = 20.0
"""Rate of commands, far above what a robot's timeout requires [Hz]."""


class Teleop:
    """The node: repeats the last command of a keyboard or gamepad."""

    def __init__(self, bus: Bus, hand: Hand, source: int, *, commands: CommandType = "auto") -> None:
        """Advertise commands.

        Args:
            bus: The node.
            hand: The keyboard or gamepad.
            source: File descriptor of the terminal or gamepad.
            commands: Message type of the commands, as for `magtwin.ros.commands.Commands`.
        """
        self._bus, self._hand, self._source = bus, hand, source
        self._commands = Commands(bus, commands)
        self.sent = 0
        """Number of commands so far."""
        self._timer = bus.timer(1 / RATE_HZ, self._command)

    def run(self, step: Callable[[], None] = lambda: None) -> None:
        """Drive until the keyboard or gamepad ends it; `step` is called often."""
        while not self._hand.done:
            if select.select([self._source], [], [], 0.0)[0]:
                self._hand.feed(os.read(self._source, 1024))
            step()
            self._bus.spin_once(1 / RATE_HZ / 4)

    def listeners(self) -> int:
        """Number of subscribers of the commands."""
        return self._commands.subscribers()

    def stop(self) -> None:
        """Command the robot to stand; call it before the node ends."""
        self._timer.cancel()
        self._commands.send(0.0, 0.0)

    def _command(self) -> None:
        self.sent += 1
        self._commands.send(*self._hand.command)
