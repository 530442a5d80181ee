"""Fields at the magnetometer: the lab's, and what the robot adds to it."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.bodies import Bodies
from magtwin.names import RefusedError
from magtwin.spec import BatterySpec, EarthFieldSpec, PlatformFieldSpec, Scene, SourceSpec

Array = NDArray[np.float64]


def ambient_field_nt(scene: Scene, p_world: ArrayLike) -> Array:
    """The lab's field without the robot: the Earth's, uniform, and that of every source.

    Args:
        scene: A scene whose Earth's field is known.
        p_world: Points [m], shape (..., 3).

    Returns:
        Field in world axes [nT], shape (..., 3).

    Raises:
        RefusedError: The scene has no Earth's field, so only its map is known; or a shape is not as above.
    """
    earth, bodies = _known(scene)
    return bodies.field_nt(p_world) + earth


def ambient_field_and_rate_nt(scene: Scene, p_world: ArrayLike, v_world: ArrayLike) -> tuple[Array, Array]:
    """`ambient_field_nt` at points that move, and how fast it changes there.

    Args:
        scene: A scene whose Earth's field is known.
        p_world: Points [m], shape (..., 3).
        v_world: Their velocities [m/s], shape (..., 3).

    Returns:
        Field [nT] and its rate of change [nT/s], both in world axes, each of shape (..., 3).

    Raises:
        RefusedError: As for `ambient_field_nt`.
    """
    earth, bodies = _known(scene)
    field, rate = bodies.field_and_rate_nt(p_world, v_world)
    return field + earth, rate


def _known(scene: Scene) -> tuple[Array, Bodies]:
    """The Earth's field [nT] (3,), and everything that is magnetised."""
    if scene.earth is None:
        raise RefusedError(
            f"scene {scene.name!r} has no Earth's field, so its exact field is not known; "
            "give it an [earth] table, or read the field from its map"
        )
    return np.array(scene.earth.b_world_nt), _bodies(scene.magnets, scene.earth)


@lru_cache(maxsize=8)
def _bodies(magnets: tuple[SourceSpec, ...], earth: EarthFieldSpec) -> Bodies:
    """What is magnetised, ready to be evaluated."""
    points = [source for source in magnets if source.shape == "point"]
    return Bodies(
        [source.body(earth.b_world_nt) for source in magnets if source.shape != "point"],
        [source.p_world for source in points],
        [source.m_world for source in points],
    )


def platform_field_nt(
    platform: PlatformFieldSpec,
    b_body: ArrayLike,
    *,
    b_rate: ArrayLike,
    wheel_rate: ArrayLike,
    lidar_on: ArrayLike,
    battery_a: ArrayLike,
) -> Array:
    """The whole field at the magnetometer, the robot's own part included.

    B = (1 + S) b + h + E db/dt + m_l w_l + m_r w_r + l on + c i: induced, permanent and eddy parts
    after Tolles and Lawson (1950), then the motors, the LiDAR's supply and the battery's current.

    Args:
        platform: S, h, E, m_l, m_r, l and c.
        b_body: Ambient field b in base_link axes [nT], shape (N, 3).
        b_rate: Its rate of change in base_link axes, turning of the robot included [nT/s], shape (N, 3).
        wheel_rate: Rates w of the left and right wheel [rad/s], shape (N, 2).
        lidar_on: Whether the LiDAR spins, shape (N,).
        battery_a: Supply current above that at full charge i [A], shape (N,); see `excess_current_a`.

    Returns:
        Field in base_link axes [nT], shape (N, 3).
    """
    b, rate = np.asarray(b_body, float), np.asarray(b_rate, float)
    wheels, on = np.asarray(wheel_rate, float), np.asarray(lidar_on, float)
    motors = np.array([platform.left_motor_nt_s, platform.right_motor_nt_s])
    supply = on[..., None] * platform.lidar_nt + np.asarray(battery_a, float)[..., None] * platform.battery_nt
    return (
        b
        + b @ np.reshape(platform.soft_iron, (3, 3)).T
        + platform.hard_iron_nt
        + rate @ np.reshape(platform.eddy_s, (3, 3)).T
        + wheels @ motors
        + supply
    )


def excess_current_a(battery: BatterySpec, voltage_v: ArrayLike) -> Array:
    """Supply current above that at full charge, for a load of constant power: P / U - P / U_full.

    Args:
        battery: The pack and its load.
        voltage_v: Voltage U [V], any shape.

    Returns:
        Current [A], the same shape.
    """
    return battery.load_w / np.asarray(voltage_v, float) - battery.load_w / battery.voltage_full_v
