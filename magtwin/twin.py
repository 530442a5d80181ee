"""Twin: a scene opened for running, with the map and the network that its prims name."""

import dataclasses
import hashlib
import shutil
import tempfile
import warnings
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, MismatchWarning, find
from magtwin.field.maps.map import AnomalyMap
from magtwin.files import existing, git_revision, sha256
from magtwin.path import Path
from magtwin.placement import Room
from magtwin.run.run import Run
from magtwin.sim.motion.way import way_of, ways_of
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.scene import MagnetometerSpec, RobotSpec, Scene, SurveySpec, spelled
from magtwin.summary import Summarized, Summary
from magtwin.version import __version__

Kind = Literal["physical", "neural", "map-only"]
Session = int | Literal["survey"]
Metadata = dict[str, str | int | float | bool]

if TYPE_CHECKING:
    from tempfile import TemporaryDirectory

    from magtwin.learn.inference.magnetometer import NeuralMagnetometer, Read
    from magtwin.placement import Room
    from magtwin.sim.motion.commands import Commands
    from magtwin.sim.motion.controllers import Controller
    from magtwin.sim.motion.engine import Engine
    from magtwin.sim.runs.many import Runs
    from magtwin.sim.runs.simulate import Predict, Sensed
    from magtwin.sim.sensors.lidar import Scans
    from magtwin.sim.sensors.model_error import ModelError


@dataclass(frozen=True, repr=False)
class Twin(Summarized):
    """A scene, and what runs it."""

    scene: Scene
    scene_file: FilePath
    """The stage that `scene` was read from."""

    field: AnomalyMap
    """The map that the magnetometer reads."""

    magnetometer: "NeuralMagnetometer | None"
    """What predicts the disturbance of a neural magnetometer; none for the other kinds."""

    obstacles: Obstacles = dataclasses.field(default_factory=Obstacles)
    """What stands in the scene."""

    metadata: Mapping[str, str | int | float | bool] = dataclasses.field(default_factory=dict)
    """What a run is to say of the files that were opened: their names as they were given, and checksums."""

    platforms: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """Checksum of what makes each robot's own field, as its asset has it, by the robot's name."""

    errors: bool = True
    """Whether readings of a neural magnetometer are to have an error about what the network predicts."""

    model_error: "ModelError | None" = None
    """Statistics of that error; None draws none."""

    session: Mapping[str, str | int] = dataclasses.field(default_factory=dict)
    """Metadata of the session that the robots are in (`session`, `session_seed`); empty before one is
    chosen."""

    stage: object = dataclasses.field(default=None, repr=False, compare=False)
    """Keeps the temporary stage of a `Scene` that no file holds; None where `scene_file` is a user's own."""

    def _summary(self) -> Summary:
        """The scene and its file, the robot, the map and the network."""
        robot, field = self.scene.robot, self.field._summary()
        sensor = f"{robot.name}, {robot.magnetometer.kind} magnetometer at {robot.magnetometer.rate_hz:g} Hz"
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


class _Stage:
    """A temporary folder for the stage of a scene that no file holds; it lasts as long as its twins."""

    def __init__(self) -> None:
        self.folder = FilePath(tempfile.mkdtemp(prefix="magtwin-"))
        weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    def __reduce__(self) -> tuple[type[FilePath], tuple[str]]:
        return FilePath, (str(self.folder),)  # a copy in another process must not end it


def _twin_of_scene(
    scene: Scene, net: str | FilePath | None, magnetometer: Kind | None, model_error: bool
) -> Twin:
    """The twin of a scene that no file holds: authored as `author_scene` does, for as long as it is used."""
    from magtwin.author.scene import author_scene

    stage = _Stage()
    twin = open_twin(
        author_scene(scene, stage.folder / "scene"),
        net=net,
        magnetometer=magnetometer,
        model_error=model_error,
    )
    metadata = {name: fact for name, fact in twin.metadata.items() if name != "scene_file"}
    return dataclasses.replace(twin, metadata=metadata, stage=stage)


def open_twin(
    scene_file: Scene | str | FilePath,
    *,
    net: str | FilePath | None = None,
    magnetometer: Kind | None = None,
    model_error: bool = True,
) -> Twin:
    """Open a stage, the map layer and the network that it names.

    Warns (`magtwin.MismatchWarning`) where the network learned on another map or another robot, or at another
    place than the robot's own, with the expected effect. Runs keep the text as the fact `network_mismatch`.

    Args:
        scene_file: Root layer of a scene; or a `Scene`, which is authored to a temporary folder. Only what
            the `Scene` itself holds is in it: colliders that were added to a stage by hand are not.
        net: Weights to use in place of those that the magnetometer names (.safetensors or .pth), for a
            neural magnetometer; or "none" for a physical one.
        magnetometer: Kind of magnetometer to use in place of the scene's: "physical", "neural" or "map-only".
        model_error: Whether the readings of a neural magnetometer are off what the network predicts, as they
            were on recordings that it never saw; see `magtwin.sim.sensors.model_error`.

    Raises:
        InputError: The stage, its map or its weights are missing, broken, or not what the stage's
            checksums say.
    """
    if isinstance(scene_file, Scene):
        return _twin_of_scene(scene_file, net, magnetometer, model_error)
    from magtwin.author.scene import read_scene
    from magtwin.usd.layers import stage_sha256
    from magtwin.usd.maps import load_map
    from magtwin.usd.obstacles import read_obstacles

    scene_file = FilePath(scene_file)
    scene = read_scene(scene_file, check_network=net is None and magnetometer in (None, "neural"))
    scene = dataclasses.replace(
        scene,
        robot=_with_magnetometer(scene.robot, net, magnetometer),
        others=tuple(
            dataclasses.replace(other, robot=_with_magnetometer(other.robot, net, magnetometer))
            for other in scene.others
        ),
    )
    obstacles, field, network = read_obstacles(scene_file), load_map(scene.map_layer), _magnetometer(scene)
    metadata: Metadata = {"scene_file": scene_file.as_posix(), "scene_sha256": stage_sha256(scene_file)}
    if revision := git_revision(scene_file.parent):
        metadata["git_revision"] = revision
    metadata |= {"map": field.name, "map_sha256": sha256(scene.map_layer)}
    platforms = {one.robot.name: _platform_sha256(one.robot) for one in scene.robots}
    metadata["platform_sha256"] = platforms[scene.robot.name]
    twin = _with_network(Twin(scene, scene_file, field, network, obstacles, metadata, platforms, model_error))
    if network and net is not None:
        return dataclasses.replace(twin, metadata={**twin.metadata, "network_file": FilePath(net).as_posix()})
    return twin


def _platform_sha256(robot: RobotSpec) -> str:
    """Checksum of what makes a robot's own field: of the figures that are not their default, so that a figure
    which a later magtwin adds changes nothing.
    """
    spec = robot.platform
    figures = [(one.name, getattr(spec, one.name), one.default) for one in dataclasses.fields(spec)]
    told = sorted((name, value) for name, value, default in figures if value != default)
    return hashlib.sha256(repr(told).encode()).hexdigest()


def _platform_of(twin: Twin, robot: RobotSpec) -> str:
    """Checksum of the platform of a twin's robot, before a session is drawn where that is known."""
    return twin.platforms.get(robot.name) or _platform_sha256(robot)


def _with_network(twin: Twin) -> Twin:
    """The twin with what its network tells: metadata of runs, warnings, and the statistics of its error."""
    network, robot = twin.magnetometer, twin.scene.robot
    if network is None:
        return twin
    from magtwin.learn.data.origin import mismatches

    found = mismatches(
        network.net.metadata,
        network.name,
        residual_sd_nt=network.residual_sd_nt,
        field=twin.field,
        map_sha256=str(twin.metadata["map_sha256"]),
        robot=robot,
        platform_sha256=_platform_of(twin, robot),
    )
    metadata = {**twin.metadata, **network.metadata}
    texts = [one.text for one in found]
    statistics = network.model_error() if twin.errors else None
    if twin.errors and statistics is None:
        texts.append(
            f"{network.name} does not say how its error varies in time, so none is drawn and readings are as "
            "near to its predictions as the sensor's noise; train it again to change that"
        )
    for text in texts:
        warnings.warn(text, MismatchWarning, stacklevel=3)
    if found:
        metadata["network_mismatch"] = "; ".join(one.text for one in found)
    metadata["model_error"] = statistics is not None
    return dataclasses.replace(twin, metadata=metadata, model_error=statistics)


def _with_magnetometer(robot: RobotSpec, net: str | FilePath | None, kind: Kind | None) -> RobotSpec:
    """A robot whose magnetometer is of another network or kind; arguments as for `open_twin`."""
    spec = robot.magnetometer
    if net is not None:
        if FilePath(net).is_dir():
            raise InputError(f"{net}: a folder; name the weights file in it")
        of, weights = ("physical", None) if str(net) == "none" else ("neural", FilePath(net).resolve())
        spec = dataclasses.replace(spec, kind=of, network=weights, network_sha256="", inputs=())  # type: ignore[arg-type]
    if kind is not None:
        if kind != "neural" and net is not None and str(net) != "none":
            raise InputError(f"net is for a neural magnetometer, not for {kind!r}; give one of the two")
        spec = dataclasses.replace(spec, kind=kind)
    return dataclasses.replace(robot, magnetometer=spec)


def twin_of(
    run: Run, scene: str | FilePath | None = None, *, near: str | FilePath | None = None, check: bool = True
) -> Twin:
    """The twin that a run came from: the scene that its metadata name, with their network and magnetometer.

    Args:
        run: A run that `simulate` made, from any file that keeps its metadata.
        scene: Where the scene lies now; None looks for it where the metadata say.
        near: The run's own file: names are taken from its folder too, where they lead nowhere from here.
        check: Whether what is found must be what the run came from, by the checksums of its metadata.

    Raises:
        InputError: The metadata name no scene, or it or its network is not there, or is not what it was.
    """
    metadata, scene = run.metadata, scene_of(run, scene, near=near)
    kind: Any = metadata.get("magnetometer")
    network = str(metadata["network_file"]) if "network_file" in metadata else None
    twin = open_twin(
        scene,
        net=network if network is None else locate(network, near) or network,
        magnetometer=kind if network is None else None,
        model_error=bool(metadata.get("model_error", False)),
    )
    for name, what in _CHECKSUMS.items() if check else ():
        if metadata.get(name, "") != twin.metadata.get(name, ""):
            raise InputError(
                f"{scene}: {what} is not what the run came from: {name} is "
                f"{twin.metadata.get(name, 'none')}, the run says {metadata.get(name, 'none')}"
            )
    return twin


_CHECKSUMS = {"map_sha256": "its map", "network_sha256": "its network", "scene_sha256": "the scene"}


def in_session(twin: Twin, session: Session | None = None, *, seed: int = 0) -> Twin:
    """The twin with its robots as they are in one session, from switching on to switching off.

    Args:
        twin: What `open_twin` gave.
        session: Number of a session to draw from the seed: battery charge, IMU zero, wheels, odometry and
            the robot's own field differ from session to session. "survey" is the robot as it was when the
            map was surveyed, without these changes. Default: the session that the twin is in already, or
            else session 0.
        seed: Seed of the draw.

    Returns:
        A twin whose `session` says which session it is. Several robots are drawn independently.

    Raises:
        InputError: `session` is neither, or the twin is in a session already.
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
    number, seed = int(number), _seed(seed)
    scene = dataclasses.replace(
        twin.scene,
        robot=session_of(twin.scene.robot, seed, number),
        others=tuple(
            dataclasses.replace(other, robot=session_of(other.robot, seed, number, which=k))
            for k, other in enumerate(twin.scene.others, 1)
        ),
    )
    return dataclasses.replace(twin, scene=scene, session={"session": number, "session_seed": seed})


def in_session_of(twin: Twin, metadata: Mapping[str, str | int | float | bool]) -> Twin:
    """The twin in the session of a run.

    Args:
        twin: The twin of the run.
        metadata: Those of the run. Without `session_seed`, the run is of the robot as it was surveyed.

    Raises:
        InputError: The metadata do not say which session it was.
    """
    if "session_seed" not in metadata:
        return in_session(twin, "survey")
    try:
        seed, session = int(metadata["session_seed"]), int(metadata["session"])
    except (KeyError, ValueError) as error:
        raise InputError(f"the metadata of the run do not say which session it was of: {error}") from error
    return in_session(twin, session, seed=seed)


def check_figures(scene: Scene, metadata: Mapping[str, str | int | float | bool], name: str) -> None:
    """Refuse a scene that is not, figure by figure, the one that a run came from.

    Args:
        scene: The scene, its robot as it was in the run's session.
        metadata: Those of the run.
        name: What to call the run.

    Raises:
        InputError: Its figures have another checksum, or the run tells none.
    """
    found, said = _config_sha256(scene), metadata.get("config_sha256", "none")
    if found != said:
        raise InputError(
            f"{name}: came from a scene whose figures have the sha256 {said}, those of {scene.name!r} in its "
            f"session have {found}; name the scene that it was made in"
        )


def scene_of(
    run: Run, scene: str | FilePath | None = None, *, near: str | FilePath | None = None
) -> FilePath:
    """The file of the scene that a run came from; arguments as for `twin_of`.

    Raises:
        InputError: The metadata name none, or it is not there.
    """
    if scene is not None:
        return existing(scene, "scene")
    if "scene_file" not in run.metadata:
        raise InputError("the run does not say which scene it came from; name it (--scene)")
    found = locate(str(run.metadata["scene_file"]), near)
    if found is None:
        raise InputError(
            f"{run.metadata['scene_file']}: the scene of the run is not there; name it (--scene)"
        )
    return found


def locate(file: str, near: str | FilePath | None = None) -> FilePath | None:
    """A file or folder that metadata name, seen from here or from the folder of `near`, or none.

    A device or pipe is none: metadata come with files of anyone's, and reading it might never end.
    """
    places = [FilePath(file)]
    if near is not None:  # a run may be a folder of its own
        places += [FilePath(near) / file, FilePath(near).parent / file]
    return next((place for place in places if place.is_file() or place.is_dir()), None)


def scene_from_toml(
    path: str | FilePath,
    *,
    map_layer: str | FilePath | None = None,
    network: str | FilePath | None = None,
    workshop: str | FilePath | None = None,
    report: Callable[[str], Any] = lambda text: None,
    progress: Callable[[int, int, str], Any] = lambda done, total, what: None,
) -> Scene:
    """The scene that a TOML describes, its network read and its inputs named.

    A scene that names no map is surveyed by its own robot, where its Earth's field is known. The map of one
    that names a map, sources or furniture too is compared with their field.

    Args:
        path: The TOML; files that it names are taken from its folder.
        map_layer: Map to use in place of the one that it names. The Earth's field, sources and furniture stay
            as the TOML has them.
        network: Weights to use in place of those that it names (.safetensors or .pth).
        workshop: Folder for the robot, where the TOML names one by its URDF, and for the map of a survey.
            Default: a temporary folder, which is deleted when Python ends; `author_scene` copies from it.
        report: Called with a line on how the scene was surveyed, or how map and sources differ.
        progress: Called in a survey with headings done, headings in all, and what is being done.

    Raises:
        InputError: A key is misspelt or missing, a file is not there or not what it should be, there is
            neither a map nor a field to survey, or the map contradicts the Earth's field, sources and
            furniture; the text says by how much.
    """
    from magtwin.author.scene import scene_from_toml as scene_of
    from magtwin.sim.contradiction import check_agrees
    from magtwin.usd.maps import load_map

    if workshop is None:
        import tempfile

        _WORKSHOPS.append(tempfile.TemporaryDirectory(prefix="magtwin-"))
        workshop = _WORKSHOPS[-1].name

    def inputs_of(weights: FilePath) -> tuple[str, ...]:
        from magtwin.learn.models.predictor import load_predictor

        return load_predictor(weights).features

    def survey_of(scene: Scene, spec: SurveySpec, seed: int, obstacles: Obstacles) -> FilePath:
        from magtwin.sim.room_survey import survey_room
        from magtwin.usd.maps import save_map

        source = f"{FilePath(path).name} sha256:{sha256(path)}"
        surveyed = survey_room(scene, spec, seed=seed, obstacles=obstacles, source=source, progress=progress)
        layer = FilePath(workshop) / f"{scene.name}.map.usdc"
        save_map(surveyed.field, layer)
        report(f"{scene.name} names no map: {surveyed}")
        return layer

    scene = scene_of(
        path,
        map_layer=map_layer,
        network=network,
        workshop=workshop,
        inputs_of=inputs_of,
        survey_of=survey_of,
    )
    if scene.map_layer.parent != FilePath(workshop):
        where = f"{path} with {map_layer or scene.map_layer.name}"
        found = check_agrees(scene, load_map(scene.map_layer), where)
        if found and found.rms_nt >= NOTED_NT:
            report(
                f"Note: the map differs from the field of the scene's Earth, sources and furniture by {found}"
            )
    return scene


def new_scene(file: str | FilePath, *, force: bool = False) -> FilePath:
    """Write a TOML that describes a small furnished room, with comments; `scene_from_toml` reads it.

    Args:
        file: TOML file to write; the scene gets its name.
        force: Whether a file that exists is replaced.

    Returns:
        The file.

    Raises:
        InputError: The file exists and `force` was not given, or its name cannot name a scene.
    """
    from magtwin.author.room import check_name
    from magtwin.files import output, shipped

    name = FilePath(file).stem
    check_name(name)
    text = shipped("scenes", "starter.toml").read_text(encoding="utf-8")
    text = text.replace('name = "room"', f'name = "{name}"', 1)
    with output(file, force=force) as aside:
        aside.write_text(text, encoding="utf-8")
    return FilePath(file)


NOTED_NT = 50.0
"""Difference of a map from its sources that is reported [nT]: above what a careful survey errs by."""

_WORKSHOPS: "list[TemporaryDirectory[str]]" = []
"""Temporary folders of scenes, deleted when Python ends."""


def author_scene(
    scene: Scene | str | FilePath,
    folder: str | FilePath,
    *,
    force: bool = False,
    report: Callable[[str], Any] = lambda text: None,
    progress: Callable[[int, int, str], Any] = lambda done, total, what: None,
) -> FilePath:
    """Write a scene as a folder of USD layers that needs nothing outside of it.

    Args:
        scene: A Scene, or the TOML of one; see `scene_from_toml`.
        folder: Folder to make.
        force: Whether a folder that exists is replaced.
        report: As for `scene_from_toml`.
        progress: As for `scene_from_toml`.

    Returns:
        The root layer, `folder/<name>.usda`.

    Raises:
        InputError: The folder exists, or as for `scene_from_toml`.
    """
    import tempfile

    from magtwin.author.scene import author_scene as author
    from magtwin.files import check_free

    check_free(folder, force=force)
    if isinstance(scene, Scene):
        return author(scene, folder, force=force)
    with tempfile.TemporaryDirectory() as workshop:
        read = scene_from_toml(scene, workshop=workshop, report=report, progress=progress)
        return author(read, folder, force=force)


def _magnetometer(scene: Scene) -> "NeuralMagnetometer | None":
    """What runs the scene's magnetometer."""
    spec = scene.robot.magnetometer
    if spec.kind != "neural":
        return None
    if spec.network is None:
        raise InputError(
            f"scene {scene.name!r} has a neural magnetometer that names no network; name one "
            'with net, or take the kind "physical" or "map-only"'
        )
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer

    magnetometer = NeuralMagnetometer.load(spec.network, sha256=spec.network_sha256)
    if spec.inputs and spec.inputs != magnetometer.features:
        raise InputError(
            f"{spec.network}: takes {', '.join(magnetometer.features)}, but the scene's magnetometer names "
            f"{', '.join(spec.inputs)}; author the scene anew with this network"
        )
    return magnetometer


def engine_named(
    name: str, twin: Twin, *, progress: Callable[[int, int, str], Any] | None = None
) -> "Engine":
    """What moves a twin's robot: "kinematic" or "newton".

    Args:
        name: Which of them.
        twin: What it moves in.
        progress: Called where it takes long, as it goes on: with steps made, the most there can be, and the
            time on the robot's clock in words.

    Raises:
        InputError: No such engine, or it is not installed; the text says how to get it.
    """
    from magtwin.sim.engines.newton import Newton, check_installed
    from magtwin.sim.motion.engine import Kinematic

    find("engine", name, {"kinematic": None, "newton": None})
    if name == "kinematic":
        return Kinematic()
    check_installed()
    return Newton(twin.scene_file, twin.scene.robot, progress)


def room_of(twin: Twin) -> Room:
    """What a path of a twin's first robot must fit into."""
    return Room(twin.scene.lab.floor_m, twin.scene.robot.footprint_radius_m, twin.obstacles)


def simulate(
    twin: Twin | Scene | str | FilePath,
    path: "Path | Commands | Run | str | FilePath | ArrayLike" = "figure8",
    *,
    seed: int = 0,
    session: Session | None = None,
    speed: float = 0.2,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    net: str | FilePath | None = None,
    magnetometer: Kind | None = None,
    model_error: bool = True,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
    controller: "str | Controller" = "follower",
    engine: "Literal['kinematic', 'newton'] | Engine" = "kinematic",
    progress: Callable[[int, int, str], Any] | None = None,
) -> Run:
    """Drive the scene's robot along a path and read every sensor.

    Args:
        twin: What `open_twin` gave, a `Scene`, or the file of a stage.
        path: A path: its name, a CSV file of x, y [m], an array or list of points in world [m], shape
            (N, 2), or a `Path`; "random", for a human-like driver who goes
            where the seed takes them; Commands, to be played; or a Run, to be driven once more as it was
            recorded, with the sensors as the scene has them now.
        seed: Seed of all noise. The same seed gives the same bytes.
        session: Which session the robot is in, as for `in_session`: default, one drawn from the seed.
            "survey" is the robot as it was when the map was surveyed, which a network that was trained on
            later sessions does not know.
        speed: Forward speed where the path is straight [m/s].
        duration_s: How long to drive [s]; None is once along the path, longer gives further laps.
        rate_hz: Magnetometer readings a second [Hz]; None takes the scene's.
        net: As for `open_twin`, where `twin` is a file.
        magnetometer: As for `open_twin`, where `twin` is a file.
        model_error: Whether readings of a neural magnetometer have an error about what the network predicts;
            see `open_twin`.
        lidar: Whether the LiDAR follows its schedule, or stays on or off.
        outside: What the map reads outside its extent: nan, the nearest value inside, or a refusal.
        controller: What drives: "follower", "release", "stanley" or "pure_pursuit", or a
            `magtwin.sim.motion.controllers.Controller` of one's own.
        engine: What moves the robot: "kinematic"; "newton", physics in the stage itself (extra `physics`); or
            a `magtwin.sim.motion.engine.Engine` of one's own.
        progress: As for `engine_named`.

    Returns:
        A Run with every column of `magtwin.COLUMNS`; its metadata tell how it came about.

    Raises:
        InputError: The path leaves the floor or touches an obstacle, an option is out of range, the scene's
            field is constant, or the path leaves the map so that there is nothing to read.
    """
    from magtwin.sim.exact import check_field, check_read
    from magtwin.sim.runs.simulate import simulate as run_scene

    seed = _seed(seed)
    twin = in_session(_opened(twin, net, magnetometer, model_error, "simulate"), session, seed=seed)
    check_field(twin.scene, twin.field)
    network = twin.magnetometer
    path = way_of(path, room_of(twin))
    _check_commands(path, network)
    read: Read | None = None

    def disturbance_nt(run: Run) -> tuple[NDArray[Any], NDArray[Any]]:
        nonlocal read
        assert network is not None
        (read,) = network.read([run])
        return read.disturbance_nt, read.sd_nt

    run = run_scene(
        twin.scene,
        path,
        anomaly_map=twin.field,
        rng=np.random.default_rng(seed),
        speed=speed,
        duration_s=duration_s,
        rate_hz=rate_hz,
        disturbance_nt=disturbance_nt if network else None,
        model_error=model_error_of(twin, seed),
        outside=outside,
        lidar=lidar,
        obstacles=twin.obstacles,
        controller=controller,
        engine=engine_named(engine, twin, progress=progress) if isinstance(engine, str) else engine,
    )
    check_read(run, twin.field)
    return run.with_columns(**_known(twin.scene, run, read)).with_metadata(
        **_metadata(twin, seed, path, duration_s, _config_sha256(twin.scene))
    )


def model_error_of(twin: Twin, seed: int, *, which: int = 0) -> "ModelError | None":
    """Statistics of the model error of a twin in its session; None where none is to be drawn.

    Args:
        twin: What `in_session` gave.
        seed: Seed of the run.
        which: Place of the robot in a scene of several, from 0.
    """
    from magtwin.sim.session import offset_generator

    if twin.model_error is None:
        return None
    return twin.model_error.in_session(offset_generator(twin.session, seed, which=which))


def simulate_robots(
    twin: Twin | Scene | str | FilePath,
    paths: "Mapping[str, Path | Commands | Run | str | FilePath | ArrayLike] | None" = None,
    *,
    robots: Iterable[str] | None = None,
    meet: Literal["refuse", "flag"] = "refuse",
    seed: int = 0,
    session: Session | None = None,
    speed: float = 0.2,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    net: str | FilePath | None = None,
    magnetometer: Kind | None = None,
    model_error: bool = True,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
    controller: str = "follower",
) -> dict[str, Run]:
    """Drive every robot of a scene at one time, a Run each.

    They feel each other's iron, and must not run into each other; see `magtwin.sim.runs.together`. The first
    robot draws what `simulate` draws with the seed, each other one from a generator of its own, by its place
    in the scene.

    Args:
        twin: What `open_twin` gave, a `Scene`, or the file of a stage.
        paths: What robots drive, by name, as for `simulate`; who is not named drives what the scene says,
            or "figure8" where that says nothing.
        robots: Names of those whose sensors are read; all unless given. All drive nevertheless.
        meet: What becomes of robots whose footprints overlap: a refusal with time and place, or flag_bump in
            both while it lasts; they drive through each other.
        seed: As for `simulate`.
        session: As for `simulate`; each robot is drawn by itself.
        speed: As for `simulate`, of each.
        duration_s: As for `simulate`, of each.
        rate_hz: As for `simulate`.
        net: As for `open_twin`, where `twin` is a file; of each robot.
        magnetometer: As for `open_twin`, where `twin` is a file; of each robot.
        model_error: As for `simulate`.
        lidar: As for `simulate`.
        outside: As for `simulate`.
        controller: A name of `magtwin.sim.motion.controllers.CONTROLLERS`.

    Returns:
        Runs by the robots' names, in the scene's order. Beside what `simulate` says, metadata name the robot,
        and the one that came nearest with time and clearance.

    Raises:
        InputError: A name is none of a robot's, robots would meet, or `simulate` would refuse one.
    """
    from magtwin.sim.exact import check_field, check_read
    from magtwin.sim.runs.together import simulate_together

    seed = _seed(seed)
    twin = in_session(_opened(twin, net, magnetometer, model_error, "simulate_robots"), session, seed=seed)
    check_field(twin.scene, twin.field)
    placed = {one.robot.name: one for one in twin.scene.robots}
    for name in (*(paths or {}), *(robots or ())):
        find("robot", name, placed)
    led = {name: led_by(twin, name) for name in placed}
    ways: dict[str, Path | Commands | Run | str] = {}
    for name, one in placed.items():
        ways[name] = way_of((paths or {}).get(name, one.path or "figure8"), room_of(led[name]))
    wanted = [name for name in placed if robots is None or name in set(robots)]
    for name, way in ways.items():
        _check_commands(way, led[name].magnetometer)
    reads: dict[str, Read] = {}

    def disturbance_of(name: str, network: "NeuralMagnetometer") -> "Predict":
        def disturbance_nt(run: Run) -> tuple[NDArray[Any], NDArray[Any]]:
            (reads[name],) = network.read([run])
            return reads[name].disturbance_nt, reads[name].sd_nt

        return disturbance_nt

    disturbances = {
        name: disturbance_of(name, one.magnetometer) if one.magnetometer else None
        for name, one in led.items()
    }
    runs = simulate_together(
        twin.scene,
        ways,
        anomaly_map=twin.field,
        rngs={name: np.random.default_rng((seed, 2, k) if k else seed) for k, name in enumerate(placed)},
        wanted=wanted,
        meet=meet,
        speed=speed,
        duration_s=duration_s,
        rate_hz=rate_hz,
        obstacles=twin.obstacles,
        controller=controller,
        disturbances_nt=disturbances,
        model_errors={name: model_error_of(led[name], seed, which=k) for k, name in enumerate(placed)},
        outside=outside,
        lidar=lidar,
    )
    for name, run in runs.items():
        check_read(run, twin.field)
        own = led[name]
        runs[name] = run.with_columns(**_known(own.scene, run, reads.get(name))).with_metadata(
            **_metadata(own, seed, ways[name], duration_s, _config_sha256(own.scene))
        )
    return runs


def led_by(twin: Twin, name: str) -> Twin:
    """A twin with the robot of that name as the first of its scene, and what runs its magnetometer.

    Raises:
        InputError: No robot is called so, or its weights cannot be used.
    """
    scene = twin.scene.led_by(name)
    ours, its = twin.scene.robot.magnetometer, scene.robot.magnetometer
    if (its.kind, its.network, its.network_sha256) == (ours.kind, ours.network, ours.network_sha256):
        network = twin.magnetometer
    else:
        network = _magnetometer(scene)
    if name == twin.scene.robot.name:
        return twin
    own = {"model_error", "network_mismatch", *(twin.magnetometer.metadata if twin.magnetometer else ())}
    metadata: Metadata = {key: fact for key, fact in twin.metadata.items() if key not in own}
    metadata["platform_sha256"] = _platform_of(twin, scene.robot)
    led = dataclasses.replace(twin, scene=scene, magnetometer=network, metadata=metadata, model_error=None)
    return _with_network(led)


def simulate_many(
    twin: Twin | Scene | str | FilePath,
    paths: "Path | Commands | Run | str | FilePath | ArrayLike | Iterable[Any]",
    seeds: Iterable[int],
    *,
    session: Session | None = None,
    speeds: float | Iterable[float] = 0.2,
    robots: RobotSpec | Twin | Iterable[RobotSpec | Twin] | None = None,
    columns: Iterable[str] | None = None,
    block: int | None = None,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    net: str | FilePath | None = None,
    magnetometer: Kind | None = None,
    model_error: bool = True,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
    controller: str = "follower",
) -> "Runs":
    """Many robots, each in the scene by itself; `simulate_many(twin, paths, seeds)[i]` is
    `simulate(twin, paths[i], seed=seeds[i])`, to the last bit, whatever the number, the order and the block.

    All are driven at once by the compiled loop, but for those that somebody drives ("random"), and their
    readings go through the network in one stream of blocks. Checked at once, made when asked for: iterate
    over the result to have bounded memory, `list` it to keep all.

    Args:
        twin: What `open_twin` gave, a `Scene`, or the file of a stage.
        paths: What is driven in each run, as for `simulate`, or one for all.
        seeds: A seed for each run; their number is that of the runs.
        session: As for `simulate`, each run's drawn from its own seed.
        speeds: Forward speed of each where its path is straight [m/s], or one for all.
        robots: What drives in each, as it is, such as `magtwin.sim.session.draw_session` gives, or one for
            all; or the twin in a session, as `in_session` gives it. Default: the scene's robot, in its
            session.
        columns: Columns to keep, beside t; None keeps all.
        block: Runs made at a time; None takes what fits into 0.1 GB for runs of a minute.
        duration_s: As for `simulate`, of each run.
        rate_hz: As for `simulate`.
        net: As for `simulate`.
        magnetometer: As for `simulate`.
        model_error: As for `simulate`.
        lidar: As for `simulate`.
        outside: As for `simulate`.
        controller: A name of `magtwin.sim.motion.controllers.CONTROLLERS`.

    Returns:
        A sequence of runs, made when they are asked for.

    Raises:
        InputError: There is no seed, numbers of paths, speeds, robots and seeds differ, a seed is no whole
            number from 0 up, a robot's magnetometer is not the twin's, or `simulate` would refuse a run.
    """
    from magtwin.sim.exact import check_field, check_read
    from magtwin.sim.runs.many import BLOCK, Conditions, Job, Runs

    twin = _opened(twin, net, magnetometer, model_error, "simulate_many")
    check_field(twin.scene, twin.field)
    numbers = [_seed(seed) for seed in seeds]
    if not isinstance(controller, str):
        raise InputError(
            f"controller of many runs must be a name, got {type(controller).__name__}; one of your own "
            "remembers a single run: give it to simulate"
        )
    count = len(numbers)
    given = _each("paths", ways_of(paths, room_of(twin)), count)
    if robots is not None and session is not None:
        raise InputError("robots are taken as they are; give robots or session, not both")
    jobs, of = [], {}
    drawn: dict[object, Scene] = {}
    for seed, path, speed, robot in zip(
        numbers,
        given,
        _each("speeds", speeds, count),
        _each("robots", robots, count),
        strict=True,
    ):
        key: object = seed if robot is None else ("robot", id(robot))
        if key not in drawn:
            if robot is None:
                own = in_session(twin, session, seed=seed)
            elif isinstance(robot, Twin):
                _check_magnetometer(twin, robot.scene.robot)
                own = robot if model_error else without_model_error(robot)
            else:
                _check_magnetometer(twin, robot)
                own = dataclasses.replace(twin, scene=dataclasses.replace(twin.scene, robot=robot))
            drawn[key] = own.scene
            of[id(own.scene)] = own, _config_sha256(own.scene)
        _check_commands(path, twin.magnetometer)
        jobs.append(Job(drawn[key], path, seed, speed))
    network = twin.magnetometer

    def finish(jobs: Sequence[Job], sensed: Sequence["Sensed"]) -> list[Run]:
        rows = [one.run for one in sensed]
        flagged = "flag_out_of_distribution" in sensed[0].wanted
        told = network.read(rows, outside=flagged) if network else [None] * len(rows)
        runs = []
        for job, one, read in zip(jobs, sensed, told, strict=True):
            own, config = of[id(job.scene)]
            predicted = (read.disturbance_nt, read.sd_nt) if read else None
            run = one.read(predicted, model_error_of(own, job.seed))
            check_read(run, twin.field)
            known = _known(job.scene, run, read)
            run = run.with_columns(**{name: known[name] for name in known.keys() & run.keys()})
            runs.append(run.with_metadata(**_metadata(own, job.seed, job.path, duration_s, config)))
        return runs

    conditions = Conditions(
        anomaly_map=twin.field,
        obstacles=twin.obstacles,
        network=network is not None,
        inputs=frozenset(network.columns if network else ()),
        duration_s=duration_s,
        rate_hz=rate_hz,
        controller=controller,
        lidar=lidar,
        outside=outside,
    )
    return Runs(jobs, conditions, finish, columns=columns, block=BLOCK if block is None else block)


def _opened(
    twin: Twin | Scene | str | FilePath,
    net: str | FilePath | None,
    magnetometer: Kind | None,
    model_error: bool,
    what: str,
) -> Twin:
    """A twin, opened if it is not."""
    if not isinstance(twin, Twin):
        return open_twin(twin, net=net, magnetometer=magnetometer, model_error=model_error)
    if net is not None or magnetometer is not None:
        raise InputError(f"net and magnetometer go to open_twin where a Twin is given to {what}")
    return twin if model_error else without_model_error(twin)


def without_model_error(twin: Twin) -> Twin:
    """The twin, with readings of a neural magnetometer that are what its network predicts."""
    metadata = twin.metadata if twin.magnetometer is None else {**twin.metadata, "model_error": False}
    return dataclasses.replace(twin, errors=False, model_error=None, metadata=metadata)


def _seed(seed: object) -> int:
    """A seed, if it is one; NumPy's whole numbers are."""
    if isinstance(seed, int | np.integer) and not isinstance(seed, bool) and seed >= 0:
        return int(seed)
    raise InputError(f"seed must be a whole number from 0 up, got {seed!r}")


def _each(name: str, values: Any, count: int) -> Sequence[Any]:
    """A value for each run, from as many, or from one for all."""
    if isinstance(values, str | Run) or not isinstance(values, Iterable):
        return [values] * count
    values = list(values)
    if len(values) != count:
        raise InputError(f"{name} and seeds must be equally many, got {len(values)} and {count}")
    return values


def _check_commands(way: "Path | Commands | Run | str", network: "NeuralMagnetometer | None") -> None:
    """Refuse to drive a run once more that does not tell its commands, for a network that reads them."""
    if network is None or not isinstance(way, Run):
        return
    for column in ("v_cmd", "w_cmd"):
        if column in network.columns and column not in way:
            raise InputError(
                f"the run to drive once more has no {column!r}, and the network {network.name} reads what is "
                "commanded beyond what is driven; take one that does not, such as the paper's, or none"
            )


def _check_magnetometer(twin: Twin, robot: RobotSpec) -> None:
    """Refuse a robot whose magnetometer the twin's network does not run."""
    ours, its = twin.scene.robot.magnetometer, robot.magnetometer
    if (its.kind, its.network) != (ours.kind, ours.network):
        raise InputError(
            f"robot {robot.name!r} has a magnetometer of the kind {its.kind!r} with the network "
            f"{its.network}, the twin's is {ours.kind!r} with {ours.network}; open a twin for each"
        )


def _known(scene: Scene, run: Run, read: "Read | None") -> dict[str, NDArray[Any]]:
    """Columns that only who knows the network can fill; none without one."""
    if read is None:
        return {}
    spec = scene.robot.magnetometer
    noise = spec.noise_density_nt * np.sqrt(float(run.metadata["rate_hz"]) / 2)
    known: dict[str, NDArray[Any]] = {"b_sd_nt": np.hypot(read.sd_nt, noise)}
    return known if read.outside is None else known | {"flag_out_of_distribution": read.outside}


def _metadata(
    twin: Twin, seed: int, path: "Path | Commands | Run | str", duration_s: float | None, config_sha256: str
) -> Metadata:
    """What a twin adds to the metadata of a run, beside what its motion and sensors say of themselves."""
    metadata: Metadata = {"magtwin": __version__, "numpy": np.__version__, "seed": seed}
    if duration_s is not None:
        metadata["asked_duration_s"] = float(duration_s)
    return (
        metadata
        | dict(twin.session)
        | path_metadata(path)
        | dict(twin.metadata)
        | {"config_sha256": config_sha256}
    )


def path_metadata(path: "Path | Commands | Run | str") -> Metadata:
    """Where what was driven came from, and its checksum."""
    if isinstance(path, str):
        return {}
    if isinstance(path, Run):
        arrays: Iterable[NDArray[Any]] = (array for _, array in sorted(path.items()))
        what, file = "replay", ""
    elif isinstance(path, Path):
        arrays, what, file = (path.p_xy, np.array([path.closed])), "path", path.file
    else:
        arrays, what, file = (path.rows,), "commands", path.file
    metadata: Metadata = {f"{what}_file": file} if file else {}
    if isinstance(path, Path) and path.placing:
        metadata["path_placing"] = " ".join(map(repr, path.placing))
    checksum = hashlib.sha256()
    for array in arrays:
        checksum.update(np.ascontiguousarray(array).tobytes())
    return {**metadata, f"{what}_sha256": checksum.hexdigest()}


def _config_sha256(scene: Scene) -> str:
    """Checksum of every figure of a scene as it was run; files count with checksums of their own."""

    def bare(robot: RobotSpec) -> RobotSpec:
        sensor = dataclasses.replace(robot.magnetometer, network=None, network_sha256="", inputs=())
        return dataclasses.replace(robot, asset=FilePath(), magnetometer=sensor)

    others = tuple(  # what they read is nothing to this run
        dataclasses.replace(
            other, robot=bare(dataclasses.replace(other.robot, magnetometer=MagnetometerSpec())), path=""
        )
        for other in scene.others
    )
    scene = dataclasses.replace(
        scene, map_layer=FilePath(), map_sha256="", robot=bare(scene.robot), path="", others=others
    )
    return hashlib.sha256(spelled(scene).encode()).hexdigest()


def scan(twin: Twin | Scene | str | FilePath, run: Run, *, seed: int = 0) -> "Scans":
    """What the LiDAR of a scene's robot saw in a run, one scan a turn while it spun.

    Args:
        twin: What `open_twin` gave; or a `Scene` or the file of a stage, opened in the run's session.
        run: What `simulate` gave, or any run with t, p_world_base, yaw and lidar_on.
        seed: Seed of its noise; that of the run, unless another draw is wanted.
    """
    from magtwin.sim.runs.simulate import streams
    from magtwin.sim.sensors.lidar import scans_of

    if not isinstance(twin, Twin):
        twin = in_session_of(open_twin(twin, magnetometer="map-only"), run.metadata)
    rng = streams(np.random.default_rng(seed))["lidar"]
    return scans_of(run, twin.scene.robot, twin.obstacles, rng)
