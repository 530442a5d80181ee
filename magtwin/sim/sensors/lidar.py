"""LiDAR: when it spins, and what a planar one sees."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.frames import matrix_from_quat, quat_from_yaw, quat_multiply, rotate
from magtwin.run.run import Run
from magtwin.sim.motion.sampling import check_count
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import RobotSpec
from magtwin.spec.sensors import LidarSpec
from magtwin.summary import Summarized, Summary, span

Array = NDArray[np.float64]

_EDGE = 1e-9
"""Part of a ray's step by which a surface reaches past its ends, lest a ray slip between two."""

_UPRIGHT = 1e-12
"""Sine of the angle from the vertical below which a LiDAR's axis counts as upright."""


def lidar_on(
    spec: LidarSpec, t: ArrayLike, mode: Literal["schedule", "on", "off"] = "schedule"
) -> NDArray[np.bool_]:
    """Whether the LiDAR spins at times `t` [s], shape (...).

    Args:
        spec: The schedule: off for off_s, then on for on_s, and again; at t = 0 it is phase_s into it.
        t: Times since the start [s].
        mode: "schedule", or always "on" or "off".

    Raises:
        InputError: `mode` is none of these.
    """
    t = np.asarray(t, float)
    if mode == "schedule":
        cycle = spec.on_s + spec.off_s
        if spec.on_s == 0:
            return np.zeros(t.shape, bool)
        return (t + spec.phase_s) % cycle >= spec.off_s
    if mode not in ("on", "off"):
        raise InputError(f'lidar must be "schedule", "on" or "off", got {mode!r}')
    return np.full(t.shape, mode == "on")


def ray_angles(rays: int) -> Array:
    """Directions of a scan's rays in the LiDAR's own xy plane, from its x axis [rad], shape (rays,).

    They go anticlockwise from -pi, evenly all the way round.
    """
    return np.arange(rays, dtype=float) * (2 * np.pi / rays) - np.pi


def scan(
    obstacles: Obstacles,
    pose: tuple[ArrayLike, ArrayLike],
    spec: LidarSpec,
    rng: np.random.Generator | None = None,
) -> Array:
    """Ranges of one turn, all rays at one moment; the robot itself is not seen.

    Args:
        obstacles: What there is to see; its triangles count.
        pose: LiDAR's origin p_world_lidar [m], shape (3,), and its axes q_world_lidar_xyzw, shape (4,).
        spec: Rays, ranges and noise.
        rng: Source of noise, a number a ray; none for none.

    Returns:
        Ranges along `ray_angles` [m], shape (rays,), as REP 117 has them: inf where nothing is
        within `range_max_m`, -inf where something is nearer than `range_min_m`.
    """
    p, turn = np.asarray(pose[0], float), matrix_from_quat(pose[1])
    cuts = _cuts((obstacles.triangles - p) @ turn, 0.0)
    return _told(_cast(cuts, spec.rays), spec, rng)


@dataclass(frozen=True, eq=False, repr=False)
class Scans(Summarized):
    """The scans of a run, a row each."""

    t: Array
    """Moment of each scan [s], shape (S,)."""

    arrival: Array
    """When it arrived [s], shape (S,)."""

    p_world_lidar: Array
    """Where the LiDAR was at that moment [m], shape (S, 3)."""

    q_world_lidar_xyzw: Array
    """Its axes, shape (S, 4)."""

    ranges_m: NDArray[np.float32]
    """Ranges along `ray_angles` [m], shape (S, rays); see `scan`."""

    def points_world(self) -> list[Array]:
        """What each scan hit, in world [m], each of shape (H, 3)."""
        angle = ray_angles(self.ranges_m.shape[1])
        unit = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
        hits = [np.isfinite(row) for row in self.ranges_m]
        rows = zip(hits, self.ranges_m, self.p_world_lidar, self.q_world_lidar_xyzw, strict=True)
        return [p + (unit[hit] * row[hit, None]) @ matrix_from_quat(q).T for hit, row, p, q in rows]

    def _summary(self) -> Summary:
        scans, rays = self.ranges_m.shape
        hits = self.ranges_m[np.isfinite(self.ranges_m)]
        return Summary(
            f"Scans: {scans:,} of {rays:,} rays"
            + (f", {self.t[0]:.4g} to {self.t[-1]:.4g} s" if scans else ""),
            (("ranges", f"{span(hits.min(), hits.max(), 'm', form='.3g')}" if hits.size else "no hit"),),
        )


def scans_of(run: Run, robot: RobotSpec, obstacles: Obstacles, rng: np.random.Generator) -> Scans:
    """What the LiDAR saw in a run, one scan a turn while it spun.

    Args:
        run: With t, p_world_base, yaw and lidar_on: a simulated one, or one that was recorded.
        robot: Its LiDAR, and where it sits.
        obstacles: What there is to see.
        rng: Source of delays and noise.

    Raises:
        InputError: There are more scans than memory could hold.
    """
    spec, t = robot.lidar, run["t"]
    check_count("a LiDAR's scans", t[-1] - t[0], spec.scan_rate_hz)
    delays, noise = rng.spawn(2)
    stamps = t[0] + np.arange(int((t[-1] - t[0]) * spec.scan_rate_hz) + 1) / spec.scan_rate_hz
    spins = run["lidar_on"][np.searchsorted(t, stamps, side="right") - 1]
    late = spec.latency_s + spec.jitter_s * delays.exponential(1.0, len(stamps))
    stamps, arrival = stamps[spins], np.maximum.accumulate(stamps + late)[spins]
    base, yaw = run["p_world_base"], np.unwrap(run["yaw"])
    p = np.column_stack([np.interp(stamps, t, base[:, k]) for k in range(3)])
    q_base = quat_from_yaw(np.interp(stamps, t, yaw))
    p = p + rotate(q_base, np.array(robot.p_base_lidar))
    q = quat_multiply(q_base, robot.q_base_lidar_xyzw)
    ranges = np.empty((len(stamps), spec.rays), np.float32)
    level = matrix_from_quat(robot.q_base_lidar_xyzw)
    if len(stamps) and abs(abs(level[2, 2]) - 1) < _UPRIGHT and np.ptp(p[:, 2]) == 0:
        cuts = _cuts(obstacles.triangles, p[0, 2])
        for row, (origin, axes) in enumerate(zip(p[:, :2], matrix_from_quat(q)[:, :2, :2], strict=True)):
            ranges[row] = _told(_cast((cuts - origin) @ axes, spec.rays), spec, noise)
    else:
        for row, pose in enumerate(zip(p, q, strict=True)):
            ranges[row] = scan(obstacles, pose, spec, noise)
    return Scans(stamps, arrival, p, q, ranges)


def _told(ranges: Array, spec: LidarSpec, rng: np.random.Generator | None) -> Array:
    """True ranges [m] as a LiDAR tells them: with noise, as far and as near as it sees."""
    if rng is not None:
        ranges = ranges + spec.range_noise_std_m * rng.standard_normal(len(ranges))
    ranges = np.where(ranges > spec.range_max_m, np.inf, ranges)
    return np.where(ranges < spec.range_min_m, -np.inf, ranges)


def _cuts(triangles: Array, height: float) -> Array:
    """Where triangles (T, 3, 3) cross a level plane: ends of a segment each, in x and y, shape (C, 2, 2).

    One that lies in the plane does not cross it; its neighbours do.
    """
    z = triangles[:, :, 2] - height
    above = z >= 0
    count = above.sum(axis=1)
    crossing = (count == 1) | (count == 2)
    corner, z, above = triangles[crossing], z[crossing], above[crossing]
    # The corner that is alone on its side; both others are joined to it by an edge that crosses.
    alone = np.argmax(above == (count[crossing] == 1)[:, None], axis=1)
    row = np.arange(len(corner))
    ends = []
    for other in ((alone + 1) % 3, (alone + 2) % 3):
        part = z[row, alone] / (z[row, alone] - z[row, other])
        a, b = corner[row, alone, :2], corner[row, other, :2]
        ends.append(a + part[:, None] * (b - a))
    return np.stack(ends, axis=1)


def _cast(segments: Array, rays: int) -> Array:
    """Range to the first segment along each ray from the origin, inf for none, shape (rays,).

    Each segment is met by the rays between the directions to its ends, and by no other.

    Args:
        segments: Their ends [m], shape (C, 2, 2).
        rays: Number of rays, see `ray_angles`.
    """
    a, b = segments[:, 0], segments[:, 1]
    cross = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    a, b = np.where(cross[:, None] < 0, b, a), np.where(cross[:, None] < 0, a, b)
    cross = np.abs(cross)
    sweep = np.arctan2(cross, a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1])
    step = 2 * np.pi / rays
    start = (np.arctan2(a[:, 1], a[:, 0]) + np.pi) / step
    first = np.ceil(start - _EDGE).astype(np.intp)
    count = np.floor(start + sweep / step + _EDGE).astype(np.intp) - first + 1
    count[cross == 0] = 0  # seen edge on
    which = np.repeat(np.arange(len(a)), count)
    ray = np.arange(len(which)) - np.repeat(np.cumsum(count) - count - first, count)
    angle = -np.pi + step * ray
    along = b[which] - a[which]
    facing = np.cos(angle) * along[:, 1] - np.sin(angle) * along[:, 0]
    met = facing > 0
    ranges = np.full(rays, np.inf)
    np.minimum.at(ranges, ray[met] % rays, cross[which][met] / facing[met])
    return ranges
