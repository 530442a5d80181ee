"""A scene without a stage, its Earth's field, sources and map, for tests of the simulator."""

from pathlib import Path

import numpy as np

from magtwin.field.maps.map import AnomalyMap
from magtwin.spec.magnetics import EarthFieldSpec, SourceSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene

EARTH = EarthFieldSpec(
    b_world_nt=(-2_600.0, 24_000.0, -38_000.0),
    latitude_deg=29.6,
    longitude_deg=-82.3,
    height_m=30.0,
    date="2026-01-01",
)
SOURCES = (
    SourceSpec(name="chair", p_world=(0.5, 0.3, -0.5), m_world=(5.0, -3.0, 20.0)),
    SourceSpec(name="desk", p_world=(-1.0, 0.8, -0.4), m_world=(-9.0, 4.0, -12.0)),
)


def scene_of(robot: RobotSpec, name: str = "hall", **parts) -> Scene:
    return Scene(name=name, map_layer=Path("map.usdc"), robot=robot, **parts)


def wavy_map(headings: int = 4, extent_m: tuple[float, float] = (6.0, 3.5)) -> AnomalyMap:
    """A map of 25 x 15 nodes and random values about the middle of the room."""
    values = 41_000 + 1_000 * np.random.default_rng(5).standard_normal((headings, 15, 25))
    return AnomalyMap(
        values_nt=values,
        origin_m=(-extent_m[0] / 2, -extent_m[1] / 2),
        cell_m=(extent_m[0] / 24, extent_m[1] / 14),
        headings_rad=2 * np.pi * np.arange(headings) / headings,
    )
