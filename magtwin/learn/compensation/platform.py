"""Fit of a platform's vector field: iron, eddy currents, motors, LiDAR, battery and turning iron."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate
from magtwin.learn.compensation.tolles_lawson import Vector, unbroken
from magtwin.run.run import Run
from magtwin.sim.interference import (
    TORQUE_S,
    ambient_field_nt,
    lidar_angle,
    rest_current_a,
    sensor_places,
    turning_iron_nt,
    wheel_torques_nm,
)
from magtwin.sim.motion.drive import wheel_rates
from magtwin.spec.magnetics import PlatformFieldSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.scene import Scene

Array = NDArray[np.float64]


def fit_platform(
    b_ambient_nt: ArrayLike,
    b_measured_nt: ArrayLike,
    rate_hz: float,
    *,
    motor_nm: ArrayLike | None = None,
    lidar_on: ArrayLike | None = None,
    lidar_angle: ArrayLike | None = None,
    excess_current_a: ArrayLike | None = None,
    wheel_angle: ArrayLike | None = None,
    robot: RobotSpec | None = None,
) -> PlatformFieldSpec:
    """Fit the platform's vector field by least squares: iron, eddy currents, currents, and turning iron.

    B - b = S b + h + E db/dt + m_l T_l + m_r T_r + on (l + l_c cos a + l_s sin a) + c i + (turning iron), the
    vector form of Tolles and Lawson's model with the currents and wheels of a robot, linear in all
    parameters; see `magtwin.sim.interference`.

    Args:
        b_ambient_nt: Field b without the robot, in base_link axes [nT], shape (N, 3).
        b_measured_nt: Field B with it, in base_link axes [nT], shape (N, 3).
        rate_hz: Readings a second [Hz].
        motor_nm: Torques of left and right wheel [N m], shape (N, 2). None: no motor terms.
        lidar_on: Whether the LiDAR is on, shape (N,). None: no LiDAR terms.
        lidar_angle: Angle of its motor [rad], shape (N,). None: only its steady field is fitted.
        excess_current_a: Supply current above that at rest with a full pack [A], shape (N,). None: no term.
        wheel_angle: Angles of left and right wheel [rad], shape (N, 2). None: no turning iron.
        robot: Robot with the places of wheels, caster and magnetometer, for `wheel_angle`; of its platform
            only the caster's place and radius are used.

    Returns:
        The fitted platform; moments are positive. Parameters that the readings cannot separate, such as h and
        S along an axis on which b is constant, get the smallest values that explain the readings.

    Raises:
        InputError: Shapes do not fit, a value is not finite, or `wheel_angle` comes without a robot.
    """
    ambient, measured = np.asarray(b_ambient_nt, float), np.asarray(b_measured_nt, float)
    n = len(ambient)
    if ambient.shape != (n, 3) or measured.shape != (n, 3) or n < 3:
        raise InputError(
            f"b_ambient_nt and b_measured_nt must have one shape (N, 3), N at least 3, got {ambient.shape} "
            f"and {measured.shape}"
        )
    given = {
        "motor_nm": (motor_nm, 2),
        "lidar_on": (lidar_on, 1),
        "lidar_angle": (lidar_angle, 1),
        "excess_current_a": (excess_current_a, 1),
        "wheel_angle": (wheel_angle, 2),
    }
    part: dict[str, Array] = {}
    for name, (values, width) in given.items():
        part[name] = np.zeros((n, width)) if values is None else np.asarray(values, float).reshape(-1, width)
        if len(part[name]) != n:
            raise InputError(f"{name} must have {n} rows, got {len(part[name])}")
    on, angle = part["lidar_on"], part["lidar_angle"]
    turning = on * np.hstack([np.cos(angle), np.sin(angle)]) * (lidar_angle is not None)
    matrix = np.hstack(
        [
            ambient,
            np.ones((n, 1)),
            np.gradient(ambient, 1 / rate_hz, axis=0),
            part["motor_nm"],
            on,
            turning,
            part["excess_current_a"],
        ]
    )
    iron = np.zeros((n, 3, 0)) if wheel_angle is None else _turning_iron(part["wheel_angle"], robot)
    if not all(np.all(np.isfinite(values)) for values in (matrix, iron, measured)):
        raise InputError("every field and signal that a platform is fitted to must be finite")
    solution, moments = _least_squares(matrix, iron, measured - ambient)
    row = lambda k: tuple(solution[k].tolist())  # noqa: E731
    wheels: dict[str, Any] = {}
    if robot is not None and wheel_angle is not None:
        up, forwards = moments.reshape(3, 2).T
        wheels = {f"{name}_moment": float(m) for name, m in zip(IRON, np.hypot(up, forwards), strict=True)}
        phases = np.arctan2(forwards, up) % (2 * np.pi)
        wheels |= {f"{name}_phase": float(phase) for name, phase in zip(IRON, phases, strict=True)}
        wheels |= {
            "p_base_caster": robot.platform.p_base_caster,
            "caster_radius_m": robot.platform.caster_radius_m,
        }
    return PlatformFieldSpec(
        soft_iron=tuple(solution[0:3].T.ravel().tolist()),  # type: ignore[arg-type]
        hard_iron_nt=row(3),
        eddy_s=tuple(solution[4:7].T.ravel().tolist()),  # type: ignore[arg-type]
        left_motor_nt_nm=row(7),
        right_motor_nt_nm=row(8),
        lidar_nt=row(9),
        lidar_cos_nt=row(10),
        lidar_sin_nt=row(11),
        battery_nt=row(12),
        **wheels,
    )


IRON = ("left_wheel", "right_wheel", "caster")  # Turning iron, by its names in a PlatformFieldSpec


def _turning_iron(wheel_angle: Array, robot: RobotSpec | None) -> Array:
    """Field of unit moments, up and forwards at the start, of each of `IRON` [nT], shape (N, 3, 6)."""
    if robot is None:
        raise InputError("wheel_angle needs the robot, for the places of its wheels")
    unit = {f"{name}_{what}": 0.0 for name in IRON for what in ("moment", "phase")}
    fields = []
    for name in IRON:
        for phase in (0.0, np.pi / 2):
            platform = replace(robot.platform, **{**unit, f"{name}_moment": 1.0, f"{name}_phase": phase})  # type: ignore[arg-type]
            fields.append(turning_iron_nt(replace(robot, platform=platform), wheel_angle))
    return np.stack(fields, axis=-1)


def _least_squares(matrix: Array, iron: Array, b: Array) -> tuple[Array, Array]:
    """Coefficients (K, 3) of regressors per axis, and (M,) of regressors common to all axes.

    min |b - A c - T m|^2, A (N, K), T (N, 3, M), b (N, 3): first m on the residual of A, then c.
    """
    size = np.linalg.norm(matrix, axis=0)
    size[size == 0] = 1.0
    scaled = matrix / size
    left, strength, _ = np.linalg.svd(scaled, full_matrices=False)
    basis = left[:, strength > 1e-10 * strength[0]]
    moments = np.zeros(iron.shape[2])
    if iron.size:
        rest = [
            x - np.einsum("nk,k...->n...", basis, np.einsum("nk,n...->k...", basis, x)) for x in (iron, b)
        ]
        moments = np.linalg.lstsq(rest[0].reshape(-1, iron.shape[2]), rest[1].ravel(), rcond=1e-10)[0]
    solution = np.linalg.lstsq(scaled, b - iron @ moments, rcond=1e-10)[0] / size[:, None]
    return solution, moments


def platform_of_run(run: Run, scene: Scene, *, vector: Vector = "exact") -> PlatformFieldSpec:
    """`fit_platform` on a calibration run in a lab whose field is known.

    The run should turn on the spot in both directions, because a motor that always pulls in one direction
    looks like iron, and have the LiDAR on for a while.

    Args:
        run: The recording.
        scene: The lab, and the robot of the run; of its platform only the caster's place is used.
        vector: "exact" uses b_vector_nt, which a magnetometer that reads its axes at once would give;
            "measured" uses b_vector_measured_nt, whose axes are read in turn, too slowly for the LiDAR's
            motor.

    Raises:
        InputError: The run has no vectors, its readings are not evenly spaced, or the scene has no Earth
            field.
    """
    b_vector, rows, rate = unbroken(run, vector)
    robot = scene.robot
    wheels = wheel_rates(run["v_base"][rows, 0], run["w_base"][rows, 2], robot.drive)
    late = max(1, round(TORQUE_S * rate))
    gained = (wheels[late:] - wheels[:-late]) * (rate / late)
    rows, wheels = slice(rows.start + late, rows.stop), wheels[late:]
    t, yaw = run["t"][rows], run["yaw"][rows]
    p_world = sensor_places(robot, np.column_stack([run["p_world_base"][rows, :2], yaw]))
    ambient = rotate(quat_conjugate(quat_from_yaw(yaw)), ambient_field_nt(scene, p_world))
    return fit_platform(
        ambient,
        rotate(np.array(robot.q_base_magnetometer_xyzw), b_vector[rows]),
        rate,
        motor_nm=wheel_torques_nm(robot.battery, robot.drive, wheels, gained),
        lidar_on=run["lidar_on"][rows],
        lidar_angle=lidar_angle(replace(robot, platform=PlatformFieldSpec()), t),
        excess_current_a=run["battery_a"][rows] - rest_current_a(robot.battery),
        wheel_angle=run["wheel_angle"][rows],
        robot=robot,
    )
