"""Together: several robots that drive in one lab at one time, a Run each.

Each is driven as if it were alone, on random numbers of its own. Then it is seen how near they came, and each
one's sensors are read with the others beside it: their iron in its magnetometer, their footprints at its own.
"""

from collections.abc import Iterable, Mapping
from typing import Literal

import numpy as np

from magtwin.errors import InputError, find
from magtwin.field.maps.map import AnomalyMap
from magtwin.path import Path
from magtwin.run.run import Run
from magtwin.sim.motion.commands import Commands
from magtwin.sim.motion.engine import Kinematic
from magtwin.sim.runs.companions import Approach, Companion, approaches
from magtwin.sim.runs.simulate import Predict, check_run, sense, streams, travel
from magtwin.sim.sensors.model_error import ModelError
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.scene import Scene

Way = Path | Commands | Run | str


def simulate_together(
    scene: Scene,
    ways: Mapping[str, Way],
    *,
    anomaly_map: AnomalyMap,
    rngs: Mapping[str, np.random.Generator],
    wanted: Iterable[str] | None = None,
    meet: Literal["refuse", "flag"] = "refuse",
    speed: float = 0.2,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    obstacles: Obstacles | None = None,
    controller: str = "follower",
    disturbances_nt: Mapping[str, Predict | None] | None = None,
    model_errors: Mapping[str, ModelError | None] | None = None,
    outside: Literal["nan", "clamp", "raise"] = "nan",
    lidar: Literal["schedule", "on", "off"] = "schedule",
) -> dict[str, Run]:
    """Drive robots of a scene at one time; each is moved by the kinematic engine.

    A robot's Run is that of `simulate` in `scene.led_by(name)` with the same generator, but for what the
    others do to its magnetometer, and the bumps.

    Args:
        scene: Lab and robots.
        ways: What each robot drives, by its name, as for `simulate`; those that are not named are not there.
        anomaly_map: What `scene.map_layer` holds.
        rngs: Source of all noise of each, by name.
        wanted: Names of the robots whose sensors are read; all unless given. The others drive nevertheless.
        meet: What becomes of robots whose footprints overlap: a refusal with time and place, or flag_bump in
            both while it lasts; they drive through each other.
        speed: As for `simulate`, of each.
        duration_s: As for `simulate`, of each.
        rate_hz: As for `simulate`.
        obstacles: As for `simulate`.
        controller: A name of `magtwin.sim.motion.controllers.CONTROLLERS`.
        disturbances_nt: What predicts the disturbance of each robot with a neural magnetometer, by name.
        model_errors: Statistics of the errors of these predictions, by name; None draws none.
        outside: As for `simulate`.
        lidar: As for `simulate`.

    Returns:
        A Run for each that is wanted, by name. Its metadata name the robot, and of the others the one that
        came nearest, how near [m] and when [s].

    Raises:
        InputError: Robots would meet, or `simulate` would refuse one; the text names it.
    """
    if not ways:
        raise InputError("no robot is to drive; name one at least")
    find("way of robots to meet", meet, {"refuse": None, "flag": None})
    predicts = {name: (disturbances_nt or {}).get(name) for name in ways}
    led = {name: scene.led_by(name) for name in ways}
    names = tuple(ways) if wanted is None else tuple(wanted)
    rates, draws, robots, metadata = {}, {}, {}, {}
    for name, way in ways.items():
        try:
            rates[name] = check_run(
                led[name],
                way,
                anomaly_map=anomaly_map,
                rate_hz=rate_hz,
                duration_s=duration_s,
                lidar=lidar,
                network=predicts[name] is not None,
            )
            draws[name] = streams(rngs[name])
            motion, metadata[name] = travel(
                led[name],
                way,
                draws[name],
                speed,
                duration_s,
                obstacles or Obstacles(),
                controller,
                Kinematic(),
            )
        except InputError as error:
            raise InputError(f"robot {name!r}: {error}") from error
        robots[name] = Companion(led[name].robot, motion)
    near = list(approaches(robots))
    if meet == "refuse":
        _check_apart(near)
    runs = {}
    for name in names:
        robot = find("robot", name, robots)
        sensed = sense(
            led[name],
            robot.motion,
            draws[name],
            anomaly_map=anomaly_map,
            rate_hz=rates[name],
            duration_s=duration_s,
            outside=outside,
            lidar=lidar,
            metadata=metadata[name],
            network=predicts[name] is not None,
            companions=[other for key, other in robots.items() if key != name],
        )
        predict = predicts[name]
        run = sensed.read(None if predict is None else predict(sensed.run), (model_errors or {}).get(name))
        runs[name] = run.with_metadata(robot=name, **_nearest(name, near))
    return runs


def _check_apart(near: Iterable[Approach]) -> None:
    """Refuse robots that meet; the first two of them."""
    met = [one for one in near if one.meet_s is not None]
    if met:
        first = min(met, key=lambda one: one.meet_s or 0.0)
        a, b = first.names
        x, y = first.p_meet
        raise InputError(
            f"robots {a!r} and {b!r} would run into each other after {first.meet_s:.2f} s at ({x:.2f}, "
            f"{y:.2f}) m; give one another path, start or speed, or have it flagged as a bump "
            '(meet="flag")'
        )


def _nearest(name: str, near: Iterable[Approach]) -> dict[str, str | float]:
    """Metadata of the approach that was the nearest of a robot's; none of one that drove alone."""
    own = [one for one in near if name in one.names]
    if not own:
        return {}
    least = min(own, key=lambda one: one.clearance_m)
    other = next(n for n in least.names if n != name)
    return {
        "nearest_robot": other,
        "nearest_clearance_m": round(least.clearance_m, 6),
        "nearest_t_s": least.t_s,
    }
