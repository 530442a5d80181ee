"""Session: the robots of a twin as they are between switching on and off, and the room that they have."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from magtwin.errors import InputError
from magtwin.path.room import Room
from magtwin.sim.plant_families import plant_of, plant_text
from magtwin.sim.runs.simulate import robot_metadata
from magtwin.sim.sensors.model_error import ModelError
from magtwin.sim.session import offset_generator, session_of
from magtwin.spec.plant import PlantSpec
from magtwin.twin.twin import OF_SCENE, Session, Twin, checked_seed, without_tracking_error


def in_session(twin: Twin, session: Session | None = None, *, seed: int = 0) -> Twin:
    """The twin with its robots as they are in one session.

    A session lasts from switching the robot on to switching it off. Battery charge, IMU zero, wheels,
    odometry and the robot's own field differ from session to session.

    Args:
        twin: An opened twin.
        session: Number of a session to draw from the seed, or "survey" for the robot as it was when the map
            was surveyed. Default: the session of the twin if it has one, else session 0.
        seed: Seed of the draw.

    Returns:
        A twin with `session` set. Several robots are drawn independently.

    Raises:
        InputError: `session` is neither, or the twin is in another session already.
    """
    if twin.session:
        if session is None:
            return twin
        raise InputError(f"the twin is in session {twin.session['session']!r} already; open another")
    if session == "survey":
        return dataclasses.replace(twin, session={"session": "survey"})
    number = 0 if session is None else session
    if not isinstance(number, int | np.integer) or isinstance(number, bool) or number < 0:
        raise InputError(f'session must be a whole number from 0 up, or "survey", got {session!r}')
    number, seed = int(number), checked_seed(seed)
    scene = twin.scene.with_robots(lambda k, robot: session_of(robot, seed, number, which=k))
    return dataclasses.replace(twin, scene=scene, session={"session": number, "session_seed": seed})


def with_plant(twin: Twin, plant: PlantSpec | str | None) -> Twin:
    """The twin whose robots have another plant.

    Args:
        twin: An opened twin, not yet in a session.
        plant: A `PlantSpec`; or "NAME" or "NAME:SEED" of `magtwin.draw_plant`, from which each robot draws
            constants of its own. None changes nothing.

    Raises:
        InputError: The text names no plant, or the twin is in a session.
    """
    if plant is None:
        return twin
    if twin.session:
        text = f"the twin is in session {twin.session['session']!r} already; give `plant` before the session"
        raise InputError(text, parameter="plant")
    if not isinstance(plant, PlantSpec | str):
        raise InputError(f"plant must be a name or a PlantSpec, got {plant!r}", parameter="plant")
    text = plant if isinstance(plant, str) else plant_text(plant)
    scene = twin.scene.with_robots(lambda k, robot: dataclasses.replace(robot, plant=plant_of(text, which=k)))
    return dataclasses.replace(twin, scene=scene, metadata={**twin.metadata, "plant": text})


def in_session_of(twin: Twin, metadata: Mapping[str, str | int | float | bool]) -> Twin:
    """The twin in the session of a run, with the plant and the tracking of the run."""
    if metadata.get("plant", OF_SCENE) != OF_SCENE:
        twin = with_plant(twin, str(metadata["plant"]))
    if not metadata.get("tracking_error", True):
        twin = without_tracking_error(twin)
    if "session_seed" not in metadata:
        return in_session(twin, "survey")
    try:
        seed, session = int(metadata["session_seed"]), int(metadata["session"])
    except (KeyError, ValueError, OverflowError) as error:
        raise InputError(f"the metadata of the run name no valid session: {error}") from error
    return in_session(twin, session, seed=seed)


def model_error_of(twin: Twin, seed: int, *, which: int = 0) -> ModelError | None:
    """Statistics of the model error of a twin in its session. None if no error is drawn."""
    if twin.model_error is None:
        return None
    return twin.model_error.in_session(offset_generator(twin.session, seed, which=which))


def trained_on(twin: Twin) -> bool:
    """Whether the network of a twin was trained on its robot, plant and kind of session."""
    network, robot = twin.magnetometer, twin.scene.robot
    plant = {} if robot.plant == PlantSpec() else {"plant": OF_SCENE}
    known = {**robot_metadata(robot), **plant, **twin.session, **twin.metadata}
    return network is not None and network.knows(known)


def room_of(twin: Twin) -> Room:
    """The floor, footprint and obstacles that a path of the first robot must fit."""
    return Room(twin.scene.lab, twin.scene.robot.footprint_radius_m, twin.obstacles)
