"""Manual driving: commands from the keys of a terminal or the sticks of a gamepad."""

import struct
from collections.abc import Iterator, Sequence

import numpy as np

from magtwin.sim.motion.closed_loop import Chassis
from magtwin.sim.motion.commands import Commands
from magtwin.spec.drive import DriveSpec

V_STEP, W_STEP = 0.05, 0.25
"""Change of speed [m/s] and yaw rate [rad/s] by one key press."""

KEYS = {
    **dict.fromkeys(("w", "W", "\x1b[A", "\x1bOA"), "faster"),
    **dict.fromkeys(("s", "S", "\x1b[B", "\x1bOB"), "slower"),
    **dict.fromkeys(("a", "A", "\x1b[D", "\x1bOD"), "left"),
    **dict.fromkeys(("d", "D", "\x1b[C", "\x1bOC"), "right"),
    **dict.fromkeys(("x", "X"), "straight"),
    " ": "stop",
    **dict.fromkeys(("q", "Q", "\x04", "\x03", ""), "end"),
}
"""Actions by the bytes of a terminal: WASD or arrows; x, space, q; Ctrl-C, Ctrl-D and the end of input."""

HELP = "w/s or up/down: speed, a/d or left/right: turn, x: straight on, space: stop, q: end"


class Hand:
    """An input device; its input so far gives the present command."""

    def __init__(self, drive: DriveSpec) -> None:
        """Stand still."""
        self._drive, self._rest = drive, b""
        self.command = 0.0, 0.0
        """Forward speed [m/s] and yaw rate [rad/s]."""
        self.done = False
        """Whether the drive is to end."""

    def feed(self, data: bytes) -> None:
        """Take bytes from the device; no bytes mean its end."""
        raise NotImplementedError


class Keyboard(Hand):
    """The keys of a terminal. Key releases are unknown, so each press changes the speeds by a step."""

    def feed(self, data: bytes) -> None:
        """As for `Hand`; other keys are ignored."""
        for key in self._keys(data):
            self._press(KEYS.get(key, "nothing"))

    def _keys(self, data: bytes) -> Iterator[str]:
        if not data:
            yield ""
        data, self._rest = self._rest + data, b""
        while data:
            length = 3 if data[:2] in (b"\x1b[", b"\x1bO") else 1
            if len(data) < length or data == b"\x1b":
                self._rest = data  # the first bytes of an arrow key
                return
            yield data[:length].decode("latin-1")
            data = data[length:]

    def _press(self, what: str) -> None:
        v, w = self.command
        drive = self._drive
        if what in ("faster", "slower"):
            v += V_STEP if what == "faster" else -V_STEP
        elif what in ("left", "right"):
            w += W_STEP if what == "left" else -W_STEP
        elif what == "straight":
            w = 0.0
        elif what in ("stop", "end"):
            v = w = 0.0
            self.done = self.done or what == "end"
        v = min(max(round(v, 9), -drive.v_max), drive.v_max)
        self.command = v, min(max(round(w, 9), -drive.w_max), drive.w_max)


class Gamepad(Hand):
    """A gamepad of Linux (/dev/input/js0): left stick drives, Start ends.

    Its events are 8 bytes: time [ms], value, type (1 button, 2 axis; plus 128 for the initial state), and
    number (Linux, Documentation/input/joydev/joystick-api).
    """

    DEAD = 0.08
    """Dead zone of a stick, as a share of its range."""

    END = (7, 9)
    """Numbers of the Start button on pads of two makers."""

    def feed(self, data: bytes) -> None:
        """As for `Hand`."""
        if not data:
            self.command, self.done = (0.0, 0.0), True
        data = self._rest + data
        whole = len(data) // 8 * 8
        self._rest = data[whole:]
        for _, value, kind, number in struct.iter_unpack("<IhBB", data[:whole]):
            v, w = self.command
            share = max(-1.0, -value / 32767)  # forward and left are below 0
            share = 0.0 if abs(share) < self.DEAD else share
            if kind & 0x7F == 2 and number == 1:
                self.command = share * self._drive.v_max, w
            elif kind & 0x7F == 2 and number == 0:
                self.command = v, share * self._drive.w_max
            elif kind == 1 and value and number in self.END:
                self.command, self.done = (0.0, 0.0), True


class Recorder:
    """A robot that is driven by hand, and its commands so far."""

    def __init__(self, chassis: Chassis, hand: Hand, dt: float) -> None:
        """Begin at the pose of the chassis."""
        self.chassis, self._hand, self._dt = chassis, hand, dt
        self._rows: list[tuple[float, float, float]] = []

    def step(self) -> None:
        """Drive for one control step by the present command."""
        self._rows.append((len(self._rows) * self._dt, *self._hand.command))
        self.chassis.step(self._hand.command)

    def commands(self, name: str) -> Commands:
        """All commands, one row per control step, and a stop at the end."""
        rows: Sequence[tuple[float, float, float]] = [*self._rows, (len(self._rows) * self._dt, 0.0, 0.0)]
        return Commands(name, np.array(rows))
