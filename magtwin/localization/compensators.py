"""Compensators: models of the robot's own field; its iron, fitted to a calibration drive, is one."""

import itertools
import math
from pathlib import Path

import numpy as np

from magtwin.errors import InputError
from magtwin.frames import yaw_from_quat
from magtwin.localization.problem import Array, FieldBelief
from magtwin.run.run import Column, Run, numbers_in
from magtwin.run.thinning import field_known

COMPENSATORS = ("none", "iron")
"""Names of compensators; the weights of a trained network can take their place."""

WEIGHTS = (".safetensors", ".pth")
"""Suffixes of a trained network's weights."""

DISTURBANCE_COLUMNS = {
    "disturbance_nt": Column("nT", "", "the robot's own field as predicted by a compensator"),
    "disturbance_sd_nt": Column("nT", "", "standard deviation of that prediction"),
}
"""Columns of a prediction."""

TIMES_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Correlation times of the errors that are tried [s]."""

SHARES = (0.5, 0.8, 0.9, 0.95, 0.98)
"""Shares of correlated errors in their variance that are tried."""

MOST_ROWS, LEAST_ROWS = 400, 9
"""Most readings of a fit, evenly from the drive, as errors are alike at neighbouring ones; and the least."""


def is_weights(compensator: str) -> bool:
    """Whether a compensator is given by a file of weights, not by name."""
    return Path(compensator).suffix.lower() in WEIGHTS


def with_iron(run: Run, calibration: Run, field: FieldBelief) -> Run:
    """A run with the columns `disturbance_nt` and `disturbance_sd_nt`, of its hard iron.

        d = o + c cos(yaw) + s sin(yaw),  fitted to measured minus map on a drive with true poses

    by generalised least squares: the errors are white noise and a first-order Gauss-Markov process, whose
    variances and correlation time maximise the restricted likelihood (Patterson and Thompson 1971, Biometrika
    58:545). The standard deviation of d is that of the coefficients; the errors of the readings themselves
    are part of the `SensorModel`. The heading is that of the IMU, whose zero must be the same in both: the
    odometry has another zero at each start. Without a heading, d is its mean over the drive.

    Args:
        run: A run with the column `imu_q_xyzw`.
        calibration: A drive of the same session with the columns `p_world_base`, `yaw`, `imu_q_xyzw` and
            `b_measured_nt`. Its metadata `sensor_m` have the position of the magnetometer in base_link.
        field: The map.

    Raises:
        InputError: A column is missing, or the drive has too few readings at known field.
    """
    for name in ("p_world_base", "yaw", "imu_q_xyzw"):
        if name not in calibration:
            raise InputError(f"the calibration drive has no column {name!r}, which the compensator needs")
    if "imu_q_xyzw" not in run:
        raise InputError("the run has no column 'imu_q_xyzw', which the compensator needs")
    misfit = np.where(field_known(calibration), calibration["b_measured_nt"], np.nan)
    misfit = misfit - _field_along(calibration, field)
    matrix = _turning(calibration)
    rows = np.flatnonzero(np.isfinite(misfit) & np.isfinite(matrix).all(axis=1))
    rows = rows[:: -(-len(rows) // MOST_ROWS) or 1]
    if len(rows) < LEAST_ROWS:
        raise InputError(
            f"the calibration drive has {len(rows)} readings with signals and map, the compensator needs "
            f"{LEAST_ROWS}"
        )
    t, matrix, misfit = calibration["t"][rows], matrix[rows], misfit[rows]
    mean, scale = matrix.mean(axis=0), matrix.std(axis=0)
    scale[scale <= 1e-9 * (np.abs(mean) + 1e-300)] = np.inf  # a constant gets no coefficient
    design = np.column_stack([np.ones(len(misfit)), (matrix - mean) / scale])
    whitening, variance = _whitening(t, design, misfit)
    white = whitening @ design
    gram = white.T @ white
    coefficients = np.linalg.lstsq(gram, white.T @ (whitening @ misfit), rcond=1e-12)[0]
    inverse = np.linalg.pinv(gram, rcond=1e-12)
    covariance = variance * inverse @ gram @ inverse
    spread = float(np.std(design[:, 1:] @ coefficients[1:]))

    turning = (_turning(run) - mean) / scale
    known = np.isfinite(turning).all(axis=1)
    row = np.column_stack([np.ones(run.rows), np.where(known[:, None], turning, 0.0)])
    squares = np.maximum(np.einsum("ni,ij,nj->n", row, covariance, row), 0.0)
    added = run.with_columns(
        disturbance_nt=np.einsum("ni,i->n", row, coefficients),
        disturbance_sd_nt=np.sqrt(np.where(known, squares, squares + spread**2)),
    )
    return added.with_specs(**DISTURBANCE_COLUMNS)


def _turning(run: Run) -> Array:
    """Cosine and sine of the IMU's heading, shape (N, 2)."""
    yaw = yaw_from_quat(run["imu_q_xyzw"])
    return np.column_stack([np.cos(yaw), np.sin(yaw)])


def _field_along(run: Run, field: FieldBelief) -> Array:
    """The map at the sensor along the true poses of a run [nT]."""
    yaw = run["yaw"]
    lx, ly, _ = numbers_in(run.metadata, "sensor_m", 3) or (0.0, 0.0, 0.0)
    c, s = np.cos(yaw), np.sin(yaw)
    p = run["p_world_base"][:, :2] + np.column_stack([c * lx - s * ly, s * lx + c * ly])
    return np.asarray(field.mean(p, yaw), float)


def _whitening(t: Array, design: Array, y: Array) -> tuple[Array, float]:
    """Matrix that whitens the errors of a linear model, and the variance of what it makes of them.

    The correlation of the errors is (1 - r) I + r exp(-|t - t'| / tau); r and tau maximise

        -1/2 (log |V| + log |X' V^-1 X| + (n - p) log s^2),   s^2 = e' V^-1 e / (n - p)
    """
    from scipy.linalg import solve_triangular

    n, rank = len(y), int(np.linalg.matrix_rank(design))
    apart = np.abs(t[:, None] - t)
    best: tuple[float, Array, float] | None = None
    for tau, share in ((1.0, 0.0), *itertools.product(TIMES_S, SHARES)):
        correlation = share * np.exp(-apart / tau) + (1 - share) * np.eye(n)
        root = np.linalg.cholesky(correlation)
        white = solve_triangular(root, np.column_stack([design, y]), lower=True)
        x, z = white[:, :-1], white[:, -1]
        residual = z - x @ np.linalg.lstsq(x, z, rcond=1e-10)[0]
        variance = float(residual @ residual) / max(n - rank, 1) + 1e-12
        strengths = np.linalg.svd(x, compute_uv=False)[:rank]
        likelihood = -np.log(np.diag(root)).sum() - np.log(strengths).sum()
        likelihood -= 0.5 * (n - rank) * math.log(variance)
        if best is None or likelihood > best[0]:
            best = float(likelihood), np.asarray(root, float), variance
    assert best is not None
    return np.asarray(np.linalg.inv(best[1]), float), best[2]
