"""Surveys of scenes: the readings that the robot of a scene would take, and the map that it would make."""

import importlib
import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import radians
from typing import Any

import numpy as np

from magtwin.errors import InputError, MismatchWarning
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.survey.saved import save_readings
from magtwin.files.file import sha256
from magtwin.files.outputs import check_free, output, transaction
from magtwin.files.settings import from_values
from magtwin.report.report import Report
from magtwin.sim.survey import blocked_by, survey_readings, survey_room
from magtwin.sim.survey import survey as survey_nodes
from magtwin.spec.lab import SurveySpec
from magtwin.spec.scene import Scene
from magtwin.twin.opening import open_twin
from magtwin.twin.twin import Place, Twin, scene_in
from magtwin.usd.layers import check_not_part, layer_files
from magtwin.usd.maps.layer import save_map
from magtwin.usd.scene import open_scene, use_map

Source = str | os.PathLike[str]
Progress = Callable[..., None]


def survey(scene: Twin | Place, *, seed: int = 0, **survey: Any) -> AnomalyMap:
    """Survey a scene: the map that its own robot would make, standing at each node of a grid in each heading.

    Nodes that the robot cannot reach are filled from their neighbours.

    Args:
        scene: An opened twin, or a scene as for `open_twin`, with a known Earth field.
        seed: Seed of the sensor's noise, and of the errors of the robot's poses.
        **survey: Fields of `SurveySpec`: spacing_m, headings_deg, readings, height_m, heading_error_deg,
            position_error_m.

    Returns:
        The map. `scene.with_(map_layer=map)` is the scene that reads it, `map.save("map.usdc")` its layer.

    Raises:
        InputError: The scene has no Earth field, or a number is out of range.
    """
    spec = from_values(SurveySpec, survey, "survey")
    scene = scene if isinstance(scene, Twin) else scene_in(scene)
    if isinstance(scene, Scene):
        obstacles = importlib.import_module("magtwin.author.room").obstacles_in(scene.lab, scene.furniture)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MismatchWarning)  # the old map is not read
            twin = scene if isinstance(scene, Twin) else open_twin(scene, magnetometer="physical")
        scene, obstacles = twin.scene, twin.obstacles
    if scene.earth is None:
        raise InputError(
            f"scene {scene.name!r} has no Earth field, so its field is known nowhere but in its map"
        )
    return survey_room(scene, spec, seed=seed, obstacles=obstacles, source=scene.name).field


def survey_scene(
    scene_file: Source,
    out: Source,
    *,
    lab: str = "",
    adopt: bool = False,
    spacing_m: float = 0.25,
    headings_rad: Sequence[float],
    readings: int = 135,
    height_m: float | None = None,
    heading_error_deg: float = 2.0,
    position_error_m: float = 0.01,
    seed: int = 0,
    name: str | None = None,
    licence: str = "",
    created: str | None = None,
    jobs: int | None = None,
    progress: Progress | None = None,
    force: bool = False,
) -> Report:
    """Survey a scene as its robot would: node by node, with sensor noise and pose errors.

    Args:
        scene_file: USD stage with a known Earth field.
        lab: As for `magtwin.open_twin`.
        adopt: Whether the stage reads this map from now on, in place of its old one.
        out: Map layer (.usdc) or readings (.parquet) to write.
        spacing_m: Spacing of the nodes [m].
        headings_rad: Headings at each node [rad], ascending.
        readings: Readings averaged at a node.
        height_m: Height of the sensor above the floor [m]. None: the robot's.
        heading_error_deg: Standard deviation of the robot's heading about the node's [deg].
        position_error_m: Standard deviation of the robot's x and y about the node [m].
        seed: Seed of noise and errors.
        name: Name of the map. None: that of `out`.
        licence: Licence of the map, an SPDX identifier.
        created: Date of the survey, YYYY-MM-DD. None: that of the Earth's field.
        jobs: Processes that share the headings; they do not change the output. None: this process, with
            several threads.
        progress: Called with the number of headings done and their total.
        force: Whether an existing output is replaced.

    Raises:
        InputError: The scene has no Earth field, a number is out of range, or the output cannot be written.
    """
    out = check_free(out, force=force)
    if seed < 0:
        raise InputError(f"`seed` must be a whole number from 0 up, got {seed}", parameter="seed")
    if not 0 <= heading_error_deg <= 90:
        raise InputError(f"heading_error_deg must be from 0 to 90 deg, got {heading_error_deg!r}")
    if adopt and out.suffix.lower() == ".parquet":
        raise InputError(f"{out}: a scene reads a map layer (.usdc), not readings", parameter="adopt")
    opened = open_scene(scene_file, lab=lab, check_network=False)
    if adopt:
        use_map(opened, out, dry=True)  # refuses before the survey
    else:
        check_not_part(opened.stage, out)
    twin = opened.scene
    day = twin.earth.date if twin.earth is not None else ""
    files = [file for file in layer_files(scene_file) if file.resolve() != twin.map_layer.resolve()]
    options: dict[str, Any] = {
        "rng": np.random.default_rng(seed),
        "spacing_m": spacing_m,
        "headings_rad": headings_rad,
        "readings": readings,
        "height_m": height_m,
        "heading_error_rad": radians(heading_error_deg),
        "position_error_m": position_error_m,
        "source": "; ".join(f"{file.name} sha256:{sha256(file)}" for file in files),
        "licence": licence,
        "created": day if created is None else created,
        "progress": progress or (lambda done, total, what: None),
        "blocked": blocked_by(twin, opened.obstacles),
        "jobs": jobs,
    }
    if out.suffix.lower() == ".parquet":
        surveyed = replace(survey_readings(twin, **options), name=name or out.stem)
        save_readings(surveyed, out, force=force)
        return surveyed.report()
    field = survey_nodes(twin, **options, name=name or out.stem)
    field = replace(field, parameters={**field.parameters, "seed": seed})
    with transaction(), output(out, force=force) as aside:
        save_map(field, aside)
        if adopt:
            use_map(opened, out, written=aside)
    return field.report()
