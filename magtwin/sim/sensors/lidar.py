"""LiDAR: its schedule, and the scans of a planar one."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.frames import matrix_from_quat, quat_from_yaw, quat_multiply, rotate
from magtwin.report.summary import Summarized, Summary, span
from magtwin.run.run import Run
from magtwin.sim.motion.sampling import check_count
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.robot import RobotSpec
from magtwin.spec.sensors import LidarSpec

Array = NDArray[np.float64]

_EDGE = 1e-9
"""Part of a ray's step by which a surface is extended, so that no ray slips between two."""

_SAME_S = 1e-6
"""How far past the last reading a scan still belongs to a run [s]."""

_UPRIGHT = 1e-12
"""Sine of the angle from the vertical below which a LiDAR's axis counts as upright."""


def lidar_on(
    spec: LidarSpec, t: ArrayLike, mode: Literal["schedule", "on", "off"] = "schedule"
) -> NDArray[np.bool_]:
    """Whether the LiDAR spins at times `t` [s], shape (...).

    Args:
        spec: The schedule: off for off_s, on for on_s, and so on; at t = 0 it is at phase_s.
        t: Times since the start [s].
        mode: "schedule", or always "on" or "off".
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
    """Directions of a scan's rays in the LiDAR's xy plane [rad]: anticlockwise from -pi, evenly; (rays,)."""
    return np.arange(rays, dtype=float) * (2 * np.pi / rays) - np.pi


def scan(
    obstacles: Obstacles,
    pose: tuple[ArrayLike, ArrayLike],
    spec: LidarSpec,
    rng: np.random.Generator | None = None,
) -> Array:
    """Ranges of one turn, all rays at the same time; the robot itself is not seen.

    Args:
        obstacles: What there is to see, by its triangles.
        pose: LiDAR's origin p_world_lidar [m], shape (3,), and its axes q_world_lidar_xyzw, shape (4,).
        spec: Rays, ranges and noise.
        rng: Source of noise. Default: no noise.

    Returns:
        Ranges along `ray_angles` [m], shape (rays,), after REP 117: inf if nothing is within `range_max_m`,
        -inf if something is nearer than `range_min_m`.
    """
    p, turn = np.asarray(pose[0], float), matrix_from_quat(pose[1])
    cuts = _cuts((obstacles.triangles - p) @ turn, 0.0)
    return _reported(_cast(cuts, spec.rays), spec, rng)


@dataclass(frozen=True, eq=False, repr=False)
class Scans(Summarized):
    """The scans of a run, one a row."""

    t: Array
    """Time of each scan [s], shape (S,)."""

    arrival: Array
    """Time of its arrival [s], shape (S,)."""

    p_world_lidar: Array
    """Place of the LiDAR [m], shape (S, 3)."""

    q_world_lidar_xyzw: Array
    """Its axes, shape (S, 4)."""

    ranges_m: NDArray[np.float32]
    """Ranges along `ray_angles` [m], shape (S, rays); see `scan`."""

    def take(self, rows: slice | NDArray[np.bool_]) -> "Scans":
        """Some scans, by a slice or a mask."""
        return Scans(*(getattr(self, field.name)[rows] for field in fields(self)))

    def points_world(self) -> list[Array]:
        """Points that each scan hit, in world [m], each of shape (H, 3)."""
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


class Scanner:
    """A LiDAR that scans once a turn while it spins, continued from call to call."""

    def __init__(
        self, robot: RobotSpec, obstacles: Obstacles, rng: np.random.Generator, *, begin_s: float = 0.0
    ) -> None:
        """Begin a turn."""
        self._robot, self._obstacles, self._begin_s = robot, obstacles, begin_s
        self._delays, self._noise = rng.spawn(2)
        self._next, self._arrived = 0, -np.inf
        self._cuts: tuple[float, Array] | None = None

    def scan(
        self,
        until_s: float,
        poses: Callable[[Array], Array],
        lidar_on: Callable[[Array], NDArray[np.bool_]],
    ) -> Scans:
        """The scans whose time comes before `until_s`, with the times at which they arrive."""
        spec, robot = self._robot.lidar, self._robot
        last = int(np.ceil((until_s - self._begin_s) * spec.scan_rate_hz - 1e-9))
        stamps = self._begin_s + np.arange(self._next, max(last, self._next)) / spec.scan_rate_hz
        self._next += len(stamps)
        late = spec.latency_s + spec.jitter_s * self._delays.exponential(1.0, len(stamps))
        arrival = np.maximum.accumulate(np.concatenate([[self._arrived], stamps + late]))
        self._arrived, spins = arrival[-1], lidar_on(stamps)
        stamps, arrival = stamps[spins], arrival[1:][spins]
        pose = poses(stamps)
        q_base = quat_from_yaw(pose[:, 3])
        p = pose[:, :3] + rotate(q_base, np.array(robot.p_base_lidar))
        q = quat_multiply(q_base, robot.q_base_lidar_xyzw)
        ranges = np.empty((len(stamps), spec.rays), np.float32)
        upright = abs(abs(matrix_from_quat(robot.q_base_lidar_xyzw)[2, 2]) - 1) < _UPRIGHT
        for row, (at, axes) in enumerate(zip(p, q, strict=True)):
            if upright:
                turn = matrix_from_quat(axes)[:2, :2]
                if self._cuts is None or self._cuts[0] != at[2]:  # a robot on a floor has one height
                    self._cuts = at[2], _cuts(self._obstacles.triangles, at[2])
                hits = _cast((self._cuts[1] - at[:2]) @ turn, spec.rays)
                ranges[row] = _reported(hits, spec, self._noise)
            else:
                ranges[row] = scan(self._obstacles, (at, axes), spec, self._noise)
        return Scans(stamps, arrival, p, q, ranges)


def scans_of(run: Run, robot: RobotSpec, obstacles: Obstacles, rng: np.random.Generator) -> Scans:
    """The scans of a LiDAR in a run, one per turn while it spun."""
    t, base, yaw = run["t"], run["p_world_base"], np.unwrap(run["yaw"])
    check_count("a LiDAR's scans", t[-1] - t[0], robot.lidar.scan_rate_hz)

    def poses(stamps: Array) -> Array:
        columns = [np.interp(stamps, t, base[:, k]) for k in range(3)]
        return np.column_stack([*columns, np.interp(stamps, t, yaw)])

    def spins(stamps: Array) -> NDArray[np.bool_]:
        return np.asarray(run["lidar_on"][np.searchsorted(t, stamps, side="right") - 1])

    scanner = Scanner(robot, obstacles, rng, begin_s=t[0])
    return scanner.scan(t[-1] + _SAME_S, poses, spins)


def _reported(ranges: Array, spec: LidarSpec, rng: np.random.Generator | None) -> Array:
    """Ranges [m] with noise, from the nearest to the farthest that the LiDAR measures."""
    if rng is not None:
        ranges = ranges + spec.range_noise_std_m * rng.standard_normal(len(ranges))
    ranges = np.where(ranges > spec.range_max_m, np.inf, ranges)
    return np.where(ranges < spec.range_min_m, -np.inf, ranges)


def _cuts(triangles: Array, height: float) -> Array:
    """Segments in which triangles (T, 3, 3) cross a level plane: ends in x and y, shape (C, 2, 2).

    A triangle in the plane does not cross it, but its neighbours do.
    """
    z = triangles[:, :, 2] - height
    above = z >= 0
    count = above.sum(axis=1)
    crossing = (count == 1) | (count == 2)
    corner, z, above = triangles[crossing], z[crossing], above[crossing]
    # Both edges from the corner that is alone on its side cross the plane.
    alone = np.argmax(above == (count[crossing] == 1)[:, None], axis=1)
    row = np.arange(len(corner))
    ends = []
    for other in ((alone + 1) % 3, (alone + 2) % 3):
        part = z[row, alone] / (z[row, alone] - z[row, other])
        a, b = corner[row, alone, :2], corner[row, other, :2]
        ends.append(a + part[:, None] * (b - a))
    return np.stack(ends, axis=1)


def _cast(segments: Array, rays: int) -> Array:
    """Range to the first segment along each ray from the origin, inf if there is none, shape (rays,).

    A segment is met by the rays between the directions to its ends.
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
