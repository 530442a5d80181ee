"""Twin: an opened scene with its map and its network, in one session."""

import dataclasses
import hashlib
import importlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

import numpy as np

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.report.summary import Summarized, Summary
from magtwin.spec.base import spelled
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import PlacedRobot, RobotSpec, fields_of
from magtwin.spec.scene import Scene
from magtwin.spec.sensors import MagnetometerSpec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from magtwin.learn.inference.magnetometer import NeuralMagnetometer
    from magtwin.learn.models.predictor import Predictor
    from magtwin.learn.training.result import TrainingResult
    from magtwin.sim.sensors.model_error import ModelError
    from magtwin.usd.scene import OpenedScene

Kind = Literal["physical", "neural", "map-only"]
"""Kind of magnetometer."""

Session = int | Literal["survey"]
"""Number of a session, or the robot as it was when the map was surveyed."""

Metadata = dict[str, str | int | float | bool]


class HasScene(Protocol):
    """What can be made a scene, such as a `magtwin.Room`."""

    @property
    def scene(self) -> Scene:
        """The scene."""


class UsdStage(Protocol):
    """An open stage, a `pxr.Usd.Stage`."""

    def GetRootLayer(self) -> Any:  # noqa: N802
        """Its root layer."""


Place = Scene | HasScene | UsdStage | str | FilePath
"""A scene: in memory, as a room, as a stage of pxr's, or as the file of a stage."""

Network: TypeAlias = "str | FilePath | Predictor | TrainingResult | None"
"""Weights of a neural magnetometer: a file, a predictor, or what `magtwin.train` gives. None: the scene's."""


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
    """The open stage; `magtwin.twin.opening.geometry` reads it. None in another process."""

    stage: object = dataclasses.field(default=None, repr=False, compare=False)
    """Keeps the temporary stage of a `Scene` alive. None if `scene_file` is a user's file."""

    def plot(self) -> "Figure":
        """Draw the room from above, over the map; see `magtwin.plot`."""
        return importlib.import_module("magtwin").plot(self)  # type: ignore[no-any-return]

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "opened": None}  # an open stage stays in its process

    def _summary(self) -> Summary:
        """The scene and its file, the robot, the map and the network."""
        robot, field = self.scene.robot, self.field._summary()
        sensor = f"{robot.name}, {robot.magnetometer.kind} magnetometer at {robot.magnetometer.rate_hz:g} Hz"
        plant = self.metadata.get("plant", OF_SCENE if robot.plant != PlantSpec() else "")
        sensor += f", plant {plant}" if plant else ""
        more = f", and {len(self.scene.others)} more robots" if self.scene.others else ""
        network = self.magnetometer._summary().title.partition(" ")[2] if self.magnetometer else "none"
        rows = {
            "robot": sensor + more + (f", session {self.session['session']}" if self.session else ""),
            "map": field.title.partition(" ")[2],
            "network": network,
            "file": str(self.scene_file) if self.stage is None else "none: opened from a Scene",
        }
        title = f"Twin {self.scene.name}: floor {self.scene.lab.size_text}, {len(self.obstacles)} obstacles"
        return Summary(title, tuple(rows.items()))


MOST_RECENT = 4
"""Twins in memory whose runs can be drawn without naming their scene."""

_recent: dict[str, Twin] = {}


def remember(twin: Twin) -> None:
    """Keep a twin without a stage of the user's, of the last few, so that `recent` finds it."""
    if twin.stage is not None and (key := str(twin.metadata.get("scene_sha256", ""))):
        _recent.pop(key, None)
        _recent[key] = twin
        for old in list(_recent)[:-MOST_RECENT]:
            del _recent[old]


def recent(checksum: object) -> Twin | None:
    """The twin that `simulate` drove in this process, by the `scene_sha256` of its runs."""
    return _recent.get(str(checksum))


def scene_in(place: Any, what: str = "scene must be") -> Any:
    """The scene of a `Room`; a `Scene`, a stage and the name of a file as they are.

    Raises:
        InputError: It is none of these; begins with `what`.
    """
    if isinstance(place, str | os.PathLike | Scene) or hasattr(place, "GetRootLayer"):
        return place
    if not hasattr(type(place), "scene"):
        text = f"{what} a Scene, a Room, a stage or its file, got {type(place).__name__}"
        raise InputError(text, parameter=what.split()[0])
    return place.scene


def opened(
    twin: Twin | Place,
    network: Network,
    magnetometer: Kind | None,
    model_error: bool,
    function: str,
    **where: Any,
) -> Twin:
    """The twin, opened if it is a scene; `function` is named in the refusal of options that come too late.

    `where` are further options of `open_twin`, which is loaded only if it is needed.
    """
    if not isinstance(twin, Twin):
        where |= {"network": network, "magnetometer": magnetometer, "model_error": model_error}
        made: Twin = importlib.import_module("magtwin.twin.opening").open_twin(twin, **where)
        return made
    if network is not None or magnetometer is not None or any(where.values()):
        names = ", ".join(f"`{name}`" for name in ("network", *where))
        raise InputError(f"give {names} and `magnetometer` to open_twin, not to {function}, which got a Twin")
    return twin if model_error else without_model_error(twin)


def without_tracking_error(twin: Twin) -> Twin:
    """The twin whose controllers get exact poses."""

    def changed(k: int, robot: RobotSpec) -> RobotSpec:
        exact = {"localization_std_m": 0.0, "localization_yaw_std": 0.0, "localization_latency_s": 0.0}
        return dataclasses.replace(robot, drive=dataclasses.replace(robot.drive, **exact))  # type: ignore[arg-type]

    metadata = {**twin.metadata, "tracking_error": False}
    return dataclasses.replace(twin, scene=twin.scene.with_robots(changed), metadata=metadata)


def without_model_error(twin: Twin) -> Twin:
    """The twin whose neural magnetometer reads exactly what its network predicts, plus sensor noise."""
    metadata = twin.metadata if twin.magnetometer is None else {**twin.metadata, "model_error": False}
    return dataclasses.replace(twin, errors=False, model_error=None, metadata=metadata)


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

    def bare(k: int, placed: PlacedRobot) -> PlacedRobot:
        sensor = MagnetometerSpec() if k else placed.robot.magnetometer  # those of others change nothing here
        sensor = dataclasses.replace(sensor, network=None, network_sha256="", inputs=())
        robot = dataclasses.replace(placed.robot, asset=FilePath(), magnetometer=sensor)
        return dataclasses.replace(placed, robot=robot, path="")

    robots = fields_of([bare(k, placed) for k, placed in enumerate(scene.robots)])
    scene = dataclasses.replace(scene, map_layer=FilePath(), map_sha256="", **robots)
    return hashlib.sha256(spelled(scene).encode()).hexdigest()
