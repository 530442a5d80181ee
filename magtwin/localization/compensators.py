"""Compensators: models of the robot's own field from on-board signals, fitted to a calibration drive."""

import itertools
import math
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from magtwin.errors import InputError
from magtwin.extend import Registry
from magtwin.frames import yaw_from_quat
from magtwin.localization.problem import Array, Compensator, FieldBelief, Reading
from magtwin.localization.readings import readings_of
from magtwin.run.run import Column, Run, numbers_in
from magtwin.run.thinning import field_known

COMPENSATORS: Registry[Any] = Registry(
    "compensator",
    "compensators",
    {
        "none": "magtwin.localization.compensators:Uncompensated",
        "iron": "magtwin.localization.compensators:Iron",
        "ridge": "magtwin.localization.compensators:Ridge",
        "tolles-lawson": "magtwin.localization.compensators:TollesLawson",
    },
)
"""Classes of compensators by name."""

compensator = COMPENSATORS.register
"""Decorator that gives a class a name."""

WEIGHTS = (".safetensors", ".pth")
"""Suffixes of a trained network's weights, which can take the place of a compensator's name."""

DISTURBANCE_COLUMNS = {
    "disturbance_nt": Column("nT", "", "the robot's own field as predicted by a compensator"),
    "disturbance_sd_nt": Column("nT", "", "standard deviation of that prediction"),
}
"""Columns that `compensated` adds."""

PENALTIES = np.logspace(-8, 1, 19)
"""Ridge penalties of the cross-validation, for columns of unit mean square."""

TIMES_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
"""Correlation times of the errors that are tried [s]."""

SHARES = (0.5, 0.8, 0.9, 0.95, 0.98)
"""Shares of correlated errors in their variance that are tried."""

MOST_ROWS = 400
"""Most readings of a fit, evenly from the drive: errors are alike at neighbouring ones."""

FOLDS = 8
"""Stretches of the drive for the cross-validation."""


class Uncompensated:
    """No compensation: the disturbance is 0."""

    def fit(self, run: Run, field: FieldBelief) -> Self:
        """Nothing to learn."""
        return self

    def step(self, reading: Reading) -> tuple[float, float]:
        """0 and 0."""
        return 0.0, 0.0


class Linear:
    """A disturbance that is linear in functions of the on-board signals, plus an offset.

        d = c_0 + sum_i c_i f_i,  fitted to measured minus map on a drive with true poses

    by generalised least squares: the errors are white noise and a first-order Gauss-Markov process, whose
    variances and correlation time maximise the restricted likelihood (Patterson and Thompson 1971, Biometrika
    58:545). Coefficients of standardised f_i are shrunk with the penalty of the best prediction of each of
    eight stretches of the drive from the others. The standard deviation of d is that of the coefficients.
    The errors of the readings themselves are part of the `SensorModel`.
    """

    needs: ClassVar[tuple[str, ...]] = ()
    """Columns of the signals."""

    shrunk: ClassVar[bool] = True
    """Whether coefficients are shrunk; else ordinary least squares."""

    def __init__(self) -> None:
        self.coefficients: Array | None = None
        """Offset and coefficients [nT per unit of the standardised signals], shape (1 + F,)."""

        self._last: Reading | None = None

    def features(self, reading: Reading, last: Reading | None) -> list[float]:
        """The f_i of a reading; nan if a signal is missing."""
        raise NotImplementedError

    def fit(self, run: Run, field: FieldBelief) -> Self:
        """Fit the coefficients.

        Args:
            run: A drive with the columns `p_world_base` and `yaw`, and the signals of the compensator. Its
                metadata `sensor_m` have the position of the magnetometer in base_link.
            field: The map.

        Raises:
            InputError: A column is missing, or the drive has too few readings at known field.
        """
        for name in ("p_world_base", "yaw", *self.needs):
            if name not in run:
                raise InputError(f"the calibration drive has no column {name!r}, which the compensator needs")
        misfit = np.where(field_known(run), run["b_measured_nt"], np.nan) - _field_along(run, field)
        rows, last = [], None
        for reading in readings_of(run):
            rows.append(self.features(reading, last))
            last = reading
        matrix = np.array(rows, float)
        known = np.isfinite(misfit) & np.isfinite(matrix).all(axis=1)
        rows_used = np.flatnonzero(known)
        rows_used = rows_used[:: -(-len(rows_used) // MOST_ROWS) or 1]
        t, matrix, misfit = run["t"][rows_used], matrix[rows_used], misfit[rows_used]
        least = 3 * (matrix.shape[1] + 1)
        if len(misfit) < least:
            raise InputError(
                f"the calibration drive has {len(misfit)} readings with signals and map, the compensator "
                f"needs {least}"
            )
        self.mean, self.scale = matrix.mean(axis=0), matrix.std(axis=0)
        self.scale[self.scale <= 1e-9 * (np.abs(self.mean) + 1e-300)] = (
            np.inf
        )  # a constant gets no coefficient
        design = np.column_stack([np.ones(len(misfit)), (matrix - self.mean) / self.scale])
        penalty = _best_penalty(design, misfit) if self.shrunk else 0.0
        whitening, variance = _whitening(t, design, misfit)
        design_w, misfit_w = whitening @ design, whitening @ misfit
        self.coefficients = _ridge(design_w, misfit_w, penalty)
        gram = design_w.T @ design_w
        inverse = np.linalg.pinv(gram + _shrinkage(gram, penalty), rcond=1e-12)
        self.covariance: Array = variance * inverse @ gram @ inverse
        self.spread_nt = float(np.std(design[:, 1:] @ self.coefficients[1:]))
        return self

    def step(self, reading: Reading) -> tuple[float, float]:
        """The disturbance and its standard deviation [nT]; the mean and the spread where a signal is missing.

        Raises:
            InputError: The compensator was not fitted.
        """
        if self.coefficients is None:
            raise InputError(f"{type(self).__name__} was not fitted; call `fit` with a calibration drive")
        features = np.array(self.features(reading, self._last), float)
        self._last = reading
        if not np.isfinite(features).all():
            return float(self.coefficients[0]), math.hypot(self.spread_nt, math.sqrt(self.covariance[0, 0]))
        row = np.concatenate([[1.0], (features - self.mean) / self.scale])
        return float(row @ self.coefficients), math.sqrt(max(float(row @ self.covariance @ row), 0.0))


class Iron(Linear):
    """Hard iron and the part of soft iron that turns with the robot: offset + c cos(yaw) + s sin(yaw).

    The heading is that of the IMU, whose zero must be the same in the calibration drive and in the run.
    Odometry has another zero at each start.
    """

    needs = ("imu_q_xyzw",)
    shrunk = False

    def features(self, reading: Reading, last: Reading | None) -> list[float]:
        """Cosine and sine of the heading."""
        yaw = _heading(reading)
        return [math.cos(yaw), math.sin(yaw)]


class Ridge(Linear):
    """Heading, twice the heading, speeds, acceleration of the turn, battery current and LiDAR motor."""

    needs = ("imu_q_xyzw",)
    signals: ClassVar[tuple[str, ...]] = ("v_cmd", "odom_w", "battery_a", "lidar_on")

    def features(self, reading: Reading, last: Reading | None) -> list[float]:
        """Functions of the heading, and the signals that the drive has; 0 for those that it lacks."""
        yaw = _heading(reading)
        made = [math.cos(yaw), math.sin(yaw), math.cos(2 * yaw), math.sin(2 * yaw)]
        made += [float(np.ravel(reading.signals.get(name, 0.0))[0]) for name in self.signals]
        dt = reading.t - last.t if last is not None else 0.0
        turn = reading.odometry[2] - last.odometry[2] if last is not None else 0.0
        return [*made, turn / dt if dt > 0 else 0.0]


class TollesLawson(Linear):
    """Permanent, induced and eddy terms of a vector magnetometer (Tolles and Lawson 1950; Leliak 1961).

        d = sum p_i u_i + |B| sum a_ij u_i u_j + |B| sum e_ij u_i du_j/dt

    with the direction u of the vector reading. Since u has length 1, the terms u_z u_z and u_z du_z/dt follow
    from the others and are left out. The field is known, so that no band-pass is needed; derivatives are
    backward differences.
    """

    needs = ("b_vector_measured_nt",)

    def features(self, reading: Reading, last: Reading | None) -> list[float]:
        """3 permanent, 5 induced and 8 eddy terms."""
        b, u = _direction(reading)
        rate = np.zeros(3)
        if last is not None and reading.t > last.t:
            rate = (u - _direction(last)[1]) / (reading.t - last.t)
        induced = b * np.array([u[0] * u[0], u[0] * u[1], u[0] * u[2], u[1] * u[1], u[1] * u[2]])
        return [*u.tolist(), *induced.tolist(), *(b * np.outer(u, rate).ravel()[:8]).tolist()]


def is_weights(compensator: str) -> bool:
    """Whether a compensator is given by a file of weights, not by name."""
    return Path(compensator).suffix.lower() in WEIGHTS


def compensated(run: Run, fitted: Compensator) -> Run:
    """A run with the columns `disturbance_nt` and `disturbance_sd_nt`, predicted from its on-board columns.

    Args:
        run: A run.
        fitted: A fitted compensator. It gets a reading per row, as a localizer does.
    """
    made = np.array([fitted.step(reading) for reading in readings_of(run)], float).reshape(-1, 2)
    added = run.with_columns(disturbance_nt=made[:, 0], disturbance_sd_nt=made[:, 1])
    return added.with_specs(**DISTURBANCE_COLUMNS)


def _field_along(run: Run, field: FieldBelief) -> Array:
    """The map at the sensor along the true poses of a run [nT]."""
    yaw = run["yaw"]
    lx, ly, _ = numbers_in(run.metadata, "sensor_m", 3) or (0.0, 0.0, 0.0)
    c, s = np.cos(yaw), np.sin(yaw)
    p = run["p_world_base"][:, :2] + np.column_stack([c * lx - s * ly, s * lx + c * ly])
    return np.asarray(field.mean(p, yaw), float)


def _heading(reading: Reading) -> float:
    """Heading of the IMU; nan if it is missing."""
    quaternion = reading.signals.get("imu_q_xyzw")
    return math.nan if quaternion is None else float(yaw_from_quat(np.asarray(quaternion, float)))


def _direction(reading: Reading) -> tuple[float, Array]:
    vector = np.asarray(reading.signals.get("b_vector_measured_nt", np.full(3, np.nan)), float)
    b = float(np.linalg.norm(vector))
    return b, vector / b if b > 0 else np.full(3, np.nan)


def _shrinkage(gram: Array, penalty: float) -> Array:
    """Penalty relative to the mean squares of all columns but the first."""
    shrink = penalty * np.diag(gram).copy()
    shrink[0] = 0.0
    return np.diag(shrink)


def _ridge(design: Array, y: Array, penalty: float) -> Array:
    """Least squares with a penalty on all coefficients but the first."""
    gram = design.T @ design
    return np.asarray(np.linalg.lstsq(gram + _shrinkage(gram, penalty), design.T @ y, rcond=1e-12)[0], float)


def _best_penalty(design: Array, y: Array) -> float:
    """The penalty that best predicts each stretch of the drive from the others."""
    stretches = np.array_split(np.arange(len(y)), FOLDS)
    errors = np.zeros(len(PENALTIES))
    for stretch in stretches:
        rest = np.setdiff1d(np.arange(len(y)), stretch)
        for k, penalty in enumerate(PENALTIES):
            c = _ridge(design[rest], y[rest], penalty)
            errors[k] += np.sum((y[stretch] - design[stretch] @ c) ** 2)
    return float(PENALTIES[np.argmin(errors)])


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
