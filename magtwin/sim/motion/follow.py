"""Follow: drive a robot along a path, or by a script of commands, 50 times a second."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import InputError
from magtwin.path import Path, check_clear
from magtwin.sim.motion.closed_loop import ClosedLoop
from magtwin.sim.motion.controllers import Controller, guide_along, guide_by_commands
from magtwin.sim.motion.drive import Pose
from magtwin.sim.motion.engine import KINEMATIC, Engine, Travel
from magtwin.sim.motion.plan import SLOWEST, check_speed, drivable
from magtwin.sim.motion.pose_error import EXACT, PoseError
from magtwin.spec.drive import DriveSpec
from magtwin.spec.obstacles import Obstacles

CONTROL_RATE_HZ = 50.0
"""Control steps a second [Hz]."""

STAND = ((0.0, 0.0, 0.0),)
"""A script that stands, for robots that something else commands."""

LONGEST_M = 100_000.0
"""Longest path [m], 20 million nodes of its plan, 1.5 GB."""

LONGEST_S = 86_400.0
"""Longest run [s]: 11.7 million readings at 135 Hz, which still fit into the memory of a laptop."""


def loop_along(
    path: Path,
    drive: DriveSpec,
    *,
    speed: float,
    duration_s: float | None = None,
    controller: str = "follower",
    obstacles: Obstacles | None = None,
    footprint_radius_m: float = 0.0,
    wheel_errors: tuple[float, float] = (0.0, 0.0),
    pose_error: PoseError = EXACT,
) -> ClosedLoop:
    """The closed loop along a path, ready to run.

    Args:
        path: Where to drive.
        drive: Limits, motors and wheels.
        speed: Wanted forward speed [m/s].
        duration_s: How long to drive [s]: further laps of a closed path, back and forth on an open one.
            Default: to the end of the path, or one lap, and stop there.
        controller: A name of `magtwin.sim.motion.controllers.CONTROLLERS`.
        obstacles: What the path must be clear of.
        footprint_radius_m: Radius of the circle that they stop [m].
        wheel_errors: Relative errors of the wheels' radius and separation.
        pose_error: Error of the pose that the controller gets. Default: it gets the exact pose.
    """
    dt = 1.0 / CONTROL_RATE_HZ
    check_speed(speed, drive)
    if duration_s is not None:
        _check_duration(duration_s)
    if obstacles is not None:
        check_clear(path, obstacles, footprint_radius_m)
    line = path if controller == "release" else drivable(path)
    if duration_s is not None:
        line = line.prolonged(speed * duration_s)
    if duration_s is None and line.length > speed * LONGEST_S > 0:
        raise InputError(
            f"path {path.name}: its {line.length:.4g} m take {line.length / speed:.3g} s at {speed:g} m/s, "
            f"more than {LONGEST_S:g} s, a day; drive faster than {line.length / LONGEST_S:.2g} m/s, or "
            "give `duration_s`",
            parameter="duration_s",
        )
    if line.length > LONGEST_M:
        text = f"{line.length:.4g} m are too long, at most {LONGEST_M:g} m are planned; take a part of it"
        raise InputError(f"path {path.name}: {text}", parameter="path")
    guide = guide_along(controller, line, drive, speed=speed, dt=dt)
    assert guide.pose0 is not None
    least_s = line.length / speed if duration_s is None else duration_s
    if duration_s is None:
        stops = 1 + np.count_nonzero(guide.table[5] == 0)
        duration_s = min(60 + 10 * stops + 4 * line.length / min(SLOWEST, speed), LONGEST_S)
    return ClosedLoop(
        drive=drive,
        guide=guide,
        dt=dt,
        pose0=guide.pose0,
        steps=max(math.ceil(duration_s / dt - 1e-9), 1),
        least_steps=int(least_s / dt),
        footprint_radius_m=footprint_radius_m,
        wheel_errors=wheel_errors,
        pose_error=pose_error,
    )


def follow(
    path: Path,
    drive: DriveSpec,
    *,
    speed: float,
    controller: str | Controller = "follower",
    engine: Engine = KINEMATIC,
    **options: Any,
) -> Travel:
    """Drive along a path, by a controller that may be an object, which gets neither path nor speed.

    Other arguments and refusals are those of `loop_along`; the end of the path must be reached in ample time.
    """
    name, custom = (controller, None) if isinstance(controller, str) else ("follower", controller)
    loop = loop_along(path, drive, speed=speed, controller=name, **options)
    motion = engine.drive(loop, custom, options.get("obstacles"))
    if options.get("duration_s") is None:
        check_arrived(path, speed, loop, motion)
    return motion


def check_arrived(path: Path, speed: float, closed_loop: ClosedLoop, motion: Travel) -> None:
    """Refuse a motion that took all steps that were allowed for reaching the end of a path."""
    allowed_s = closed_loop.steps * closed_loop.dt
    if motion.duration_s > allowed_s - 0.5 * closed_loop.dt:
        why = "it winds too tightly for this drive: smooth it, or drive more slowly"
        if motion.at([motion.duration_s]).bump[-1]:
            why = "the robot stands at an obstacle"
        what = f"its end was not reached in {allowed_s:.0f} s at {speed:g} m/s"
        raise InputError(f"path {path.name}: {what}; {why}")


def play(
    commands: ArrayLike,
    drive: DriveSpec,
    *,
    obstacles: Obstacles | None = None,
    engine: Engine = KINEMATIC,
    **options: Any,
) -> Travel:
    """Drive by a script; other arguments and refusals are those of `loop_by_commands`."""
    return engine.drive(loop_by_commands(commands, drive, **options), None, obstacles)


def loop_by_commands(
    commands: ArrayLike,
    drive: DriveSpec,
    *,
    start: Pose = (0.0, 0.0, 0.0),
    duration_s: float | None = None,
    footprint_radius_m: float = 0.0,
    wheel_errors: tuple[float, float] = (0.0, 0.0),
) -> ClosedLoop:
    """The closed loop that plays a script, ready to run.

    A command holds until the next one, or until it is older than the drive allows.

    Args:
        commands: Time since the start [s], forward speed [m/s] and yaw rate [rad/s] of each, shape (K, 3).
        drive: As for `loop_along`.
        start: First x [m], y [m], yaw [rad] in world.
        duration_s: How long to drive [s]. Default: until the last command is void and the robot stands.
        footprint_radius_m: As for `loop_along`.
        wheel_errors: As for `loop_along`.
    """
    dt = 1.0 / CONTROL_RATE_HZ
    guide = guide_by_commands(commands, drive)
    if duration_s is None:
        at_rest = 1 + drive.v_max / drive.a_max + drive.w_max / drive.alpha_max + 20 * drive.motor_lag_s
        duration_s = float(guide.table[0, -1]) + drive.command_timeout_s + at_rest
    _check_duration(duration_s)
    return ClosedLoop(
        drive=drive,
        guide=guide,
        dt=dt,
        pose0=start,
        steps=max(math.ceil(duration_s / dt - 1e-9), 1),
        least_steps=int(guide.table[0, -1] / dt),
        footprint_radius_m=footprint_radius_m,
        wheel_errors=wheel_errors,
    )


def _check_duration(duration_s: float) -> None:
    if not 0 < duration_s <= LONGEST_S:
        text = f"duration_s must be above 0 s and finite, at most {LONGEST_S:g}, a day; got {duration_s!r}"
        raise InputError(text, parameter="duration_s")
