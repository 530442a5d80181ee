"""Fields at the magnetometer: the lab's field, and the field that the robot adds."""

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.maps.plane import Plane
from magtwin.field.sources.bodies import Bodies
from magtwin.field.sources.dipoles import dipole_field_nt
from magtwin.field.sources.magnets import body_of
from magtwin.sim.motion.drive import Moment, wheel_rates
from magtwin.sim.motion.sampling import Moving, moment_at
from magtwin.sim.sensors.battery import current_a
from magtwin.spec.base import ZERO3, Vec3
from magtwin.spec.drive import DriveSpec
from magtwin.spec.magnetics import EarthFieldSpec, PlatformFieldSpec, SourceSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene
from magtwin.spec.sensors import BatterySpec

Array = NDArray[np.float64]

TORQUE_S = 0.05
"""Time over which a wheel's acceleration is averaged [s]: the lag of its motor's current."""

CREEP = 0.05
"""Rate of a wheel below which its friction falls in proportion [rad/s]."""

MANY = 20_000
"""Number of points at one height for which the table of `level_field_nt` pays."""

DRAWN = (
    "hard_iron_nt",
    "hard_iron_change_nt",
    "left_motor_nt_nm",
    "right_motor_nt_nm",
    "lidar_nt",
    "lidar_cos_nt",
    "lidar_sin_nt",
    "battery_nt",
    "left_wheel_phase",
    "right_wheel_phase",
    "caster_phase",
    "lidar_phase",
)
"""Figures of a platform that differ between sessions."""

NEAREST_M = 1e-3
"""Least distance of a magnetometer from the middle of a wheel [m]."""


def ambient_field_nt(scene: Scene, p_world: ArrayLike) -> Array:
    """The lab's field without the robot: the uniform field of the Earth, and that of every source.

    Args:
        scene: A scene whose Earth's field is known.
        p_world: Points [m], shape (..., 3).

    Returns:
        Field in world axes [nT], shape (..., 3).
    """
    earth, bodies = _known(scene)
    p = np.asarray(p_world, float)
    if p.size >= 3 * MANY and p.shape[-1] == 3 and not np.ptp(p[..., 2]):
        level = p.reshape(-1, 3)
        return level_field_nt(scene, level[:, :2], level[0, 2])[0].reshape(p.shape)
    return bodies.field_nt(p) + earth


def level_field_nt(scene: Scene, p_xy: ArrayLike, height_m: float) -> tuple[Array, Array]:
    """`ambient_field_nt` at one height, to 1e-3 nT, and its slopes along x and y, for robots that drive.

    Returns:
        Field [nT], shape (N, 3), and dB/dx, dB/dy [nT/m], shape (N, 2, 3), in world axes.
    """
    earth = _known_earth(scene)
    plane = _plane(scene.magnets, earth, float(height_m))
    field, slopes = plane.field_and_slopes_nt(p_xy)
    return field + earth.b_world_nt, slopes


def level_gradient_nt_m(scene: Scene, p_xy: ArrayLike, height_m: float) -> Array:
    """`ambient_gradient_nt_m` at one height.

    The vertical slopes follow from those along x and y, because curl B = 0 and div B = 0 outside of
    magnetised things.

    Returns:
        Gradient [nT/m], shape (N,).
    """
    total, slopes = level_field_nt(scene, p_xy, height_m)
    (xx, xy, xz), (yx, yy, yz) = np.moveaxis(slopes, 0, -1)
    bx, by, bz = total.T
    along = np.stack(
        [bx * xx + by * xy + bz * xz, bx * yx + by * yy + bz * yz, bx * xz + by * yz - bz * (xx + yy)]
    )
    return np.asarray(np.sqrt(np.sum(along * along, axis=0) / (bx * bx + by * by + bz * bz)))


def ambient_gradient_nt_m(scene: Scene, p_world: ArrayLike) -> Array:
    """Steepness of the lab's field: |grad |B||.

    Returns:
        Gradient [nT/m], shape (...).
    """
    earth, bodies = _known(scene)
    p = np.asarray(p_world, float)
    along = np.eye(3).reshape(3, *(1,) * (p.ndim - 1), 3)
    each, at = np.broadcast_arrays(along, p[None])
    field, slope = bodies.field_and_rate_nt(at, each)
    total = field[0] + earth
    size = np.sqrt(np.sum(total * total, axis=-1))
    return np.asarray(np.sqrt(np.sum(np.square(np.sum(slope * total, axis=-1) / size), axis=0)))


def _known(scene: Scene) -> tuple[Array, Bodies]:
    """The Earth's field [nT] (3,), and all magnetised things."""
    earth = _known_earth(scene)
    return np.array(earth.b_world_nt), _bodies(scene.magnets, earth)


def _known_earth(scene: Scene) -> EarthFieldSpec:
    """The Earth's field; refuse a scene without it."""
    if scene.earth is None:
        way = "give it an [earth] table, or read the field from its map"
        raise InputError(f"scene {scene.name!r} has no Earth's field, so its exact field is not known; {way}")
    return scene.earth


@lru_cache(maxsize=8)
def _bodies(magnets: tuple[SourceSpec, ...], earth: EarthFieldSpec) -> Bodies:
    """Magnetised things, ready to be evaluated."""
    points = [source for source in magnets if source.shape == "point"]
    return Bodies(
        [body_of(source, earth.b_world_nt) for source in magnets if source.shape != "point"],
        [source.p_world for source in points],
        [source.m_world for source in points],
    )


@lru_cache(maxsize=8)
def _plane(magnets: tuple[SourceSpec, ...], earth: EarthFieldSpec, height_m: float) -> Plane:
    """Table of the field at the height of a robot's magnetometer."""
    return Plane(_bodies(magnets, earth), height_m)


def platform_field_nt(
    platform: PlatformFieldSpec,
    b_body: ArrayLike,
    *,
    b_rate: ArrayLike = 0.0,
    motor_nm: ArrayLike = (0.0, 0.0),
    lidar_on: ArrayLike = False,
    lidar_angle: ArrayLike = 0.0,
    battery_a: ArrayLike = 0.0,
) -> Array:
    """The field at the magnetometer with the robot's own part, except for iron that turns.

    B = (1 + S) b + h + E db/dt + m_l T_l + m_r T_r + on (l + l_c cos a + l_s sin a) + c i: induced, permanent
    and eddy parts after Tolles and Lawson (1950), then the motors, whose currents are proportional to their
    torques T, the LiDAR and its motor, and the supply current. The defaults are those of a robot at rest.

    Args:
        platform: S, h, E, m_l, m_r, l, l_c, l_s and c.
        b_body: Ambient field b in base_link axes [nT], shape (N, 3).
        b_rate: Its rate of change in base_link axes, with the turning of the robot [nT/s], shape (N, 3).
        motor_nm: Torques T of the left and right wheel [N m], shape (N, 2); see `wheel_torques_nm`.
        lidar_on: Whether the LiDAR spins, shape (N,).
        lidar_angle: Angle a of its motor [rad], shape (N,).
        battery_a: Supply current i above `rest_current_a` [A], shape (N,).

    Returns:
        Field in base_link axes [nT], shape (N, 3).
    """
    b = np.asarray(b_body, float)
    field = b + _times(b, np.reshape(platform.soft_iron, (3, 3)).T)
    field += platform.hard_iron_nt
    if any(platform.eddy_s):
        field += _times(np.broadcast_to(b_rate, b.shape), np.reshape(platform.eddy_s, (3, 3)).T)
    motors = np.stack([platform.left_motor_nt_nm, platform.right_motor_nt_nm], axis=-2)
    if motors.any():
        field += _times(np.asarray(motor_nm, float), motors)
    if np.any(platform.battery_nt):
        field += np.asarray(battery_a, float)[..., None] * np.asarray(platform.battery_nt)
    on = np.broadcast_to(np.asarray(lidar_on, bool), b.shape[:-1])
    if on.any():
        angle = np.broadcast_to(lidar_angle, on.shape)[on]
        parts = np.stack([platform.lidar_nt, platform.lidar_cos_nt, platform.lidar_sin_nt], axis=-2)
        parts = parts if parts.ndim == 2 else parts[on]
        field[on] += _times(np.column_stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)]), parts)
    return field


def _times(rows: Array, matrix: Array) -> Array:
    """Rows (..., K) times a matrix (K, 3), or one matrix for each row; faster than `@` for so few columns."""
    return np.einsum("...k,kj->...j" if matrix.ndim == 2 else "nk,nkj->nj", rows, matrix)


def turning_iron_nt(robot: RobotSpec, wheel_angle: ArrayLike) -> Array:
    """Field of the iron in wheels and caster: dipoles that turn with them about base_link's y.

    The wheels are beside base_link's origin, at half their separation and at their radius above the floor. A
    moment points up at the angle 0 and forwards a quarter turn later. The caster rolls straight on, by the
    mean distance of the wheels; that its axis turns on curves is neglected.

    Returns:
        Field in base_link axes [nT], shape (N, 3).
    """
    platform, angle = robot.platform, np.asarray(wheel_angle, float)
    rolled = (angle[:, 0] + angle[:, 1]) * (robot.drive.wheel_radius_m / platform.caster_radius_m / 2)
    side, axle = robot.drive.wheel_separation_m / 2, robot.drive.wheel_radius_m - robot.base_height_m
    field = np.zeros((len(angle), 3))
    for m, phase, place, turned in (
        (platform.left_wheel_moment, platform.left_wheel_phase, (0.0, side, axle), angle[:, 0]),
        (platform.right_wheel_moment, platform.right_wheel_phase, (0.0, -side, axle), angle[:, 1]),
        (platform.caster_moment, platform.caster_phase, platform.p_base_caster, rolled),
    ):
        if m:
            unit, now = _unit_fields(robot.name, robot.p_base_magnetometer, place), turned + phase
            field += _times(np.column_stack([np.cos(now), np.sin(now)]), m * unit)
    return field


@lru_cache(maxsize=64)
def _unit_fields(robot: str, p_base_magnetometer: Vec3, p_base: Vec3) -> Array:
    """Field at the magnetometer of 1 A m2 at `p_base`, pointing up and forwards [nT], shape (2, 3)."""
    apart = np.subtract(p_base_magnetometer, p_base)
    if not np.linalg.norm(apart) > NEAREST_M:
        raise InputError(
            f"robot {robot!r}: its magnetometer, at {p_base_magnetometer} of base_link, is in the "
            "middle of a wheel or of the caster, whose iron is magnetised; move one of them"
        )
    up_and_forwards = np.array([[[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]]])
    return np.array([dipole_field_nt(apart, np.zeros((1, 3)), m) for m in up_and_forwards])


def wheel_torques_nm(
    battery: BatterySpec, drive: DriveSpec, rate: ArrayLike, acceleration: ArrayLike
) -> Array:
    """Torque at each wheel: r (F / 2 sign w + m r / 2 dw/dt), half of the robot's drag and inertia.

    The power that `magtwin.sim.sensors.battery` draws is for this torque. Below `CREEP` the drag is
    proportional to w.

    Args:
        battery: Drag F [N] and mass m [kg].
        drive: Wheel radius r.
        rate: Rates w of the wheels [rad/s], shape (..., 2).
        acceleration: Their accelerations dw/dt [rad/s2], shape (..., 2).

    Returns:
        Torques [N m], shape (..., 2).
    """
    friction = battery.drag_n / 2 * np.clip(np.asarray(rate, float) / CREEP, -1, 1)
    inertia = battery.mass_kg / 2 * drive.wheel_radius_m * np.asarray(acceleration, float)
    return np.asarray(drive.wheel_radius_m * (friction + inertia))


def rest_current_a(battery: BatterySpec) -> float:
    """Supply current of a resting robot with a full pack and its LiDAR off [A], as in a survey."""
    if battery.model == "linear":
        return battery.load_w / battery.voltage_full_v
    return float(current_a(battery, battery.load_w, 1.0))


def ambient_at_sensor_nt(scene: Scene, true: Moment) -> tuple[Array, Array]:
    """The lab's field at the magnetometer of a robot, and its rate of change, in base_link axes.

    The rate is d/dt (R^T B) = R^T dB/dt - w x R^T B, with dB/dt = (u . grad) B for the magnetometer's
    velocity u, that of the twist from now on.

    Returns:
        Field [nT] and rate [nT/s], shape (N, 3) each.
    """
    robot = scene.robot
    cos, sin = np.cos(true.pose[:, 2]), np.sin(true.pose[:, 2])
    p_world = sensor_places(robot, true.pose)
    vx = true.v * cos - true.w * (p_world[:, 1] - true.pose[:, 1])
    vy = true.v * sin + true.w * (p_world[:, 0] - true.pose[:, 0])
    b_world, slopes = level_field_nt(scene, p_world[:, :2], p_world[0, 2])
    change = vx[:, None] * slopes[:, 0] + vy[:, None] * slopes[:, 1]
    b_base = into_base_axes(b_world, cos, sin)
    b_rate = into_base_axes(change, cos, sin)
    b_rate[:, 0] += true.w * b_base[:, 1]
    b_rate[:, 1] -= true.w * b_base[:, 0]
    return b_base, b_rate


def own_field_nt(
    robot: RobotSpec,
    motion: Moving,
    t: ArrayLike,
    b_base: Array,
    b_rate: ArrayLike,
    *,
    true: Moment,
    lidar_on: ArrayLike,
    supply_a: ArrayLike,
) -> Array:
    """The field at the magnetometer of a robot that drives, from the ambient field there, without its plant.

    Arrays have a row for each of N readings at times t; `true` is the motion at these times.

    Returns:
        Field in base_link axes [nT], shape (N, 3).
    """
    t = np.asarray(t, float)
    motors = np.any(robot.platform.left_motor_nt_nm) or np.any(robot.platform.right_motor_nt_nm)
    field = platform_field_nt(
        robot.platform,
        b_base,
        b_rate=b_rate,
        motor_nm=torques_nm(robot, motion, t, true) if motors else (0.0, 0.0),
        lidar_on=lidar_on,
        lidar_angle=lidar_angle(robot, t),
        battery_a=np.asarray(supply_a, float) - rest_current_a(robot.battery),
    )
    return field + turning_iron_nt(robot, true.wheel_angle)


def lidar_angle(robot: RobotSpec, t: ArrayLike) -> Array:
    """Angle of the LiDAR's motor at times [s], as if it always spun [rad]."""
    turned = 2 * math.pi * robot.lidar.scan_rate_hz * np.asarray(t, float)
    return np.asarray(turned + robot.platform.lidar_phase)


def sensor_places(robot: RobotSpec, pose: Array) -> Array:
    """Places of the magnetometer in world [m], (N, 3), for poses x, y, yaw of base_link (N, 3)."""
    x, y, yaw = pose.T
    cos, sin = np.cos(yaw), np.sin(yaw)
    px, py, pz = robot.p_base_magnetometer
    return np.column_stack(
        [x + px * cos - py * sin, y + px * sin + py * cos, np.full(len(x), robot.base_height_m + pz)]
    )


def draw_platform(platform: PlatformFieldSpec, rng: np.random.Generator) -> PlatformFieldSpec:
    """The platform in one session.

    The permanent field has drifted since the survey by `hard_iron_drift_nt`, and varies between sessions by
    `hard_iron_std_nt` along each axis. The field of currents varies by the factor 1 + `current_std` N, with a
    standard normal N each for motors, LiDAR and battery. Wheels, caster and LiDAR begin at any angle.

    So in another session than that of its survey a map errs by a constant and by a wave over heading. For the
    TurtleBot 4 in Florida, where the field dips by 58 deg, the drift makes 690 nT and a wave of 130 nT; the
    90 nT between sessions make 77 nT and a wave of 70 nT (root mean squares).

    Returns:
        The platform with these figures drawn, its drift and spreads 0. `hard_iron_change_nt` is the change
        since the survey.
    """
    hard_iron = np.add(platform.hard_iron_nt, platform.hard_iron_drift_nt)
    hard_iron += platform.hard_iron_std_nt * rng.standard_normal(3)
    motors, lidar, battery = 1 + platform.current_std * rng.standard_normal(3)
    angles = rng.uniform(0, 2 * math.pi, 4).tolist()
    scaled = dict.fromkeys(("left_motor_nt_nm", "right_motor_nt_nm"), motors) | {"battery_nt": battery}
    scaled |= dict.fromkeys(("lidar_nt", "lidar_cos_nt", "lidar_sin_nt"), lidar)
    fields = {name: tuple((np.array(getattr(platform, name)) * by).tolist()) for name, by in scaled.items()}
    names = ("left_wheel_phase", "right_wheel_phase", "caster_phase", "lidar_phase")
    change = hard_iron - platform.hard_iron_nt + platform.hard_iron_change_nt
    return replace(
        platform,
        hard_iron_nt=tuple(hard_iron.tolist()),
        hard_iron_change_nt=tuple(change.tolist()),
        hard_iron_drift_nt=ZERO3,
        hard_iron_std_nt=0.0,
        current_std=0.0,
        **fields,  # type: ignore[arg-type]
        **dict(zip(names, angles, strict=True)),
    )


def platforms_of_rows(platforms: Sequence[PlatformFieldSpec]) -> PlatformFieldSpec:
    """Platforms of many robots as one, for readings that each belong to another robot.

    Returns:
        The first platform, with arrays of a row or number per robot for the figures in `DRAWN`.
    """
    several = copy(platforms[0])  # its checks are for one robot
    for name in DRAWN:
        object.__setattr__(several, name, np.array([getattr(one, name) for one in platforms]))
    return several


def torques_nm(robot: RobotSpec, motion: Moving, t: Array, true: Moment) -> Array:
    """Torques of the wheels, with their accelerations over the last `TORQUE_S` [N m], shape (N, 2)."""
    before = moment_at(motion, t - TORQUE_S)
    rate = wheel_rates(true.v, true.w, robot.drive)
    acceleration = (rate - wheel_rates(before.v, before.w, robot.drive)) / TORQUE_S
    return wheel_torques_nm(robot.battery, robot.drive, rate, acceleration)


def into_base_axes(b_world: Array, cos: Array, sin: Array) -> Array:
    """Vectors (N, 3) turned from world into base_link axes, headings given by cos and sin (N,)."""
    bx, by, bz = b_world.T
    return np.column_stack([cos * bx + sin * by, cos * by - sin * bx, bz])
