"""Survey of the twin: the map that the robot itself would make of the lab."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.map import AnomalyMap
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate
from magtwin.names import RefusedError
from magtwin.sim.interference import ambient_field_nt, platform_field_nt
from magtwin.spec import Scene

Array = NDArray[np.float64]

QUARTERS = (0.0, np.pi / 2, np.pi, 3 * np.pi / 2)


def field_at_rest_nt(scene: Scene, p_world_base: ArrayLike, yaw: ArrayLike) -> Array:
    """Exact field magnitude at the magnetometer of a robot that stands with its LiDAR off.

    |(1 + S) R(yaw)^T B(p_base + R(yaw) p_lever) + h|: the map's field without its grid, so a run's
    exact field minus this is what moving, the motors, the LiDAR and the battery add.

    Args:
        scene: A scene whose Earth's field is known.
        p_world_base: Positions of base_link [m], shape (..., 3), or (..., 2) for a robot on the floor.
        yaw: Headings [rad], shape (...); the two shapes are broadcast.

    Returns:
        Field magnitude [nT], shape (...).
    """
    p, yaw = np.asarray(p_world_base, float), np.asarray(yaw, float)
    if p.shape[-1] == 2:
        p = np.concatenate([p, np.full((*p.shape[:-1], 1), scene.robot.base_height_m)], axis=-1)
    shape = np.broadcast_shapes(p.shape[:-1], yaw.shape)
    turn = quat_from_yaw(np.broadcast_to(yaw, shape))
    p_world = p + rotate(turn, np.broadcast_to(scene.robot.p_base_magnetometer, (*shape, 3)))
    b_body = rotate(quat_conjugate(turn), ambient_field_nt(scene, p_world)).reshape(-1, 3)
    still = np.zeros(len(b_body))
    field = platform_field_nt(
        scene.robot.platform,
        b_body,
        b_rate=np.zeros_like(b_body),
        wheel_rate=np.zeros((len(b_body), 2)),
        lidar_on=still,
        battery_a=still,
    )
    return np.asarray(np.linalg.norm(field, axis=-1)).reshape(shape)


def survey(
    scene: Scene,
    *,
    rng: np.random.Generator,
    spacing_m: float = 0.25,
    headings_rad: Sequence[float] = QUARTERS,
    readings: int = 1,
    name: str | None = None,
    source: str = "",
    licence: str = "",
    created: str = "",
) -> AnomalyMap:
    """Map the lab as the robot would: it stands at each node in each heading and reads the field.

    base_link is on the node, so the magnetometer is beside it by its lever arm, turned with the
    heading; the motors rest, the LiDAR is off and the battery is full.

    Args:
        scene: A scene whose Earth's field is known; its map is not read.
        rng: Where the sensor's noise is drawn from.
        spacing_m: Distance between nodes [m]; the grid is centred on the floor and stays on it.
        headings_rad: Headings, ascending in [0, 2 pi) [rad].
        readings: Readings whose mean is a node's value; each has the sensor's noise and resolution.
        name: Name of the map; that of the scene unless given.
        source: What the scene was made from.
        licence: SPDX name of the map's licence.
        created: Day of the survey, YYYY-MM-DD.

    Returns:
        The map, with the variance that the sensor's noise and resolution leave.

    Raises:
        RefusedError: The Earth's field is unknown, or the grid has no cell.
    """
    if not spacing_m > 0 or readings < 1:
        raise RefusedError(
            f"spacing_m must be above 0 m and readings at least 1, got {spacing_m!r} and {readings!r}"
        )
    columns, rows = (int(np.floor(length / spacing_m + 1e-9)) + 1 for length in scene.lab.floor_m)
    if min(columns, rows) < 2:
        raise RefusedError(f"spacing_m {spacing_m:g} leaves no cell on a floor of {scene.lab.floor_m} m")
    origin = (-(columns - 1) * spacing_m / 2, -(rows - 1) * spacing_m / 2)
    x, y = np.meshgrid(origin[0] + spacing_m * np.arange(columns), origin[1] + spacing_m * np.arange(rows))
    headings = np.asarray(headings_rad, float)
    exact = field_at_rest_nt(scene, np.stack([x, y], axis=-1)[None], headings[:, None, None])
    sensor = scene.robot.magnetometer
    total = np.zeros_like(exact)
    for _ in range(readings):
        total += _read(exact, sensor.noise_std_nt, sensor.resolution_nt, rng)
    variance = (sensor.noise_std_nt**2 + sensor.resolution_nt**2 / 12) / readings
    return AnomalyMap(
        values_nt=total / readings,
        origin_m=origin,
        cell_m=(spacing_m, spacing_m),
        headings_rad=headings,
        variance_nt2=np.full(exact.shape, variance),
        name=scene.name if name is None else name,
        method=f"survey of the twin, {readings} reading{'s' * (readings > 1)} a node and heading, at rest",
        source=source,
        licence=licence,
        created=created,
    )


def _read(exact: Array, noise_std_nt: float, resolution_nt: float, rng: np.random.Generator) -> Array:
    noisy = exact + noise_std_nt * rng.standard_normal(exact.shape)
    return np.rint(noisy / resolution_nt) * resolution_nt if resolution_nt else noisy
