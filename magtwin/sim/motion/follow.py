"""Follow: drive a robot along a path, or by a script of commands, 50 times a second."""

import math

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import InputError
from magtwin.path import Path, check_clear
from magtwin.sim.motion.closed_loop import ClosedLoop
from magtwin.sim.motion.controllers import Controller, guide_along, guide_by_commands
from magtwin.sim.motion.drive import Pose
from magtwin.sim.motion.engine import Engine, Kinematic, Travel
from magtwin.sim.motion.plan import SLOWEST, drivable
from magtwin.spec.drive import DriveSpec
from magtwin.spec.obstacles import Obstacles

CONTROL_RATE_HZ = 50.0
"""Control steps a second [Hz]."""

LONGEST_S = 86_400.0
"""Longest run [s]: 11.7 million readings at 135 Hz, which still fit into the memory of a laptop."""


def loop_along(
    path: Path,
    drive: DriveSpec,
    *,
    speed: float,
    duration_s: float | None = None,
    start: Pose | None = None,
    rate_hz: float = CONTROL_RATE_HZ,
    controller: str = "follower",
    obstacles: Obstacles | None = None,
    footprint_radius_m: float = 0.0,
    wheel_errors: tuple[float, float] = (0.0, 0.0),
) -> ClosedLoop:
    """What drives along a path, checked and ready to run; arguments and refusals are those of `follow`."""
    dt = _step(rate_hz, drive)
    if duration_s is not None:
        _check_duration(duration_s)
    if obstacles is not None:
        check_clear(path, obstacles, footprint_radius_m)
    way = path if controller == "release" else drivable(path)
    if duration_s is not None and 0 < speed < math.inf:  # the plan refuses others
        way = way.prolonged(speed * duration_s)
    if start is not None:
        way = Path(way.name, np.vstack([start[:2], way.p_xy]))
        if obstacles is not None and math.dist(*way.p_xy[:2]) > 0:
            check_clear(Path(f"{path.name}, from its start", way.p_xy[:2]), obstacles, footprint_radius_m)
    if duration_s is None and way.length > speed * LONGEST_S > 0:
        raise InputError(
            f"path {path.name}: its {way.length:.4g} m take {way.length / speed:.3g} s at {speed:g} m/s, "
            f"more than {LONGEST_S:g} s, a day; drive faster than {way.length / LONGEST_S:.2g} m/s, or "
            "give duration_s"
        )
    guide = guide_along(controller, way, drive, speed=speed, dt=dt)
    assert guide.pose0 is not None
    least_s = way.length / speed if duration_s is None else duration_s
    if duration_s is None:
        stops = 1 + np.count_nonzero(guide.table[5] == 0)
        duration_s = min(60 + 10 * stops + 4 * way.length / min(SLOWEST, speed), LONGEST_S)
    return ClosedLoop(
        drive=drive,
        guide=guide,
        dt=dt,
        pose0=guide.pose0 if start is None else start,
        steps=math.ceil(duration_s / dt - 1e-9),
        least_steps=int(least_s / dt),
        footprint_radius_m=footprint_radius_m,
        wheel_errors=wheel_errors,
    )


def follow(
    path: Path,
    drive: DriveSpec,
    *,
    speed: float,
    duration_s: float | None = None,
    start: Pose | None = None,
    rate_hz: float = CONTROL_RATE_HZ,
    controller: str | Controller = "follower",
    obstacles: Obstacles | None = None,
    footprint_radius_m: float = 0.0,
    wheel_errors: tuple[float, float] = (0.0, 0.0),
    engine: Engine | None = None,
) -> Travel:
    """Drive along a path.

    Args:
        path: Where to drive.
        drive: Limits, motors and wheels.
        speed: Wanted forward speed [m/s].
        duration_s: How long to drive [s]: further laps of a closed path, back and forth on an open
            one. None means to the end of the path, or one lap, and to stop there.
        start: First x [m], y [m], yaw [rad] in world, from where the robot drives straight to the
            path's first point; None means on that point, along the path.
        rate_hz: Control steps a second [Hz].
        controller: A name of `magtwin.sim.motion.controllers.CONTROLLERS`, or a controller of one's own,
        which
            is given neither path nor speed; `start`, or the path's, is where it begins.
        obstacles: What stops the robot.
        footprint_radius_m: Radius of the circle that they stop [m].
        wheel_errors: How far the wheels' radius and separation are from the nominal ones, relative.
        engine: What moves the robot; None is the kinematic one.

    Raises:
        InputError: `speed`, `duration_s` or `rate_hz` is out of range, the path or the start touches an
            obstacle, a command is not finite, or the end of the path was not reached in a time that
            suffices for any path.
    """
    course = loop_along(
        path,
        drive,
        speed=speed,
        duration_s=duration_s,
        start=start,
        rate_hz=rate_hz,
        controller=controller if isinstance(controller, str) else "follower",
        obstacles=obstacles,
        footprint_radius_m=footprint_radius_m,
        wheel_errors=wheel_errors,
    )
    own = None if isinstance(controller, str) else controller
    motion = (engine or Kinematic()).drive(course, own, obstacles)
    if duration_s is None:
        check_arrived(path, speed, course, motion)
    return motion


def check_arrived(path: Path, speed: float, course: ClosedLoop, motion: Travel) -> None:
    """Refuse a motion that took all the steps which its course allows for reaching the end of a path."""
    if motion.duration_s > (course.steps - 0.5) * course.dt:
        why = (
            "the robot stands at an obstacle"
            if motion.at([motion.duration_s]).bump[-1]
            else "it winds too tightly for this drive: smooth it, or drive more slowly"
        )
        raise InputError(
            f"path {path.name}: its end was not reached in {course.steps * course.dt:.0f} s at {speed:g} "
            f"m/s; {why}"
        )


def play(
    commands: ArrayLike,
    drive: DriveSpec,
    *,
    start: Pose = (0.0, 0.0, 0.0),
    duration_s: float | None = None,
    rate_hz: float = CONTROL_RATE_HZ,
    obstacles: Obstacles | None = None,
    footprint_radius_m: float = 0.0,
    wheel_errors: tuple[float, float] = (0.0, 0.0),
    controller: Controller | None = None,
    engine: Engine | None = None,
) -> Travel:
    """Drive by a script: each command holds until the next one, or until it is older than the drive allows.

    Args:
        commands: Time since the start [s], forward speed [m/s] and yaw rate [rad/s] of each, shape (K, 3).
        drive: Limits, motors and wheels.
        start: First x [m], y [m], yaw [rad] in world.
        duration_s: How long to drive [s]; None is until the last command is void and the robot stands.
        rate_hz: Control steps a second [Hz].
        obstacles: What stops the robot.
        footprint_radius_m: Radius of the circle that they stop [m].
        wheel_errors: How far the wheels' radius and separation are from the nominal ones, relative.
        controller: Who commands in place of the script, whose times then only say how long; a driver.
        engine: What moves the robot; None is the kinematic one.

    Raises:
        InputError: Commands are not finite or not in order of time, `duration_s` or `rate_hz` is out of
            range, or the start touches an obstacle.
    """
    course = loop_by_commands(
        commands,
        drive,
        start=start,
        duration_s=duration_s,
        rate_hz=rate_hz,
        footprint_radius_m=footprint_radius_m,
        wheel_errors=wheel_errors,
    )
    return (engine or Kinematic()).drive(course, controller, obstacles)


def loop_by_commands(
    commands: ArrayLike,
    drive: DriveSpec,
    *,
    start: Pose = (0.0, 0.0, 0.0),
    duration_s: float | None = None,
    rate_hz: float = CONTROL_RATE_HZ,
    footprint_radius_m: float = 0.0,
    wheel_errors: tuple[float, float] = (0.0, 0.0),
) -> ClosedLoop:
    """What plays a script, ready to run; arguments and refusals are those of `play`."""
    dt = _step(rate_hz, drive)
    guide = guide_by_commands(commands, drive)
    if duration_s is None:
        at_rest = 1 + drive.v_max / drive.a_max + drive.w_max / drive.alpha_max + 20 * drive.motor_lag_s
        end = float(guide.table[0, -1]) + drive.command_timeout_s + at_rest
    else:
        end = duration_s
    _check_duration(end)
    return ClosedLoop(
        drive=drive,
        guide=guide,
        dt=dt,
        pose0=start,
        steps=math.ceil(end / dt - 1e-9),
        least_steps=int(guide.table[0, -1] / dt),
        footprint_radius_m=footprint_radius_m,
        wheel_errors=wheel_errors,
    )


def _step(rate_hz: float, drive: DriveSpec) -> float:
    """Length of a control step [s]."""
    if not 0 < rate_hz < math.inf:
        raise InputError(f"rate_hz of a controller must be above 0 Hz and finite, got {rate_hz!r}")
    if rate_hz * drive.command_timeout_s <= 1:
        raise InputError(
            f"rate_hz of a controller must be above {1 / drive.command_timeout_s:g} Hz, or the drive would "
            f"stop between commands by its command_timeout_s, {drive.command_timeout_s:g} s; got "
            f"{rate_hz!r}: raise either"
        )
    return 1.0 / rate_hz


def _check_duration(duration_s: float) -> None:
    if not 0 < duration_s <= LONGEST_S:
        raise InputError(
            f"duration_s must be above 0 s and finite, at most {LONGEST_S:g}, a day; got {duration_s!r}"
        )
