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
from magtwin.path import Path, resolve_path
from magtwin.run import Run
from magtwin.spec import Scene

if TYPE_CHECKING:
    from magtwin.learn.magnetometer import NeuralMagnetometer


@dataclass(frozen=True)
class Twin:
    """A scene, and what runs it."""

    scene: Scene
    scene_file: FilePath
    """The stage that `scene` was read from."""

    field: AnomalyMap
    """The map that the magnetometer reads."""

    magnetometer: "NeuralMagnetometer | None"
    """What predicts the disturbance; none where physics gives it."""


def open_twin(scene_file: str | FilePath, *, net: str | FilePath | None = None) -> Twin:
    """Open a stage, the map layer and the network that it names.

    Args:
        scene_file: Root layer of a scene.
        net: Weights to use in place of those that the magnetometer names (.safetensors or .pth), or
            "none" for the disturbance by physics.

    Raises:
        RefusedError: The stage, its map or its weights are missing, broken, or not what the stage's
            checksums say.
    """
    from magtwin.usd.maps import load_map
    from magtwin.usd.scene import read_scene

    scene_file = FilePath(scene_file)
    scene = read_scene(scene_file, check_network=net is None)
    if net is not None:
        robot = scene.robot
        magnetometer = dataclasses.replace(
            robot.magnetometer,
            network=None if str(net) == "none" else FilePath(net).resolve(),
            network_sha256="",
            inputs=(),
        )
        scene = dataclasses.replace(scene, robot=dataclasses.replace(robot, magnetometer=magnetometer))
    return Twin(scene, scene_file, load_map(scene.map_layer), _magnetometer(scene))


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
    if spec.network is None:
        return None
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
    lidar: Literal["schedule", "on", "off"] = "schedule",
    outside: Literal["nan", "clamp", "raise"] = "nan",
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
        lidar: Whether the LiDAR follows its schedule, or stays on or off.
        outside: What the map reads outside its extent: nan, the nearest value inside, or a refusal.

    Returns:
        A Run with every column of `magtwin.COLUMNS`; its facts tell how it came about.

    Raises:
        RefusedError: The path leaves the floor, or an option is out of range.
    """
    from magtwin.sim.simulate import simulate as run_scene

    if not isinstance(twin, Twin):
        twin = open_twin(twin, net=net)
    elif net is not None:
        raise RefusedError("net goes to open_twin where a Twin is given to simulate")
    if not isinstance(seed, int) or seed < 0:
        raise RefusedError(f"seed must be a whole number from 0 up, got {seed!r}")
    magnetometer = twin.magnetometer
    run = run_scene(
        twin.scene,
        path if isinstance(path, Path) else resolve_path(path),
        anomaly_map=twin.field,
        rng=np.random.default_rng(seed),
        speed=speed,
        duration_s=duration_s,
        rate_hz=rate_hz,
        disturbance_nt=magnetometer.disturbance_nt if magnetometer else None,
        outside=outside,
        lidar=lidar,
    )
    facts: dict[str, str | int | float | bool] = {
        "seed": seed,
        "map": twin.field.name,
        "map_sha256": sha256(twin.scene.map_layer),
    }
    if magnetometer:
        noise = twin.scene.robot.magnetometer.noise_std_nt
        run = run.with_columns(
            b_sd_nt=np.full(run.rows, np.hypot(magnetometer.residual_sd_nt, noise)),
            flag_out_of_distribution=magnetometer.outside_training(run),
        )
        facts |= magnetometer.facts
    else:
        facts["network"] = "none (physics)"
    return run.with_facts(magtwin=magtwin.__version__, numpy=np.__version__, **facts)
