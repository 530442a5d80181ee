"""Room survey: the map of a furnished room, where a robot cannot stand at every node."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from magtwin.field.maps.holes import filled
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.magnets import body_of
from magtwin.sim.survey import sensor_height_m, survey
from magtwin.spec.lab import SurveySpec
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.scene import Scene

FLOOR_M = 0.01
"""What does not rise above this is driven over [m]."""


@dataclass(frozen=True, eq=False)
class Surveyed:
    """The map of a room, and how it came about."""

    field: AnomalyMap
    """The map, with a value at every node."""

    filled: int
    """Nodes that were filled from those around them, over all headings: the robot cannot stand there, or
    its magnetometer loses lock."""

    magnets: int
    """How many things are magnetised."""

    def __str__(self) -> str:
        field = self.field
        headings, rows, columns = field.values_nt.shape
        low, high = field.values_nt.min() / 1000, field.values_nt.max() / 1000
        holes = f"; {self.filled} nodes in or beside steel are filled from their neighbours" * (
            self.filled > 0
        )
        return (
            f"surveyed by its own robot: {columns} x {rows} nodes {field.cell_m[0]:g} m apart, {headings} "
            f"headings, {field.height_m:.3g} m above the floor, {low:.2f} to {high:.2f} uT{holes}"
            + "; nothing is magnetised, so the field is the same everywhere"
            * (not self.magnets)
        )


def survey_room(
    scene: Scene,
    spec: SurveySpec,
    *,
    seed: int,
    obstacles: Obstacles,
    source: str = "",
    progress: Callable[[int, int, str], Any] = lambda done, total, what: None,
) -> Surveyed:
    """Survey a scene as its robot would, and fill the nodes that it cannot reach.

    Args:
        scene: A scene whose Earth's field is known; its map is not read.
        spec: How it is surveyed.
        seed: Seed of the sensor's noise and of the robot's errors.
        obstacles: What stands in the room.
        source: What the scene was made from.
        progress: As for `magtwin.sim.survey.survey`.

    Returns:
        The map, and how many of its nodes were filled.

    Raises:
        InputError: As for `survey`, or nothing could be measured in a heading.
    """
    field = survey(
        scene,
        rng=np.random.default_rng([seed, 1]),
        spacing_m=spec.spacing_m,
        headings_rad=np.radians(spec.headings_deg).tolist(),
        readings=spec.readings,
        height_m=spec.height_m,
        heading_error_rad=float(np.radians(spec.heading_error_deg)),
        position_error_m=spec.position_error_m,
        source=source,
        created=scene.earth.date if scene.earth is not None else "",
        progress=progress,
        blocked=blocked_by(scene, obstacles),
    )
    whole = filled(field)
    holes = int(np.count_nonzero(~field.valid))
    # in the numbers that its layer holds
    values, variance = (
        None if array is None else array.astype(np.float32).astype(float)
        for array in (whole.values_nt, whole.variance_nt2)
    )
    assert values is not None
    parameters = {**field.parameters, "seed": seed, "filled_nodes": holes}
    return Surveyed(
        replace(whole, values_nt=values, variance_nt2=variance, parameters=parameters),
        holes,
        len(scene.magnets),
    )


def blocked_by(scene: Scene, obstacles: Obstacles) -> Callable[[np.ndarray], np.ndarray]:
    """Which nodes a scene's robot cannot stand at, for what stands on the floor or is magnetised there.

    The walls at the border of the floor are not among that: the values there are needed up to them.

    Args:
        scene: The scene.
        obstacles: What stands in it.

    Returns:
        A function from nodes [m], shape (..., 2), to whether each is blocked, shape (...).
    """
    half = np.array(scene.lab.floor_m) / 2
    inner = [
        k for k, o in enumerate(obstacles.outlines) if np.all(np.abs(_nearest_to_middle(o)) < half - 1e-6)
    ]
    standing = Obstacles(
        tuple(obstacles.names[k] for k in inner), tuple(obstacles.outlines[k] for k in inner)
    )
    radius = scene.robot.footprint_radius_m

    def blocked(nodes: np.ndarray) -> np.ndarray:
        p = nodes.reshape(-1, 2)
        distance, _ = standing.clearance(p, reach_m=radius)
        inside = in_steel(scene, p, sensor_height_m(scene))
        return np.asarray((distance < radius) | inside).reshape(nodes.shape[:-1])

    return blocked


def in_steel(scene: Scene, p: np.ndarray, height_m: float) -> np.ndarray:
    """At which points (N, 2) of the floor a robot would stand in something magnetised, shape (N,).

    Args:
        scene: The scene.
        p: Where its base stands [m].
        height_m: Height up to which the robot reaches [m]. What does not rise above the floor is no obstacle.
    """
    radius = scene.robot.footprint_radius_m
    inside = np.zeros(len(p), bool)
    for source in scene.magnets:
        if source.shape == "point":
            continue
        body = body_of(replace(source, susceptibility=0.0))
        middle = body.p_world + body.rotation @ body.middle
        half = np.abs(body.rotation) @ (body.size_m / 2)
        near = np.flatnonzero(np.all(np.abs(p - middle[:2]) < half[:2] + radius, axis=1))
        low, high = middle[2] - half[2], middle[2] + half[2]
        if high <= FLOOR_M or low >= height_m or not len(near):
            continue
        for z in np.linspace(max(low, FLOOR_M), min(high, height_m), 5):
            at = np.column_stack([p[near], np.full(len(near), z)])
            inside[near] |= body.clearance(at) < radius
    return inside


def _nearest_to_middle(outline: np.ndarray) -> np.ndarray:
    """The x and y of an outline's box that are nearest to the origin, shape (2,)."""
    return np.clip(0.0, outline.min(axis=0), outline.max(axis=0))
