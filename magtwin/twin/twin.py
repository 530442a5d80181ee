"""Twin: an opened scene with its map and its network, in one session."""

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Literal

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.path.room import Room
from magtwin.report.summary import Summarized, Summary
from magtwin.spec.base import spelled
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.spec.sensors import MagnetometerSpec

if TYPE_CHECKING:
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer
    from magtwin.sim.sensors.model_error import ModelError
    from magtwin.usd.geometry import Link, Shape
    from magtwin.usd.scene import OpenedScene

Kind = Literal["physical", "neural", "map-only"]
"""Kind of magnetometer."""

Session = int | Literal["survey"]
"""Number of a session, or the robot as it was when the map was surveyed."""

Metadata = dict[str, str | int | float | bool]


OF_SCENE = "of the scene"
"""Metadata `plant` of a run whose plant is that of its scene."""


@dataclass(frozen=True, repr=False)
class Twin(Summarized):
    """A scene that is ready to simulate: `open_twin` makes one."""

    scene: Scene
    scene_file: FilePath
    """The stage that `scene` was read from."""

    field: AnomalyMap
    """The map that the magnetometer reads."""

    magnetometer: "NeuralMagnetometer | None"
    """Predictor of the disturbance. None if the magnetometer is not neural."""

    obstacles: Obstacles = dataclasses.field(default_factory=Obstacles)
    """Colliders of the scene."""

    metadata: Mapping[str, str | int | float | bool] = dataclasses.field(default_factory=dict)
    """Names and checksums of the files that were opened. Runs copy them."""

    platforms: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Checksum of each robot's platform field before a session is drawn, by the robot's name."""

    errors: bool = True
    """Whether readings of a neural magnetometer include model error."""

    model_error: "ModelError | None" = None
    """Statistics of the model error. None draws no error."""

    session: Mapping[str, str | int] = dataclasses.field(default_factory=dict)
    """`session` and `session_seed`. Empty before a session is chosen."""

    opened: "OpenedScene | None" = dataclasses.field(default=None, repr=False, compare=False)
    """The open stage with its links and shapes. None in another process."""

    stage: object = dataclasses.field(default=None, repr=False, compare=False)
    """Keeps the temporary stage of a `Scene` alive. None if `scene_file` is a user's file."""

    def geometry(self) -> "tuple[list[Shape], dict[str, Link]]":
        """Shapes of the lab and the first robot, and the links of that robot, for writers and viewers.

        They come from the stage that `open_twin` opened. A twin from another process opens it again.
        """
        from magtwin.usd.geometry import read_links, read_shapes
        from magtwin.usd.scene import open_alone

        name = self.scene.robot.name
        if self.opened is not None:
            opened = self.opened.alone(name)
            return opened.shapes, opened.links
        stage = open_alone(self.scene_file, name, lab=str(self.metadata.get("lab", "")))
        return list(read_shapes(stage)), read_links(stage)

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "opened": None}  # an open stage stays in its process

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)

    def _summary(self) -> Summary:
        """The scene and its file, the robot, the map and the network."""
        robot, field = self.scene.robot, self.field._summary()
        sensor = f"{robot.name}, {robot.magnetometer.kind} magnetometer at {robot.magnetometer.rate_hz:g} Hz"
        plant = self.metadata.get("plant", OF_SCENE if robot.plant != PlantSpec() else "")
        sensor += f", plant {plant}" if plant else ""
        more = f", and {len(self.scene.others)} more robots" if self.scene.others else ""
        width, depth = self.scene.lab.floor_m
        network = self.magnetometer._summary().title.partition(" ")[2] if self.magnetometer else "none"
        return Summary(
            f"Twin {self.scene.name}: floor {width:g} x {depth:g} m, {len(self.obstacles)} obstacles",
            (
                ("robot", sensor + more + (f", session {self.session['session']}" if self.session else "")),
                ("map", field.title.partition(" ")[2]),
                ("network", network),
                ("file", str(self.scene_file) if self.stage is None else "none: opened from a Scene"),
            ),
        )


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
    from magtwin.sim.session import session_of

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
    scene = dataclasses.replace(
        twin.scene,
        robot=session_of(twin.scene.robot, seed, number),
        others=tuple(
            dataclasses.replace(other, robot=session_of(other.robot, seed, number, which=k))
            for k, other in enumerate(twin.scene.others, 1)
        ),
    )
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
    from magtwin.sim.plant_families import plant_of, plant_text

    if plant is None:
        return twin
    if twin.session:
        raise InputError(
            f"the twin is in session {twin.session['session']!r} already; give `plant` before the session",
            parameter="plant",
        )
    if not isinstance(plant, PlantSpec | str):
        raise InputError(f"plant must be a name or a PlantSpec, got {plant!r}", parameter="plant")
    scene, text = twin.scene, plant if isinstance(plant, str) else plant_text(plant)
    robots = [
        dataclasses.replace(placed.robot, plant=plant_of(text, which=k))
        for k, placed in enumerate(scene.robots)
    ]
    others = tuple(
        dataclasses.replace(other, robot=robot) for other, robot in zip(scene.others, robots[1:], strict=True)
    )
    scene = dataclasses.replace(scene, robot=robots[0], others=others)
    return dataclasses.replace(twin, scene=scene, metadata={**twin.metadata, "plant": text})


def without_tracking_error(twin: Twin) -> Twin:
    """The twin whose controllers get exact poses."""

    def changed(robot: RobotSpec) -> RobotSpec:
        drive = dataclasses.replace(
            robot.drive, localization_std_m=0.0, localization_yaw_std=0.0, localization_latency_s=0.0
        )
        return dataclasses.replace(robot, drive=drive)

    scene = twin.scene
    others = tuple(dataclasses.replace(other, robot=changed(other.robot)) for other in scene.others)
    scene = dataclasses.replace(scene, robot=changed(scene.robot), others=others)
    return dataclasses.replace(twin, scene=scene, metadata={**twin.metadata, "tracking_error": False})


def in_session_of(twin: Twin, metadata: Mapping[str, str | int | float | bool]) -> Twin:
    """The twin in the session of a run, with the plant and the tracking of the run.

    Args:
        twin: The twin of the run.
        metadata: Metadata of the run. Without `session_seed`, the robot is as it was when surveyed.

    Raises:
        InputError: The metadata name no valid session.
    """
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


def model_error_of(twin: Twin, seed: int, *, which: int = 0) -> "ModelError | None":
    """Statistics of the model error of a twin in its session. None if no error is drawn.

    Args:
        twin: A twin in a session.
        seed: Seed of the run.
        which: Place of the robot in a scene of several, from 0.
    """
    from magtwin.sim.session import offset_generator

    if twin.model_error is None:
        return None
    return twin.model_error.in_session(offset_generator(twin.session, seed, which=which))


def trained_on(twin: Twin) -> bool:
    """Whether the network of a twin was trained on its robot, plant and kind of session."""
    from magtwin.sim.runs.simulate import robot_metadata

    network, robot = twin.magnetometer, twin.scene.robot
    plant = {} if robot.plant == PlantSpec() else {"plant": OF_SCENE}
    return network is not None and network.knows(
        {**robot_metadata(robot), **plant, **twin.session, **twin.metadata}
    )


def without_model_error(twin: Twin) -> Twin:
    """The twin whose neural magnetometer reads exactly what its network predicts, plus sensor noise."""
    metadata = twin.metadata if twin.magnetometer is None else {**twin.metadata, "model_error": False}
    return dataclasses.replace(twin, errors=False, model_error=None, metadata=metadata)


def room_of(twin: Twin) -> Room:
    """The floor, footprint and obstacles that a path of the first robot must fit."""
    return Room(twin.scene.lab.floor_m, twin.scene.robot.footprint_radius_m, twin.obstacles)


def checked_seed(seed: object) -> int:
    """The seed as an int; NumPy integers are accepted.

    Raises:
        InputError: It is not a whole number from 0 up.
    """
    if isinstance(seed, int | np.integer) and not isinstance(seed, bool) and seed >= 0:
        return int(seed)
    raise InputError(f"seed must be a whole number from 0 up, got {seed!r}")


def scene_sha256(scene: Scene) -> str:
    """Checksum of every value of a scene in its session, without its files, which have checksums."""

    def bare(robot: RobotSpec) -> RobotSpec:
        sensor = dataclasses.replace(robot.magnetometer, network=None, network_sha256="", inputs=())
        return dataclasses.replace(robot, asset=FilePath(), magnetometer=sensor)

    others = tuple(  # the sensors of other robots do not change this run
        dataclasses.replace(
            other, robot=bare(dataclasses.replace(other.robot, magnetometer=MagnetometerSpec())), path=""
        )
        for other in scene.others
    )
    scene = dataclasses.replace(
        scene, map_layer=FilePath(), map_sha256="", robot=bare(scene.robot), path="", others=others
    )
    return hashlib.sha256(spelled(scene).encode()).hexdigest()
