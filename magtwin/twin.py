"""Twin: a scene opened for running, with the map and the network that its prims name."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Literal

import numpy as np

import magtwin
from magtwin.field.map import AnomalyMap
from magtwin.files import sha256
from magtwin.names import RefusedError
from magtwin.obstacles import Obstacles
from magtwin.path import Path, resolve_path
from magtwin.run import Run
from magtwin.spec import Scene

Kind = Literal["physical", "neural", "map-only"]

if TYPE_CHECKING:
    from magtwin.learn.magnetometer import NeuralMagnetometer
    from magtwin.sim.controllers import Controller
    from magtwin.sim.lidar import Scans


@dataclass(frozen=True)
class Twin:
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


def open_twin(
    scene_file: str | FilePath, *, net: str | FilePath | None = None, magnetometer: Kind | None = None
) -> Twin:
    """Open a stage, the map layer and the network that it names.

    Args:
        scene_file: Root layer of a scene.
        net: Weights to use in place of those that the magnetometer names (.safetensors or .pth), for a
            neural magnetometer; or "none" for a physical one.
        magnetometer: Kind of magnetometer to use in place of the scene's: "physical", "neural" or "map-only".

    Raises:
        RefusedError: The stage, its map or its weights are missing, broken, or not what the stage's
            checksums say.
    """
    from magtwin.usd.maps import load_map
    from magtwin.usd.obstacles import read_obstacles
    from magtwin.usd.scene import read_scene

    scene_file = FilePath(scene_file)
    scene = read_scene(scene_file, check_network=net is None and magnetometer in (None, "neural"))
    spec = scene.robot.magnetometer
    if net is not None:
        kind, weights = ("physical", None) if str(net) == "none" else ("neural", FilePath(net).resolve())
        spec = dataclasses.replace(spec, kind=kind, network=weights, network_sha256="", inputs=())  # type: ignore[arg-type]
    if magnetometer is not None:
        spec = dataclasses.replace(spec, kind=magnetometer)
    scene = dataclasses.replace(scene, robot=dataclasses.replace(scene.robot, magnetometer=spec))
    obstacles = read_obstacles(scene_file)
    return Twin(scene, scene_file, load_map(scene.map_layer), _magnetometer(scene), obstacles)


def scene_from_toml(
    path: str | FilePath,
    *,
    map_layer: str | FilePath | None = None,
    network: str | FilePath | None = None,
    workshop: str | FilePath | None = None,
) -> Scene:
    """The scene that a TOML describes, its network read and its inputs named.

    Args:
        path: The TOML; files that it names are taken from its folder.
        map_layer: Map to use in place of the one that it names, without the TOML's Earth and sources.
        network: Weights to use in place of those that it names (.safetensors or .pth).
        workshop: Folder to build the robot in, where the TOML names one by its URDF.

    Raises:
        RefusedError: A key is misspelt or missing, or a file is not there, or not what it should be.
    """
    from magtwin.usd.scene import scene_from_toml as scene_of

    def inputs_of(weights: FilePath) -> tuple[str, ...]:
        from magtwin.learn.model import load_net

        return load_net(weights).features

    return scene_of(path, map_layer=map_layer, network=network, workshop=workshop, inputs_of=inputs_of)


def _magnetometer(scene: Scene) -> "NeuralMagnetometer | None":
    """What runs the scene's magnetometer."""
    spec = scene.robot.magnetometer
    if spec.kind != "neural":
        return None
    if spec.network is None:
        raise RefusedError(
            f"scene {scene.name!r} has a neural magnetometer that names no network; name one "
            'with net, or take the kind "physical" or "map-only"'
        )
    from magtwin.learn.magnetometer import NeuralMagnetometer

    magnetometer = NeuralMagnetometer.load(spec.network, sha256=spec.network_sha256)
    if spec.inputs and spec.inputs != magnetometer.features:
        raise RefusedError(
            f"{spec.network}: takes {', '.join(magnetometer.features)}, but the scene's magnetometer names "
            f"{', '.join(spec.inputs)}; author the scene anew with this network"
        )
    return magnetometer


def simulate(
    twin: Twin | str | FilePath,
    path: Path | str = "figure8",
    *,
    seed: int = 0,
    speed: float = 0.2,
    duration_s: float | None = None,
    rate_hz: float | None = None,
    net: str | FilePath | None = None,
    magnetometer: Kind | None = None,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
    controller: "str | Controller" = "follower",
) -> Run:
    """Drive the scene's robot along a path and read every sensor.

    Args:
        twin: What `open_twin` gave, or the file of a scene.
        path: A path, the name of one, or a CSV file of x, y [m].
        seed: Seed of all noise; one seed, one Run.
        speed: Forward speed where the path is straight [m/s].
        duration_s: How long to drive [s]; None is once along the path, longer gives further laps.
        rate_hz: Magnetometer readings a second [Hz]; None takes the scene's.
        net: As for `open_twin`, where `twin` is a file.
        magnetometer: As for `open_twin`, where `twin` is a file.
        lidar: Whether the LiDAR follows its schedule, or stays on or off.
        outside: What the map reads outside its extent: nan, the nearest value inside, or a refusal.
        controller: What drives: "follower", "release", "stanley" or "pure_pursuit", or a
            `magtwin.sim.controllers.Controller` of one's own.

    Returns:
        A Run with every column of `magtwin.COLUMNS`; its facts tell how it came about.

    Raises:
        RefusedError: The path leaves the floor or touches an obstacle, or an option is out of range.
    """
    from magtwin.sim.simulate import simulate as run_scene

    if not isinstance(twin, Twin):
        twin = open_twin(twin, net=net, magnetometer=magnetometer)
    elif net is not None or magnetometer is not None:
        raise RefusedError("net and magnetometer go to open_twin where a Twin is given to simulate")
    if not isinstance(seed, int) or seed < 0:
        raise RefusedError(f"seed must be a whole number from 0 up, got {seed!r}")
    network = twin.magnetometer
    run = run_scene(
        twin.scene,
        path if isinstance(path, Path) else resolve_path(path),
        anomaly_map=twin.field,
        rng=np.random.default_rng(seed),
        speed=speed,
        duration_s=duration_s,
        rate_hz=rate_hz,
        disturbance_nt=network.disturbance_nt if network else None,
        outside=outside,
        lidar=lidar,
        obstacles=twin.obstacles,
        controller=controller,
    )
    facts: dict[str, str | int | float | bool] = {
        "seed": seed,
        "map": twin.field.name,
        "map_sha256": sha256(twin.scene.map_layer),
    }
    if network:
        rate = twin.scene.robot.magnetometer.rate_hz if rate_hz is None else rate_hz
        noise = twin.scene.robot.magnetometer.noise_density_nt * np.sqrt(rate / 2)
        run = run.with_columns(
            b_sd_nt=np.full(run.rows, np.hypot(network.residual_sd_nt, noise)),
            flag_out_of_distribution=network.outside_training(run),
        )
        facts |= network.facts
    return run.with_facts(magtwin=magtwin.__version__, numpy=np.__version__, **facts)


def scan(twin: Twin, run: Run, *, seed: int = 0) -> "Scans":
    """What the LiDAR of a scene's robot saw in a run, one scan a turn while it spun.

    Args:
        twin: What `open_twin` gave.
        run: What `simulate` gave, or any run with t, p_world_base, yaw and lidar_on.
        seed: Seed of its noise; that of the run, unless another draw is wanted.
    """
    from magtwin.sim.lidar import scans_of
    from magtwin.sim.simulate import streams

    rng = streams(np.random.default_rng(seed))["lidar"]
    return scans_of(run, twin.scene.robot, twin.obstacles, rng)
