"""Opening: a stage, its map and its network become a Twin."""

import dataclasses
import hashlib
import importlib
import logging
import shutil
import tempfile
import warnings
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

from magtwin.errors import InputError, MismatchWarning
from magtwin.files.file import git_revision
from magtwin.files.kinds import scene_file
from magtwin.run.run import Run
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.twin.twin import (
    Kind,
    Metadata,
    Network,
    Place,
    Twin,
    scene_in,
    scene_sha256,
    without_tracking_error,
)

if TYPE_CHECKING:
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer
    from magtwin.usd.geometry import Link, Shape
    from magtwin.usd.scene import OpenedScene

LOG = logging.getLogger("magtwin")

SAME_PLACE_M = 1e-9
"""Places of a sensor that differ by less are the same [m]."""

SURVEY_FILE = "magtwin map survey {file} --out MAP.usdc --adopt"
SURVEY_SCENE = "scene.with_(map_layer=magtwin.survey(scene))"

UNWRITTEN = "unwritten"
"""`Twin.stage` of a scene of which no stage was written."""

_CHECKSUMS = {"map_sha256": "its map", "network_sha256": "its network", "scene_sha256": "the scene"}


def open_twin(
    scene: Place,
    *,
    lab: str = "",
    map_layer: str | FilePath | None = None,
    network: Network = None,
    magnetometer: Kind | None = None,
    model_error: bool = True,
    tracking_error: bool = True,
) -> Twin:
    """Open a scene with the map and the network that it names.

    The lab can stand anywhere on its stage, turned about the vertical; poses and fields are in its axes.

    A network that was trained on another map, another robot or another sensor position causes a
    `magtwin.MismatchWarning` with the expected error. Its text is stored in the metadata of runs as
    `network_mismatch`. So does a map that was made before the stage was changed, as `map_mismatch`.

    Args:
        scene: Root layer or folder of a scene; the name of one that ships ("lab"); a `pxr.Usd.Stage`, with
            its changes that are not saved; or a `Scene` or a `Room`, which is written to a temporary folder
            first. Colliders added to a stage by hand are not part of a `Scene`.
        lab: Path of the lab's root prim on a stage of several labs. Default: the only lab.
        map_layer: Map that replaces the scene's, such as one of the same room on another day. What shows the
            stage still shows the stage's own map.
        network: Weights (.safetensors or .pth) that replace those of the scene; a predictor, or what
            `magtwin.train` gives; or "none" for a physical magnetometer.
        magnetometer: Kind that replaces the scene's: "physical", "neural" or "map-only".
        model_error: Whether a random model error is added to the readings of a neural magnetometer, as large
            as the network's error on recordings outside its training set; see
            `magtwin.sim.sensors.model_error`.
        tracking_error: Whether controllers get poses with the latency and the errors of a localization, by
            the figures `localization_*` of the drive. If not, robots follow their paths to a few
            millimetres.

    Raises:
        InputError: The stage, its map or its weights are missing or broken, or a checksum does not match.
    """
    network = _weights_file(network)
    options: Any = {"network": network, "magnetometer": magnetometer, "model_error": model_error}
    options["tracking_error"] = tracking_error
    scene = scene_in(scene)
    if isinstance(scene, Scene):
        return _open_in_memory(scene, map_layer=map_layer, **options)  # has one lab
    from magtwin.usd.scene import open_scene, saved_as

    neural = network is None and magnetometer in (None, "neural")
    own: Any = {"lab": lab, "map_layer": map_layer, "check_network": neural}
    metadata: Metadata = {}
    if not isinstance(scene, str | FilePath):
        file = saved_as(scene)
        if file is None:  # as it is in this process
            return _twin_of(open_scene(scene, **own), metadata, map_layer=map_layer, **options)
        scene = file
    file = scene_file(scene)
    stage = open_scene(file, **own)
    metadata = {"scene_file": file.as_posix(), "scene_sha256": stage.sha256}
    if revision := git_revision(file.parent):
        metadata["git_revision"] = revision
    return _twin_of(stage, metadata, map_layer=map_layer, again=SURVEY_FILE.format(file=file), **options)


def open_unwritten(
    scene: Scene, known: dict[object, Any], *, network: Network = None, **options: Any
) -> Twin:
    """As `open_twin` of a scene in memory, without writing a stage: for many scenes.

    Args:
        scene: The scene.
        known: Maps and robots that other scenes have as well; it is filled.
        network: As for `open_twin`.
        **options: As for `open_twin`.
    """
    from magtwin.field.maps.scene_state import changes_since
    from magtwin.usd.layers import layer_sha256
    from magtwin.usd.maps.layer import load_map
    from magtwin.usd.robot import load_robot
    from magtwin.usd.scene import OpenedScene, check_map

    def once(key: object, make: Callable[[], Any]) -> Any:
        if key not in known:
            known[key] = make()
        return known[key]

    def placed(k: int, robot: RobotSpec) -> RobotSpec:
        asset = once(robot.asset, lambda: load_robot(robot.asset))
        for part in ("magnetometer", "lidar"):
            name = f"p_base_{part}"
            where = getattr(asset.with_part(part, getattr(robot, part)), name)
            if max(abs(a - b) for a, b in zip(where, getattr(robot, name), strict=True)) > SAME_PLACE_M:
                robot = dataclasses.replace(robot, **{name: where})
        return robot

    author = importlib.import_module("magtwin.author.room")  # by name: who opens a stage needs no author
    importlib.import_module("magtwin.author.scene").check_things(scene)
    scene = scene.with_robots(placed)
    checksum = once((scene.map_layer, "sha256"), lambda: layer_sha256(scene.map_layer))
    if scene.map_sha256 not in ("", checksum):
        check_map(scene)
    scene = dataclasses.replace(scene, map_sha256=checksum)
    field = once(scene.map_layer, lambda: load_map(scene.map_layer))
    made = field.made_from
    changes = () if made is None else tuple(changes_since(made, scene))
    stage = OpenedScene(FilePath(scene.name), None, scene, field, changes=changes)
    standing = (scene.lab, scene.furniture)
    stage.__dict__["obstacles"] = once(standing, lambda: author.obstacles_in(*standing))
    twin = _twin_of(stage, {}, map_layer=None, network=_weights_file(network), **options)
    return dataclasses.replace(twin, opened=None, stage=UNWRITTEN)


def _twin_of(
    stage: "OpenedScene",
    metadata: Metadata,
    *,
    map_layer: str | FilePath | None,
    network: str | FilePath | None,
    magnetometer: Kind | None = None,
    model_error: bool = True,
    tracking_error: bool = True,
    again: str = SURVEY_SCENE,
) -> Twin:
    """The twin of an opened scene; `again` is how to survey it again, and others as for `open_twin`."""
    from magtwin.usd.layers import layer_sha256

    read = stage.scene.with_robots(lambda k, robot: _with_magnetometer(robot, network, magnetometer))
    field, predictor = stage.map, _magnetometer(read)
    if stage.stage is not None and "scene_sha256" not in metadata:
        metadata["scene_sha256"] = stage.sha256
    checksum = read.map_sha256 if stage.stage is None else layer_sha256(read.map_layer)
    metadata |= {"map": field.name, "map_sha256": checksum}
    if stage.lab:
        metadata["lab"] = stage.lab
    if map_layer is not None:
        metadata["map_file"] = FilePath(map_layer).as_posix()
    if stage.pose is not None:
        metadata["lab_pose"] = " ".join(map(repr, (*stage.pose.p, stage.pose.yaw)))
    stale = [_stale(stage, again)] if stage.changes else []
    for text in stale:  # a run has the same bytes wherever its stage lies
        metadata["map_mismatch"] = text.replace(str(stage.file), stage.file.name)
    for text in (*stage.notes, *stale):
        warnings.warn(text, MismatchWarning, stacklevel=3)
    platforms = {placed.robot.name: _platform_sha256(placed.robot) for placed in read.robots}
    metadata["platform_sha256"] = platforms[read.robot.name]
    obstacles = stage.obstacles
    twin = Twin(read, stage.file, field, predictor, obstacles, metadata, platforms, model_error, opened=stage)
    twin = _with_network(twin if tracking_error else without_tracking_error(twin))
    LOG.info("opened %s: map %s, %d obstacles", read.name, field.name, len(obstacles))
    named = {"network_file": FilePath(network).as_posix()} if predictor and network is not None else {}
    return dataclasses.replace(twin, metadata={**twin.metadata, **named})


def _stale(stage: "OpenedScene", again: str) -> str:
    """What has changed since the map was made, by how much the map is off, and what to do."""
    from magtwin.sim.contradiction import contradiction_nt

    scene, effect = stage.scene, ""
    advice = f"survey again: {again}"
    if scene.earth is None:
        advice = "make a map with this robot in this room"
    else:
        with suppress(InputError):  # no node to compare
            effect = f"the map differs from the field of the stage by {contradiction_nt(scene, stage.map)}; "
    return (
        f"{stage.file}: has changed since its map {stage.map.name!r} was made: {'; '.join(stage.changes)}; "
        f"{effect}{advice}"
    )


def geometry(twin: Twin) -> "tuple[list[Shape], dict[str, Link]]":
    """Shapes of the lab and the first robot, and the links of that robot, for writers and viewers.

    They come from the stage that `open_twin` opened. A twin from another process opens it again.
    """
    from magtwin.usd.geometry import read_links, read_shapes
    from magtwin.usd.scene import open_alone

    name = twin.scene.robot.name
    if twin.stage == UNWRITTEN:
        with warnings.catch_warnings():  # what it would warn of was told when the twin was opened
            warnings.simplefilter("ignore", MismatchWarning)
            return geometry(open_twin(twin.scene, network="none"))
    if twin.opened is not None:
        alone = twin.opened.alone(name)
        return alone.shapes, alone.links
    stage = open_alone(twin.scene_file, name, lab=str(twin.metadata.get("lab", "")))
    return list(read_shapes(stage)), read_links(stage)


def _weights_file(network: Network) -> str | FilePath | None:
    """The file of a network; one that is in memory is written to a temporary folder."""
    predictor: Any = getattr(network, "predictor", network)
    if predictor is None or isinstance(predictor, str | FilePath):
        return predictor
    if not hasattr(predictor, "residual_sd_nt"):
        kind = type(network).__name__
        raise InputError(f"network must be a weights file or a predictor, got {kind}", parameter="network")
    name = str(getattr(predictor, "name", predictor.kind)).rpartition(":")[2].rpartition(".")[2]
    folder = FilePath(importlib.import_module("magtwin.twin.authoring").new_workshop())
    predictor.save(folder / f"{name}.safetensors")
    return folder / f"{name}.safetensors"


class _TemporaryStage:
    """A temporary folder that is deleted with the last twin that uses it."""

    def __init__(self) -> None:
        self.folder = FilePath(tempfile.mkdtemp(prefix="magtwin-"))
        weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    def __reduce__(self) -> tuple[type[FilePath], tuple[str]]:
        return FilePath, (str(self.folder),)  # a copy in another process must not delete it


def _open_in_memory(scene: Scene, *, map_layer: str | FilePath | None, **options: Any) -> Twin:
    """The twin of a scene without a file, authored to a temporary folder."""
    from magtwin.usd.scene import open_scene

    stage = _TemporaryStage()
    author = importlib.import_module("magtwin.author.scene")  # by name: who opens a stage needs no author
    file = author.author_scene(scene, stage.folder / "scene")
    neural = options["network"] is None and options["magnetometer"] in (None, "neural")
    opened = open_scene(file, map_layer=map_layer, check_network=neural)
    named = dataclasses.replace(opened, file=FilePath(file.name))  # nobody needs to know the temporary folder
    metadata: Metadata = {"scene_sha256": opened.sha256}
    twin = _twin_of(named, metadata, map_layer=map_layer, **options)
    return dataclasses.replace(twin, scene_file=file, opened=opened, stage=stage)


def _platform_sha256(robot: RobotSpec) -> str:
    """Checksum of a robot's platform field.

    Values equal to their default are left out, so that a field added by a later version changes nothing.
    """
    spec = robot.platform
    values = [(field.name, getattr(spec, field.name), field.default) for field in dataclasses.fields(spec)]
    text = repr(sorted((name, value) for name, value, default in values if value != default))
    return hashlib.sha256(text.encode()).hexdigest()


def _platform_of(twin: Twin, robot: RobotSpec) -> str:
    return twin.platforms.get(robot.name) or _platform_sha256(robot)


def _with_network(twin: Twin) -> Twin:
    """The twin with the metadata, warnings and error statistics of its network."""
    network = twin.magnetometer
    if network is None:
        return twin
    from magtwin.learn.data.origin import mismatches

    mismatched = mismatches(
        network.net.metadata,
        network.name,
        residual_sd_nt=network.residual_sd_nt,
        field=twin.field,
        map_sha256=str(twin.metadata["map_sha256"]),
        robot=twin.scene.robot,
        platform_sha256=_platform_of(twin, twin.scene.robot),
    )
    metadata = {**twin.metadata, **network.metadata}
    texts = [mismatch.text for mismatch in mismatched]
    if mismatched:
        metadata["network_mismatch"] = "; ".join(texts)
    statistics = network.model_error() if twin.errors else None
    if twin.errors and statistics is None:
        texts.append(
            f"{network.name} has no statistics of its error, so readings differ from its predictions by "
            "sensor noise only; train it again to include model error"
        )
    for text in texts:
        warnings.warn(text, MismatchWarning, stacklevel=3)
    metadata["model_error"] = statistics is not None
    return dataclasses.replace(twin, metadata=metadata, model_error=statistics)


def _with_magnetometer(robot: RobotSpec, network: str | FilePath | None, kind: Kind | None) -> RobotSpec:
    """A robot whose magnetometer has another network or kind; arguments as for `open_twin`."""
    spec = robot.magnetometer
    if network is not None:
        if FilePath(network).is_dir():
            raise InputError(f"{network}: a folder; name the weights file in it")
        file = None if str(network) == "none" else FilePath(network).resolve()
        named: Any = {"kind": "physical" if file is None else "neural", "network": file}
        spec = dataclasses.replace(spec, **named, network_sha256="", inputs=())
    if kind is not None:
        if kind != "neural" and network is not None and str(network) != "none":
            raise InputError(f"a {kind!r} magnetometer has no network; drop `magnetometer` or `network`")
        spec = dataclasses.replace(spec, kind=kind)
    return dataclasses.replace(robot, magnetometer=spec)


def _magnetometer(scene: Scene) -> "NeuralMagnetometer | None":
    """The predictor of the scene's magnetometer. None if it is not neural."""
    spec = scene.robot.magnetometer
    if spec.kind != "neural":
        return None
    if spec.network is None:
        raise InputError(
            f"scene {scene.name!r} has a neural magnetometer without a network; name one with `network`, or "
            'take the kind "physical" or "map-only"'
        )
    from magtwin.learn.inference.magnetometer import NeuralMagnetometer

    magnetometer = NeuralMagnetometer.load(spec.network, sha256=spec.network_sha256)
    if spec.inputs and spec.inputs != magnetometer.features:
        raise InputError(
            f"{spec.network}: takes {', '.join(magnetometer.features)}, but the scene's magnetometer names "
            f"{', '.join(spec.inputs)}; author the scene again with this network"
        )
    return magnetometer


def led_by(twin: Twin, name: str) -> Twin:
    """The twin with another robot of its scene as the first one, with that robot's network.

    Raises:
        InputError: The scene has no robot of that name, or its weights cannot be used.
    """
    scene = twin.scene.led_by(name)
    if name == twin.scene.robot.name:
        return twin
    ours, its = twin.scene.robot.magnetometer, scene.robot.magnetometer
    same = (its.kind, its.network, its.network_sha256) == (ours.kind, ours.network, ours.network_sha256)
    network = twin.magnetometer if same else _magnetometer(scene)
    own = {"model_error", "network_mismatch", *(twin.magnetometer.metadata if twin.magnetometer else ())}
    metadata: Metadata = {key: value for key, value in twin.metadata.items() if key not in own}
    metadata["platform_sha256"] = _platform_of(twin, scene.robot)
    return _with_network(
        dataclasses.replace(twin, scene=scene, magnetometer=network, metadata=metadata, model_error=None)
    )


def twin_of(
    run: Run, scene: str | FilePath | None = None, *, near: str | FilePath | None = None, check: bool = True
) -> Twin:
    """The twin that made a run: the scene in its metadata, with the run's network and magnetometer.

    Args:
        run: A run that `simulate` made, loaded from any format.
        scene: Where the scene is now. Default: where the metadata say.
        near: File of the run. Names in the metadata are also looked for in its folder.
        check: Whether the checksums of scene, map and network must match those of the run.

    Raises:
        InputError: The metadata name no scene, a file is missing, or a checksum does not match.
    """
    metadata, scene = run.metadata, scene_of(run, scene, near=near)
    kind: Any = metadata.get("magnetometer")
    network = str(metadata["network_file"]) if "network_file" in metadata else None
    twin = open_twin(
        scene,
        **lab_and_map(metadata, near),
        network=network if network is None else locate(network, near) or network,
        magnetometer=kind if network is None else None,
        model_error=bool(metadata.get("model_error", False)),
    )
    for name, what in _CHECKSUMS.items() if check else ():
        if metadata.get(name, "") != twin.metadata.get(name, ""):
            now, then = twin.metadata.get(name, "none"), metadata.get(name, "none")
            text = f"{what} changed since the run: {name} is {now}, the run has {then}"
            raise InputError(f"{scene}: {text}")
    return twin


def check_scene(scene: Scene, metadata: Mapping[str, str | int | float | bool], name: str) -> None:
    """Refuse a scene whose values differ from those that a run was made with."""
    ours, its = scene_sha256(scene), metadata.get("config_sha256", "none")
    if ours != its:
        raise InputError(
            f"{name}: was made in a scene whose values have the sha256 {its}; those of {scene.name!r} in its "
            f"session have {ours}; name the scene that it was made in"
        )


def scene_of(
    run: Run, scene: str | FilePath | None = None, *, near: str | FilePath | None = None
) -> FilePath:
    """File of the scene that a run was made in; arguments as for `twin_of`.

    Raises:
        InputError: The metadata name none, or it is missing.
    """
    if scene is not None:
        return scene_file(scene)
    if "scene_file" not in run.metadata:
        raise InputError("the run does not name its scene; name it with `scene`", parameter="scene")
    place = locate(str(run.metadata["scene_file"]), near)
    if place is None:
        name = run.metadata["scene_file"]
        raise InputError(f"{name}: the scene of the run is missing; name it with `scene`", parameter="scene")
    return place


def lab_and_map(metadata: Mapping[str, object], near: str | FilePath | None = None) -> dict[str, Any]:
    """The options `lab` and `map_layer` of `open_twin` with which a run was made; `near` as for `twin_of`."""
    options: dict[str, Any] = {"lab": str(metadata.get("lab", ""))}
    if "map_file" in metadata:
        file = str(metadata["map_file"])
        options["map_layer"] = locate(file, near) or file
    return options


def locate(file: str, near: str | FilePath | None = None) -> FilePath | None:
    """A file or folder named in metadata, relative to here or to the folder of `near`. None if missing.

    Devices and pipes count as missing: metadata may be hostile, and reading one might never end.
    """
    places = [FilePath(file)]
    if near is not None:  # a run may itself be a folder
        places += [FilePath(near) / file, FilePath(near).parent / file]
    return next((place for place in places if place.is_file() or place.is_dir()), None)
