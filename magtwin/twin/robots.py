"""Simulate robots: all robots of a scene at the same time, a Run each."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from magtwin.errors import find
from magtwin.path import Path
from magtwin.run.run import Run
from magtwin.sim.motion.drive_input import drive_input
from magtwin.spec.plant import PlantSpec
from magtwin.twin.opening import led_by
from magtwin.twin.session import in_session, room_of, with_plant
from magtwin.twin.simulation import check_commands, finisher
from magtwin.twin.twin import Kind, Network, Place, Session, Twin, checked_seed, opened

if TYPE_CHECKING:
    from magtwin.sim.motion.commands import Commands


def simulate_robots(
    twin: Twin | Place,
    paths: "Mapping[str, Path | Commands | Run | str | FilePath | ArrayLike] | None" = None,
    *,
    robots: Iterable[str] | None = None,
    meet: Literal["refuse", "flag"] = "refuse",
    seed: int = 0,
    session: Session | None = None,
    plant: PlantSpec | str | None = None,
    fit: bool = False,
    speed: float = 0.2,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    network: Network = None,
    magnetometer: Kind | None = None,
    model_error: bool = True,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
    controller: str = "follower",
    progress: Callable[[int, int, str], Any] | None = None,
    each: Callable[[str, Run], Any] | None = None,
) -> dict[str, Run]:
    """Drive all robots of a scene at the same time. Each robot gets a Run.

    Each magnetometer also reads the iron of the other robots. The first robot draws what `simulate` draws
    with the same seed; each other robot has a generator of its own.

    Args:
        twin: An opened twin, or a scene as for `open_twin`.
        paths: What each robot drives, by name, as for `simulate`. Default: the path in the scene, else
            "figure8".
        robots: Names of the robots whose sensors are read. Default: all. All robots drive.
        meet: What happens where footprints overlap: "refuse" raises an error with time and place; "flag"
            sets flag_bump of both robots, which then drive through each other.
        seed: As for `simulate`.
        session: As for `simulate`; each robot is drawn independently.
        plant: As for `simulate`; each robot has constants of its own.
        fit: As for `simulate`, of each robot.
        speed: As for `simulate`, of each robot.
        duration_s: As for `simulate`, of each robot.
        rate_hz: As for `simulate`.
        network: As for `open_twin`, if `twin` is a file; of each robot.
        magnetometer: As for `open_twin`, if `twin` is a file; of each robot.
        model_error: As for `simulate`.
        lidar: As for `simulate`.
        outside: As for `simulate`.
        controller: A name of `magtwin.sim.motion.controllers.CONTROLLERS`.
        progress: As for `simulate`, of each long run in turn.
        each: As for `simulate`, called with the robot's name and each block of its run.

    Returns:
        Runs by robot name, in the scene's order. The metadata of each also name the robot, the nearest other
        robot, and the time and clearance of their closest approach.

    Raises:
        InputError: A name is not that of a robot, robots would meet, or `simulate` would refuse one of them.
    """
    from magtwin.sim.exact import check_field, check_read
    from magtwin.sim.runs.multi_robot import simulate_robots as run_robots

    seed = checked_seed(seed)
    twin = opened(twin, network, magnetometer, model_error, "simulate_robots")
    twin = in_session(with_plant(twin, plant), session, seed=seed)
    check_field(twin.scene, twin.field)
    placed = {other.robot.name: other for other in twin.scene.robots}
    for name in (*(paths or {}), *(robots or ())):
        find("robot", name, placed)
    twins = {name: led_by(twin, name) for name in placed}
    driven = {
        name: drive_input((paths or {}).get(name, robot.path or "figure8"), room_of(twins[name]), fit=fit)
        for name, robot in placed.items()
    }
    for name, path in driven.items():
        check_commands(path, twins[name].magnetometer)
    runs = run_robots(
        twin.scene,
        driven,
        anomaly_map=twin.field,
        rngs={name: np.random.default_rng((seed, 2, k) if k else seed) for k, name in enumerate(placed)},
        wanted=[name for name in placed if robots is None or name in set(robots)],
        meet=meet,
        speed=speed,
        duration_s=duration_s,
        rate_hz=rate_hz,
        obstacles=twin.obstacles,
        controller=controller,
        networks=[name for name, own in twins.items() if own.magnetometer is not None],
        finish={
            name: finisher(twins[name], path, seed, duration_s, which=k)
            for k, (name, path) in enumerate(driven.items())
        },
        outside=outside,
        lidar=lidar,
        progress=progress,
        each=each,
    )
    for run in runs.values():
        check_read(run, twin.field)
    return runs
