"""Several robots that drive in one lab at the same time, a Run each.

Each is driven as if it were alone, with its own random numbers. Then the least distances are found, and each
robot's sensors are read with the others beside it: their iron at its magnetometer, their footprints at its
own.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from magtwin.errors import InputError, find
from magtwin.field.maps.map import AnomalyMap
from magtwin.run.run import Run
from magtwin.sim.motion.drive_input import DriveInput
from magtwin.sim.runs.driving import Trip, course_of, drive, labelled
from magtwin.sim.runs.neighbours import Approach, Neighbour, approaches
from magtwin.sim.runs.sensing import Conditions, Sensing, streams
from magtwin.sim.runs.simulate import Finish, Sensed, check_run, read_all
from magtwin.spec.scene import Scene


def simulate_robots(
    scene: Scene,
    paths: Mapping[str, DriveInput],
    *,
    anomaly_map: AnomalyMap,
    rngs: Mapping[str, np.random.Generator],
    wanted: Collection[str] | None = None,
    meet: Literal["refuse", "flag"] = "refuse",
    speed: float = 0.2,
    finish: Mapping[str, Finish] = MappingProxyType({}),
    networks: Collection[str] = (),
    progress: Callable[[int, int, str], Any] | None = None,
    each: Callable[[str, Run], Any] | None = None,
    **options: Any,
) -> dict[str, Run]:
    """Drive robots of a scene at the same time, each with the kinematic engine; see `magtwin.twin.robots`.

    A robot's Run is that of `simulate` in `scene.led_by(name)` with the same generator, except for the
    field of the others at its magnetometer, and the bumps. Arguments are those of `simulate`, by the robot's
    name where robots differ; `networks` are the robots that have one. `paths` is what each drives: robots
    without a path are absent. `wanted` names those whose sensors are read; the others drive nevertheless.
    `meet` is what happens if footprints overlap: "refuse" names time and place, "flag" sets flag_bump in both
    Runs while they drive through each other.

    Returns:
        A Run for each wanted robot, by name. Its metadata name the robot, and the robot that came nearest,
        with clearance [m] and time [s].
    """
    if not paths:
        raise InputError("no robot is to drive; name one at least", parameter="paths")
    find("way of robots to meet", meet, {"refuse": None, "flag": None})
    led = {name: scene.led_by(name) for name in paths}
    common = Conditions(anomaly_map=anomaly_map, network=False, **options)
    conditions = {name: replace(common, network=name in networks) for name in paths}
    trips = []
    for name, path in paths.items():
        with labelled(f"robot {name!r}"):
            check_run(led[name], path, conditions[name])
            course = course_of(led[name], path, speed, conditions[name])
            trips.append(Trip(led[name], course, streams(rngs[name]), f"robot {name!r}"))
    motions = zip(paths, drive(trips, common), strict=True)
    robots = {name: Neighbour(led[name].robot, motion) for name, motion in motions}
    near = list(approaches(robots))
    if meet == "refuse":
        _check_apart(near)
    runs = {}
    for name, trip in zip(paths, trips, strict=True):
        if wanted is not None and name not in wanted:
            continue
        others = [other for key, other in robots.items() if key != name]
        about = {"robot": name, **_nearest(name, near)}

        def read(sensed: Sensed, name: str = name, about: Mapping[str, Any] = about) -> Run:
            told = replace(sensed, run=sensed.run.with_metadata(**about))
            return finish.get(name, Sensed.read)(told)

        runs[name] = read_all(
            Sensing(led[name], trip.draws, conditions[name], neighbours=others),
            robots[name].motion,
            trip.course.metadata,
            read,
            progress=progress,
            each=None if each is None else partial(each, name),
        )
    return runs


def _check_apart(near: Iterable[Approach]) -> None:
    """Refuse robots that meet; the text names the first two."""
    met = [approach for approach in near if approach.meet_s is not None]
    if met:
        first = min(met, key=lambda approach: approach.meet_s or 0.0)
        a, b = first.names
        x, y = first.p_meet
        text = f"would run into each other after {first.meet_s:.2f} s at ({x:.2f}, {y:.2f}) m"
        way = 'give one another path, start or speed, or have it flagged as a bump (meet="flag")'
        raise InputError(f"robots {a!r} and {b!r} {text}; {way}")


def _nearest(name: str, near: Iterable[Approach]) -> dict[str, str | float]:
    """Metadata of a robot's nearest approach; empty if it drove alone."""
    own = [approach for approach in near if name in approach.names]
    if not own:
        return {}
    least = min(own, key=lambda approach: approach.clearance_m)
    other = next(other for other in least.names if other != name)
    clearance_m = round(least.clearance_m, 6)
    return {"nearest_robot": other, "nearest_clearance_m": clearance_m, "nearest_t_s": least.t_s}
