"""Scans of a planar LiDAR among furniture: magtwin, and trimesh with Embree, in one process.

    python benchmarks/scan.py [repetitions]

A room with desks and posts (boxes and prisms) is scanned from many poses, 720 rays each. Embree casts all
rays of a pose in one call, in single precision; magtwin cuts the triangles by the plane of the rays once and
meets each cut by the rays that see it, in double precision. Medians over repetitions, taken in turn.
"""

import statistics
import sys
import time

import numpy as np
import trimesh

from magtwin.run.run import Run
from magtwin.sim.sensors.lidar import ray_angles, scans_of
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import RobotSpec
from magtwin.spec.sensors import LidarSpec

POSES = 450
"""One minute at 7.5 turns a second."""


def furniture(things: int, sides: int, rng: np.random.Generator) -> trimesh.Trimesh:
    """A walled floor of 6 x 3.5 m, with posts about it and among it."""
    walls = [
        trimesh.creation.box((6.1, 0.05, 0.3), trimesh.transformations.translation_matrix((0, y, 0.15)))
        for y in (-1.775, 1.775)
    ] + [
        trimesh.creation.box((0.05, 3.6, 0.3), trimesh.transformations.translation_matrix((x, 0, 0.15)))
        for x in (-3.025, 3.025)
    ]
    posts = [
        trimesh.creation.cylinder(
            0.05, 0.8, sections=sides,
            transform=trimesh.transformations.translation_matrix((*rng.uniform((-3, -1.7), (3, 1.7)), 0.4)),
        )
        for _ in range(things)
    ]  # fmt: skip
    return trimesh.util.concatenate(walls + posts)


def measure(things: int, sides: int, repetitions: int) -> None:
    mesh = furniture(things, sides, np.random.default_rng(0))
    spec = LidarSpec(range_noise_std_m=0.0, latency_s=0.0, jitter_s=0.0, range_min_m=0.0)
    robot = RobotSpec(name="robot", asset="robot.usda", lidar=spec, p_base_lidar=(0.0, 0.0, 0.19))
    obstacles = Obstacles(triangles=mesh.triangles)
    t = np.arange(POSES + 1) / spec.scan_rate_hz
    x, yaw = 2.0 * np.sin(t / 9), t / 5
    run = Run(
        {
            "t": t,
            "p_world_base": np.column_stack([x, 0 * t, 0 * t]),
            "yaw": (yaw + np.pi) % (2 * np.pi) - np.pi,
            "lidar_on": np.ones(len(t), bool),
        }
    )
    angle = ray_angles(spec.rays)
    caster = trimesh.ray.ray_pyembree.RayMeshIntersector(mesh)

    def ours() -> np.ndarray:
        return scans_of(run, robot, obstacles, np.random.default_rng(0)).ranges_m

    def embree() -> np.ndarray:
        ranges = np.full((POSES + 1, spec.rays), np.inf)
        for row in range(POSES + 1):
            origin = np.array([x[row], 0.0, 0.19])
            d = np.column_stack([np.cos(angle + yaw[row]), np.sin(angle + yaw[row]), 0 * angle])
            place, ray, _ = caster.intersects_location(
                np.tile(origin, (spec.rays, 1)), d, multiple_hits=False
            )
            ranges[row, ray] = np.linalg.norm(place - origin, axis=1)
        return ranges

    took: dict[str, list[float]] = {"magtwin": [], "trimesh with Embree": []}
    for turn in range(repetitions + 1):
        for name, work in zip(took, (ours, embree), strict=True):
            start = time.perf_counter()
            ranges = work()
            if turn:  # the first is warm-up
                took[name].append(time.perf_counter() - start)
            if name == "magtwin":
                own = ranges
    off = np.abs(own - ranges)
    agree = np.mean(off < 1e-4)
    a, b = (statistics.median(times) for times in took.values())
    print(
        f"{len(mesh.faces):7,} triangles  magtwin {a / (POSES + 1) * 1e3:6.2f} ms a scan   "
        f"trimesh with Embree {b / (POSES + 1) * 1e3:6.2f} ms   ratio {a / b:5.2f}   "
        f"{agree:.4%} of rays within 0.1 mm"
    )


if __name__ == "__main__":
    if not trimesh.ray.has_embree:
        raise SystemExit(print("Embree is not installed, so nothing to compare with: pip install embreex"))
    for things, sides in ((4, 8), (20, 32), (100, 128)):
        measure(things, sides, int(sys.argv[1]) if len(sys.argv) > 1 else 3)
