"""Survey of the twin: the readings that the robot would take in the lab, and the map that it would make."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.grid import Grid
from magtwin.field.maps.curvature import interpolation_error_nt2
from magtwin.field.maps.holes import filled
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.maps.scene_state import made_from
from magtwin.field.survey.readings import Readings
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate
from magtwin.parallel import run_all
from magtwin.sim.at_rest import field_at_rest_nt, in_steel, places_at_rest, sensor_height_m
from magtwin.sim.interference import ambient_field_nt, ambient_gradient_nt_m, platform_field_nt
from magtwin.sim.sensors.magnetometer import lost_in, rounded, stuck_nt
from magtwin.spec.lab import SurveySpec, on_polygon
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]

MOST_READINGS = 100_000
"""Most readings at a node: 12 minutes at 135 Hz."""

LEAST_REACH_M = 0.01
"""Least distance between the points through which a field is taken as quadratic [m]."""

QUARTERS = (0.0, np.pi / 2, np.pi, 3 * np.pi / 2)


def visit(
    scene: Scene,
    *,
    rng: np.random.Generator,
    spacing_m: float = 0.25,
    headings_rad: Sequence[float] = QUARTERS,
    readings: int = 1,
    height_m: float | None = None,
    heading_error_rad: float = 0.0,
    position_error_m: float = 0.0,
    source: str = "",
    licence: str = "",
    created: str = "",
    progress: Callable[[int, int, str], Any] = lambda done, total, what: None,
    blocked: Callable[[Array], NDArray[np.bool_]] | None = None,
    jobs: int | None = None,
) -> tuple[Readings, NDArray[np.bool_]]:
    """Readings of the robot at each node of a grid, in each heading.

    base_link stands on the node, so the magnetometer is beside it by its lever arm, turned with the heading.
    The motors rest, the LiDAR is off and the battery is full. Nodes are visited along x, row by row. If the
    field is too steep, the magnetometer loses lock and repeats one stuck value until it finds lock again.

    Args:
        scene: A scene whose Earth's field is known; its map is not read.
        rng: Source of the sensor's noise and the robot's errors.
        spacing_m: Distance between nodes [m]; the grid is centred on the floor and stays on it.
        headings_rad: Headings, ascending in [0, 2 pi) [rad].
        readings: Readings that are averaged at a node; each has the sensor's noise and resolution.
        height_m: Height of the magnetometer above the floor [m]. Default: the robot's.
        heading_error_rad: Standard deviation of the robot's heading about the node's [rad]. The robot's
            heading is recorded.
        position_error_m: Standard deviation of the robot's place about the node, along x and y [m]. The node
            is recorded.
        source: What the scene was made from.
        licence: SPDX name of the survey's licence.
        created: Day of the survey, YYYY-MM-DD.
        progress: Called with headings done, headings in all, and what is being done.
        blocked: From nodes of shape (Y, X, 2) to whether the robot cannot stand there. Default: none.
        jobs: Processes that share the headings; they do not change the readings. Default: this process, with
            several threads.

    Returns:
        A row for each node, in the order of `Grid.poses`, with magnitudes, `good` where the robot can stand;
        and the nodes without a reading, shape (H, Y, X): lock was lost, or the node is blocked.
    """
    if not 1 <= readings <= MOST_READINGS:
        most = f" and at most {MOST_READINGS:,}" if readings > MOST_READINGS else ""
        raise InputError(f"readings must be at least 1{most}, got {readings!r}")
    for name, sd in {"heading_error_rad": heading_error_rad, "position_error_m": position_error_m}.items():
        if not 0 <= sd < np.inf:
            raise InputError(f"{name} must not be below 0, got {sd!r}", parameter=name)
    if position_error_m > spacing_m > 0:
        text = f"is above the spacing of {spacing_m!r} m; the robot would not find its nodes"
        raise InputError(f"position_error_m {position_error_m!r} {text}")
    if heading_error_rad > np.pi / 2:
        text = f"heading_error_rad must not be above pi/2, got {heading_error_rad!r}"
        raise InputError(text, parameter="heading_error_rad")
    height = sensor_height_m(scene) if height_m is None else height_m
    if not 0 <= height < np.inf:
        raise InputError(f"height_m must be a height above the floor, 0 m or more, got {height!r}")
    grid = Grid.over(scene.lab.extent_m, spacing_m, np.asarray(headings_rad, float))
    node, nominal = grid.poses()
    stands, yaw = node, nominal
    if position_error_m:
        stands = node + position_error_m * rng.standard_normal(node.shape)
    if heading_error_rad:
        yaw = nominal + heading_error_rad * rng.standard_normal(nominal.shape)
    sensor, stuck = scene.robot.magnetometer, rng.spawn(1)[0]
    closed = np.zeros(grid.shape, bool)
    if blocked is not None:
        closed = np.stack([blocked(nodes) for nodes in node])
    exact, lost = np.zeros(grid.shape), closed.copy()
    here = [... if not shut.any() else np.nonzero(~shut) for shut in closed]
    visited = run_all(
        partial(_at_nodes, scene, height_m, height),
        [(stands[k][at], yaw[k][at]) for k, at in enumerate(here)],
        jobs=jobs,
        progress=lambda done, every: progress(done, every, ""),
    )
    for k, (at, (exact_here, lost_here)) in enumerate(zip(here, visited, strict=True)):
        exact[k][at], lost[k][at] = exact_here, lost_here
    total = np.zeros_like(exact)
    for _ in range(readings):
        noise = sensor.noise_std_nt * rng.standard_normal(exact.shape)
        total += rounded(exact + noise, sensor.resolution_nt)
    if lost.any():
        value = rounded(stuck_nt(sensor, lost.ravel(), stuck), sensor.resolution_nt).reshape(grid.shape)
        total[lost] = value[lost] * readings
    read = Readings(
        good=~closed.ravel(),
        p_xy=node.reshape(-1, 2),
        yaw=yaw.ravel(),
        b_nt=(total / readings).ravel(),
        grid=grid,
        node=np.moveaxis(np.indices(grid.shape), 0, -1).reshape(-1, 3),
        height_m=height,
        name=scene.name,
        source=source,
        licence=licence,
        created=created,
        frame=_frame(scene),
        datum=_datum(scene),
        earth_nt=None if scene.earth is None else scene.earth.b_world_nt,
    )
    return read, lost


def survey_readings(scene: Scene, *, rng: np.random.Generator, **options: Any) -> Readings:
    """The readings of `visit`, whose arguments these are."""
    return visit(scene, rng=rng, **options)[0]


def _at_nodes(
    scene: Scene, height_m: float | None, height: float, poses: tuple[Array, Array]
) -> tuple[Array, NDArray[np.bool_]]:
    """Exact field [nT] at places (..., 2) and headings (...), and whether the sensor loses lock there."""
    stands, yaw = poses
    sensor = scene.robot.magnetometer
    exact = field_at_rest_nt(scene, stands, yaw, height_m=height_m)
    if not sensor.gradient_max_nt_m:
        return exact, np.zeros(exact.shape, bool)
    gradient = ambient_gradient_nt_m(scene, places_at_rest(scene, stands, yaw, height))
    return exact, lost_in(sensor, gradient.ravel()).reshape(gradient.shape)


def survey(
    scene: Scene,
    *,
    rng: np.random.Generator,
    readings: int = 1,
    heading_error_rad: float = 0.0,
    position_error_m: float = 0.0,
    name: str | None = None,
    **options: Any,
) -> AnomalyMap:
    """Map the lab as the robot would: the values at the nodes are those of `visit`.

    The variance of a node is that of the sensor's noise and resolution, plus the mean square by which the
    field at the robot's actual pose differs from that at the node. Between nodes, the error of interpolation
    is estimated from the nodes (`magtwin.field.maps.curvature`).

    Arguments are those of `visit`, and the map's name, by default the scene's.

    Returns:
        The map, with its variance. Nodes that are blocked or where lock was lost are not valid.
    """
    errors: dict[str, Any] = {"heading_error_rad": heading_error_rad, "position_error_m": position_error_m}
    read, lost = visit(scene, rng=rng, readings=readings, **errors, **options)
    assert read.grid is not None
    assert read.height_m is not None
    sensor, grid = scene.robot.magnetometer, read.grid
    variance = (sensor.noise_std_nt**2 + sensor.resolution_nt**2 / 12) / readings
    with np.errstate(invalid="ignore", divide="ignore"):  # in what stands at a blocked node
        missed = pose_error_nt2(scene, grid, read.height_m, **errors)
    values, total = read.b_nt.reshape(grid.shape), variance + missed
    return AnomalyMap(
        values_nt=values,
        origin_m=grid.origin_m,
        cell_m=grid.cell_m,
        headings_rad=np.array(grid.headings_rad),
        valid=~lost,
        variance_nt2=total,
        between_nt2=interpolation_error_nt2(values, ~lost, grid.headings_rad, total),
        name=scene.name if name is None else name,
        method=f"survey of the twin, {readings} reading{'s' * (readings > 1)} a node and heading, at rest",
        source=read.source,
        licence=read.licence,
        created=read.created,
        frame=read.frame,
        datum=read.datum,
        height_m=read.height_m,
        made_from=made_from(scene, height_m=read.height_m),
        parameters={
            "readings": readings,
            "noise_std_nt": sensor.noise_std_nt,
            "resolution_nt": sensor.resolution_nt,
            **{name: error for name, error in errors.items() if error},
        },
    )


def pose_error_nt2(
    scene: Scene, grid: Grid, height_m: float, *, heading_error_rad: float, position_error_m: float
) -> Array:
    """Mean square error of readings whose pose is a little off the node.

    E[(B(node + e) - B(node))^2] over normal errors e, by a rule of degree 5 (McNamee and Stenger 1967;
    2 n^2 + 1 points for n errors), which is exact for a parabola. The vector field around a node is the same
    for all headings: quadratic in x and y, through 3 x 3 points.

    Returns:
        Mean square [nT^2], shape (H, Y, X).
    """
    total = np.zeros(grid.shape)
    spread = np.array([position_error_m, position_error_m, heading_error_rad])
    if not spread.any():
        return total
    lever = np.asarray(scene.robot.p_base_magnetometer)[:2]
    reach = max(float(np.hypot(*lever)) + 2 * position_error_m, LEAST_REACH_M)
    around = _parabola(scene, grid, height_m, reach)

    def field(off: Array, yaw: float) -> Array:
        """Magnitude with base_link at an offset from its nodes [nT], shape (Y, X)."""
        c, s = np.cos(yaw), np.sin(yaw)
        dx, dy = off[0] + c * lever[0] - s * lever[1], off[1] + s * lever[0] + c * lever[1]
        world = np.tensordot([1, dx, dy, dx * dx / 2, dx * dy, dy * dy / 2], around, axes=1)
        body = rotate(quat_conjugate(quat_from_yaw(yaw)), world).reshape(-1, 3)
        read = platform_field_nt(scene.robot.platform, body)
        return np.asarray(np.linalg.norm(read, axis=-1)).reshape(world.shape[:-1])

    active = np.flatnonzero(spread)
    for k, heading in enumerate(grid.headings_rad):
        node = field(np.zeros(2), heading)
        for point, weight in _rule(len(active)):
            e = np.zeros(3)
            e[active] = point * spread[active]
            total[k] += weight * (field(e[:2], heading + e[2]) - node) ** 2
    return total


def _parabola(scene: Scene, grid: Grid, height_m: float, step: float) -> Array:
    """Vector field around each node: value, d/dx, d/dy, d2/dx2, d2/dxdy, d2/dy2, shape (6, Y, X, 3)."""
    node = grid.poses()[0][0]
    at = np.empty((3, 3, grid.rows, grid.columns, 3))
    at[..., 2] = height_m
    for i, j in np.ndindex(3, 3):
        at[i, j, ..., :2] = node + step * np.array([i - 1, j - 1])
    b = ambient_field_nt(scene, at)
    return np.stack(
        [
            b[1, 1],
            (b[2, 1] - b[0, 1]) / (2 * step),
            (b[1, 2] - b[1, 0]) / (2 * step),
            (b[2, 1] - 2 * b[1, 1] + b[0, 1]) / step**2,
            (b[2, 2] - b[2, 0] - b[0, 2] + b[0, 0]) / (4 * step**2),
            (b[1, 2] - 2 * b[1, 1] + b[1, 0]) / step**2,
        ]
    )


def _rule(n: int) -> list[tuple[Array, float]]:
    """Points and weights of degree 5 for n standard normals, without the middle, which has no error."""
    axes, root = np.eye(n), np.sqrt(3)
    points = [(sign * root * axis, (4 - n) / 18) for axis in axes for sign in (1, -1)]
    for i, j in itertools.combinations(range(n), 2):
        points += [(root * (a * axes[i] + b * axes[j]), 1 / 36) for a in (1, -1) for b in (1, -1)]
    return points


def _frame(scene: Scene) -> str:
    """The axes of a scene's world, in words."""
    north = scene.earth.north_deg if scene.earth is not None else 0.0
    if north == 0:
        return "world: x east, y north, z up"
    return f"world: z up, true north {north:g} deg from y towards -x"


def _datum(scene: Scene) -> str:
    """Place of a scene's world, in words."""
    where = "origin amid the floor, heights above it"
    if scene.earth is None:
        return where
    earth = scene.earth
    degrees = f"{earth.latitude_deg:g} deg N, {earth.longitude_deg:g} deg E"
    return f"{where}; {degrees}, {earth.height_m:g} m above the WGS 84 ellipsoid"


@dataclass(frozen=True, eq=False)
class Surveyed:
    """The map of a furnished room, in which a robot cannot stand at every node."""

    field: AnomalyMap
    """The map, with a value at every node."""

    filled: int
    """Nodes filled from their neighbours, over all headings: the robot cannot stand there, or loses lock."""

    magnets: int
    """Number of magnetised things."""

    def __str__(self) -> str:
        field = self.field
        headings, rows, columns = field.values_nt.shape
        low, high = field.values_nt.min() / 1000, field.values_nt.max() / 1000
        holes = (
            f"; {self.filled} of the {field.values_nt.size} values, at nodes in steel or where no robot can "
        )
        holes += "stand, are filled from their neighbours"
        none = "; nothing is magnetised, so the field is the same everywhere"
        return (
            f"surveyed by its own robot: {columns} x {rows} nodes {field.cell_m[0]:g} m apart, {headings} "
            f"headings, {field.height_m:.3g} m above the floor, {low:.2f} to {high:.2f} uT"
            f"{holes if self.filled else ''}{'' if self.magnets else none}"
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
    """Survey a scene, and fill the nodes that the robot cannot reach.

    Returns:
        The map, and the number of filled nodes.
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
    # a map layer holds 32 bit numbers
    values, variance, between = (
        None if array is None else array.astype(np.float32).astype(float)
        for array in (whole.values_nt, whole.variance_nt2, whole.between_nt2)
    )
    assert values is not None
    parameters = {**field.parameters, "seed": seed, "filled_nodes": holes}
    return Surveyed(
        replace(whole, values_nt=values, variance_nt2=variance, between_nt2=between, parameters=parameters),
        holes,
        len(scene.magnets),
    )


def blocked_by(scene: Scene, obstacles: Obstacles) -> Callable[[Array], NDArray[np.bool_]]:
    """Which nodes the robot cannot stand at, because of obstacles or magnetised things.

    Walls at the border of the floor do not count, because the map is needed up to them.

    Returns:
        A function from nodes [m], shape (..., 2), to whether each is blocked, shape (...).
    """
    half, floor = np.array(scene.lab.floor_m) / 2, scene.lab.floor
    nearest = [np.clip(0.0, o.min(axis=0), o.max(axis=0)) for o in obstacles.outlines]  # to the middle
    inner = [k for k, p in enumerate(nearest) if np.all(np.abs(p) < half - 1e-6)]
    if floor:
        sides = [side.name for side in scene.lab.sides]
        inner = [k for k, name in enumerate(obstacles.names) if name.split("/")[-2] not in sides]
    standing = obstacles.only(inner)
    radius = scene.robot.footprint_radius_m

    def blocked(nodes: Array) -> NDArray[np.bool_]:
        p = nodes.reshape(-1, 2)
        distance, _ = standing.clearance(p, reach_m=radius)
        inside = in_steel(scene, p, sensor_height_m(scene))
        off = ~on_polygon(p, floor) if floor else False
        return np.asarray((distance < radius) | inside | off).reshape(nodes.shape[:-1])

    return blocked
