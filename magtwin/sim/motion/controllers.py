"""Controllers: from where a robot is to what it is commanded, step by step.

A custom controller is any object with the members of `Controller`. The controllers of magtwin are `Guide`s,
made by name from a path or from a script of commands; `loop.py` computes what they command.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, find
from magtwin.extend import Registry
from magtwin.path import Path
from magtwin.run import mapped
from magtwin.sim.motion import loop
from magtwin.sim.motion.plan import LIMIT_SHARE, drivable, plan
from magtwin.spec.drive import DriveSpec

Array = NDArray[np.float64]

CONTROLLERS: Mapping[str, int] = MappingProxyType({"follower": loop.FOLLOWER, "release": loop.RELEASE})
"""Built-in controllers that follow a path: magtwin's; that of the released package, which drives the real
robot."""

RELEASE_GAIN = 0.5
"""k of the released follower [1/s], as published."""

LOST_M = 0.05
"""Distance from the path beyond which the robot drives straight back to it [m]."""

CREEP = 0.01
"""Speed at the start and end of a piece [m/s]; one step of it is 0.2 mm."""


class Controller(Protocol):
    """Commands a robot."""

    @property
    def done(self) -> bool:
        """Whether it has no more commands; the run then ends when the robot stands."""

    def command(
        self, t: float, x: float, y: float, yaw: float, v: float, w: float
    ) -> tuple[float, float] | None:
        """The next forward speed [m/s] and yaw rate [rad/s]; the drive keeps them within its limits.

        Args:
            t: Time since the start [s].
            x: Position in world [m].
            y: Position in world [m].
            yaw: Heading in world, not wrapped at pi [rad].
            v: Forward speed, as the wheels turn [m/s].
            w: Yaw rate, as the wheels turn [rad/s].

        Returns:
            None keeps the last command until the drive's command_timeout_s is over.
        """


ControllerFactory = Callable[[Path, DriveSpec, float], Controller]
"""From a path, the drive and the wanted speed [m/s] to a controller at the start of a run."""

CUSTOM_CONTROLLERS: Registry[ControllerFactory] = Registry("controller", "controllers")
"""Registered controllers; see `magtwin.sim.extensions`."""


@dataclass(eq=False)
class Guide:
    """A built-in controller, which can be compiled."""

    law: int
    """Number of its control law in `loop.py`."""

    table: Array
    """The path or script, as `loop.drive_on` reads it, shape (loop.TABLE, M)."""

    gains: loop.Gains

    timeout_s: float
    """Age at which a scripted command becomes invalid [s]."""

    pose0: tuple[float, float, float] | None = None
    """x [m], y [m], yaw [rad] at the start of the path; None for a script."""

    node: int = 0
    """Next node; the number of nodes when it is done."""

    driven_m: float = 0.0
    """Distance driven since `node` changed [m]."""

    @cached_property
    def columns(self) -> list[list[float]]:
        """`table` as lists, which are faster in plain Python."""
        columns: list[list[float]] = self.table.tolist()
        return columns

    @property
    def done(self) -> bool:
        """Whether the end was reached; it then commands a stop."""
        return self.node >= self.table.shape[1]

    @property
    def lost_m(self) -> float:
        """Distance from the path beyond which the robot counts as lost [m]."""
        return math.sqrt(self.gains.lost2)

    def gains_within(self, reach_m: float) -> loop.Gains:
        """`gains` for poses that may be off by some distance [m]: the robot is lost only farther away."""
        return self.gains._replace(lost2=(self.lost_m + reach_m) ** 2)

    def command(self, t: float, x: float, y: float, yaw: float, v: float, w: float) -> tuple[float, float]:
        """As for `Controller`."""
        law = self.law, self.columns, self.gains, self.timeout_s, self.node, self.driven_m
        v_cmd, w_cmd, self.node, self.driven_m = loop.commanded(*law, t, x, y, yaw, v, w)
        return v_cmd, w_cmd


def guide_along(name: str, path: Path, drive: DriveSpec, *, speed: float, dt: float) -> Guide:
    """A controller that follows a path."""
    law = find("controller", name, CONTROLLERS)
    pieces = plan(drivable(path), drive, speed=speed)
    if law == loop.RELEASE:
        p = path.p_xy  # the release pursues the points of its file
        unused = np.zeros((loop.TABLE - 2, len(p)))
        (x, y), (dx, dy) = p[0].tolist(), (p[1] - p[0]).tolist()
        gains = loop.Gains(dt, delay=dt, speed=speed, creep=speed, towards=RELEASE_GAIN)
        table, pose0 = np.vstack([p.T, unused]), (x, y, math.atan2(dy, dx))
        return Guide(law, table, gains, drive.command_timeout_s, pose0)
    columns = ("x", "y", "heading", "curvature", "speed2", "left_m")
    count = sum(len(piece.x) for piece in pieces)
    table = mapped.zeros((len(columns), count)) if count > mapped.LONG else np.empty((len(columns), count))
    end = count
    while pieces:  # from the last one, and freed at once: those of a day take 0.2 GB
        piece = pieces.pop()
        begin = end - len(piece.x)
        for row, column in zip(table, columns, strict=True):
            row[begin:end] = getattr(piece, column)
        end = begin
    gains = loop.Gains(
        dt,
        delay=dt + drive.motor_lag_s,
        speed=speed,
        creep=min(CREEP, speed),
        brake=2 * LIMIT_SHARE * drive.a_max,
        lost2=(LOST_M + drive.v_max * dt) ** 2,
        w_path=LIMIT_SHARE * drive.w_max,
    )
    x, y, yaw = table[:3, 0].tolist()
    return Guide(law, table, gains, drive.command_timeout_s, (x, y, yaw))


def guide_by_commands(commands: ArrayLike, drive: DriveSpec) -> Guide:
    """A controller that plays a script. A command holds until the next one, or until it is too old.

    Args:
        commands: Time since the start [s], forward speed [m/s] and yaw rate [rad/s] of each, shape (K, 3).
        drive: Its command_timeout_s ends a command.
    """
    rows = np.asarray(commands, float)
    if rows.ndim != 2 or rows.shape[1] != 3 or not len(rows):
        raise InputError(f"commands must be rows of t, v, w, of shape (K, 3), got {rows.shape}")
    broken = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(broken):
        i = int(broken[0])
        raise InputError(f"command {i + 1} of {len(rows)} is not finite: t, v, w = {rows[i].tolist()}")
    back = np.flatnonzero(np.diff(rows[:, 0], prepend=-1e-300) <= 0)
    if len(back):
        i = int(back[0])
        text = f"command {i + 1} of {len(rows)} has t = {rows[i, 0]:g} s"
        text += f" after {rows[i - 1, 0]:g} s" if i else ""
        raise InputError(f"commands must come in order of time, from 0 s up: {text}")
    table = np.vstack([rows.T, np.zeros((loop.TABLE - 3, len(rows)))])
    return Guide(loop.COMMANDS, table, loop.Gains(), drive.command_timeout_s)
