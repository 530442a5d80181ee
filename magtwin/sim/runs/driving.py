"""Driving: what robots are to drive, planned; and what they then did, all at once."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.path import Path
from magtwin.run.run import Run
from magtwin.sim.engines.replay import replayed
from magtwin.sim.motion.closed_loop import ClosedLoop, run_loops
from magtwin.sim.motion.commands import Commands
from magtwin.sim.motion.controllers import CONTROLLERS, CUSTOM_CONTROLLERS, Controller
from magtwin.sim.motion.drive import draw_wheel_errors
from magtwin.sim.motion.drive_input import DriveInput
from magtwin.sim.motion.driver import Driver
from magtwin.sim.motion.engine import KINEMATIC, Travel
from magtwin.sim.motion.follow import STAND, check_arrived, loop_along, loop_by_commands
from magtwin.sim.motion.pose_error import draw_pose_error
from magtwin.sim.runs.sensing import Conditions
from magtwin.spec.scene import Scene

Metadata = dict[str, str | int | float | bool]

RANDOM_S = 60.0
"""Default time for which a random driver drives [s]."""


@dataclass(frozen=True, eq=False)
class Course:
    """What a robot is to drive, without what a run draws: the same for all robots that are alike."""

    path: DriveInput
    loop: ClosedLoop | None
    """Planned; None for a run that is driven again."""

    speed: float
    metadata: Metadata
    """How the motion comes about."""


@dataclass(frozen=True, eq=False)
class Trip:
    """A course that a robot drives in a run."""

    scene: Scene
    course: Course
    draws: Mapping[str, np.random.Generator]
    """The generators of the run; see `magtwin.sim.runs.sensing.streams`."""

    label: str = ""
    """Which it is, at the beginning of refusals."""


def course_of(scene: Scene, path: DriveInput, speed: float, conditions: Conditions) -> Course:
    """Plan what a robot is to drive; arguments as for `magtwin.sim.runs.simulate.simulate`."""
    robot, named = scene.robot, conditions.controller
    if isinstance(path, Run):
        kept = ("path", "controller", "speed_m_s")
        told: Metadata = {name: path.metadata[name] for name in kept if name in path.metadata}
        return Course(path, None, speed, {**told, "engine": "replay"})
    engine: Metadata = {} if conditions.engine.name == "kinematic" else {"engine": conditions.engine.name}
    options: dict[str, Any] = {"footprint_radius_m": robot.footprint_radius_m}
    options["duration_s"] = conditions.duration_s
    if isinstance(path, Path):
        name = named if isinstance(named, str) else type(named).__name__
        plain = "follower" if _is_custom(named) else name  # the plan of a custom controller is not used
        room = conditions.obstacles
        loop = loop_along(path, robot.drive, speed=speed, controller=plain, obstacles=room, **options)
        told = {"path": path.name, "controller": name, "speed_m_s": float(speed)}
        return Course(path, loop, speed, {**told, **engine})
    if isinstance(path, Commands):
        loop = loop_by_commands(path.rows, robot.drive, start=scene.start, **options)
        told = {"path": path.name, "controller": "commands"}
    elif isinstance(path, str) and path == "random":
        options["duration_s"] = RANDOM_S if conditions.duration_s is None else conditions.duration_s
        loop = loop_by_commands(STAND, robot.drive, start=scene.start, **options)
        told = {"path": "random", "controller": "driver", "speed_m_s": float(speed)}
    else:
        raise InputError(f'path must be a Path, Commands, a Run or "random", got {path!r}', parameter="path")
    loop.check(conditions.obstacles)
    return Course(path, loop, speed, {**told, **engine})


def drive(trips: Sequence[Trip], conditions: Conditions) -> list[Travel]:
    """Drive robots, each as if it were alone."""
    loops: dict[int, ClosedLoop] = {}
    travels: dict[int, Travel] = {}
    for n, trip in enumerate(trips):
        course, robot = trip.course, trip.scene.robot
        with labelled(trip.label):
            if course.loop is None:
                assert isinstance(course.path, Run)
                travels[n] = replayed(course.path, robot.drive)
                continue
            errors = draw_wheel_errors(robot.drive, trip.draws["drive"])
            loops[n] = replace(course.loop, drive=robot.drive, wheel_errors=errors)
            if isinstance(course.path, Path):
                loops[n] = replace(loops[n], pose_error=draw_pose_error(robot.drive, trip.draws["drive"]))
            controller = _controller(trip, conditions)
            if controller is not None or conditions.engine is not KINEMATIC:
                travels[n] = conditions.engine.drive(loops[n], controller, conditions.obstacles)
    together = [n for n in loops if n not in travels]
    travels |= zip(together, run_loops([loops[n] for n in together], conditions.obstacles), strict=True)
    for n, trip in enumerate(trips):
        if isinstance(trip.course.path, Path) and conditions.duration_s is None:
            with labelled(trip.label):
                check_arrived(trip.course.path, trip.course.speed, loops[n], travels[n])
    return [travels[n] for n in range(len(trips))]


@contextmanager
def labelled(label: str) -> Iterator[None]:
    """Put which run or robot it is before refusals."""
    try:
        yield
    except InputError as error:
        if not label:
            raise
        raise InputError(f"{label}: {error}", parameter=error.parameter) from error


def _is_custom(named: str | Controller) -> bool:
    return not isinstance(named, str) or (named not in CONTROLLERS and named in CUSTOM_CONTROLLERS)


def _controller(trip: Trip, conditions: Conditions) -> Controller | None:
    """What commands a robot; None for the guide of its plan."""
    course, scene = trip.course, trip.scene
    if isinstance(course.path, str):
        assert course.loop is not None
        return Driver(
            scene.robot.drive,
            trip.draws["driver"],
            lab=scene.lab,
            obstacles=conditions.obstacles,
            footprint_radius_m=scene.robot.footprint_radius_m,
            start=scene.start,
            speed=course.speed,
            duration_s=RANDOM_S if conditions.duration_s is None else conditions.duration_s,
        )
    named = conditions.controller
    if not isinstance(course.path, Path) or not _is_custom(named):
        return None
    if not isinstance(named, str):
        return named
    return CUSTOM_CONTROLLERS[named](course.path, scene.robot.drive, course.speed)
