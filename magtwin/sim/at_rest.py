"""At rest: the field that a robot reads where it stands, and where it cannot stand."""

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.sources.magnets import body_of
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate
from magtwin.sim.interference import ambient_field_nt, platform_field_nt
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]

FLOOR_M = 0.01
"""Height up to which the robot drives over things [m]."""


def field_at_rest_nt(
    scene: Scene, p_world_base: ArrayLike, yaw: ArrayLike, *, height_m: float | None = None
) -> Array:
    """Exact field magnitude at the magnetometer of a robot that stands with its LiDAR off.

    |(1 + S) R(yaw)^T B(p_base + R(yaw) p_lever) + h|: the map's field without its grid. A run's exact field
    minus this is the part of motion, motors, LiDAR and battery.

    Args:
        scene: A scene whose Earth's field is known.
        p_world_base: Positions of base_link [m], shape (..., 3), or (..., 2) for a robot on the floor.
        yaw: Headings [rad], shape (...); the two shapes are broadcast.
        height_m: Height of the magnetometer above the floor [m]. Default: the robot's.

    Returns:
        Field magnitude [nT], shape (...).
    """
    p, yaw = np.asarray(p_world_base, float), np.asarray(yaw, float)
    shape = np.broadcast_shapes(p.shape[:-1], yaw.shape)
    turn = quat_from_yaw(np.broadcast_to(yaw, shape))
    p_world = places_at_rest(scene, p, yaw, height_m)
    b_body = rotate(quat_conjugate(turn), ambient_field_nt(scene, p_world)).reshape(-1, 3)
    field = platform_field_nt(scene.robot.platform, b_body)
    return np.asarray(np.linalg.norm(field, axis=-1)).reshape(shape)


def places_at_rest(scene: Scene, p: Array, yaw: Array, height_m: float | None) -> Array:
    """Places of the magnetometer in world [m] for base_link at points (..., 2 or 3), headings (...)."""
    if p.shape[-1] == 2:
        p = np.concatenate([p, np.full((*p.shape[:-1], 1), scene.robot.base_height_m)], axis=-1)
    shape = np.broadcast_shapes(p.shape[:-1], yaw.shape)
    turn = quat_from_yaw(np.broadcast_to(yaw, shape))
    p_world = p + rotate(turn, np.broadcast_to(scene.robot.p_base_magnetometer, (*shape, 3)))
    if height_m is not None:
        p_world[..., 2] = height_m
    return p_world


def sensor_height_m(scene: Scene) -> float:
    """Height of the magnetometer above the floor on which the robot stands [m]."""
    return scene.robot.base_height_m + scene.robot.p_base_magnetometer[2]


def in_steel(scene: Scene, p: Array, height_m: float) -> NDArray[np.bool_]:
    """Whether a robot at points (N, 2) of the floor would stand in something magnetised, shape (N,)."""
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
