"""Tolles-Lawson compensation: the platform's field as a linear model of its attitude, fitted to a Run."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, find
from magtwin.files import existing
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate
from magtwin.report import Figure, Report
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
from magtwin.verdict import verdict

Array = NDArray[np.float64]

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Products of direction cosines in the induced terms, in order: xx, xy, xz, yy, yz, zz."""

TERMS: Mapping[str, int] = MappingProxyType(
    {
        "permanent": 3,
        "induced3": 3,
        "induced5": 5,
        "induced6": 6,
        "eddy3": 3,
        "eddy8": 8,
        "eddy9": 9,
        "bias": 1,
    }
)
"""Columns of each term. Of six induced terms, yy goes in five and only xx, yy, zz stay in three; of nine
eddy terms, y dy/dt goes in eight and only x dx/dt, y dy/dt, z dz/dt stay in three."""

DEFAULT_TERMS = ("permanent", "induced6", "eddy9")
DEFAULT_BAND_HZ = (0.1, 0.9)
"""Manoeuvres lie in this band [Hz]; the Earth's field and the map vary slower as an aircraft flies."""

Vector = Literal["measured", "exact"]
VECTORS: Mapping[str, str] = MappingProxyType({"measured": "b_vector_measured_nt", "exact": "b_vector_nt"})
"""Columns of a run that give the direction cosines: what the vector axes read, or, of a simulated run, the
field itself, which no robot knows."""

RIDGES = np.logspace(-12, 3, 31)
"""Ridge penalties that are tried, relative to the mean square of the standardised columns."""

FOLDS = 10
"""Stretches of a run that are held out in turn to choose the penalty."""


def design_matrix(
    b_vector_nt: ArrayLike, rate_hz: float, terms: Sequence[str] = DEFAULT_TERMS
) -> tuple[Array, tuple[str, ...]]:
    """The regressors of Tolles and Lawson (1950), in the form of Leliak (1961).

    With the direction cosines u = B / |B| of the total field in the platform's axes: permanent terms
    u_i, induced terms |B| u_i u_j, eddy terms |B| u_i du_j/dt, and a constant for the bias. Derivatives
    are central differences.

    Args:
        b_vector_nt: Field of a vector magnetometer in the platform's axes [nT], shape (N, 3).
        rate_hz: Readings a second [Hz].
        terms: Names of `TERMS`, in the order in which their columns are wanted.

    Returns:
        Matrix of shape (N, K), and the K columns' names. Its coefficients are in nT for permanent terms
        and the bias, without unit for induced ones, in s for eddy ones.

    Raises:
        InputError: A term is unknown or given twice, the field is not (N, 3), is nowhere or not
            finite, or there are fewer than three readings.
    """
    b = np.asarray(b_vector_nt, float)
    if b.ndim != 2 or b.shape[1] != 3 or len(b) < 3:
        raise InputError(f"b_vector_nt must have shape (N, 3) with N at least 3, got {b.shape}")
    if not 0 < rate_hz < np.inf:
        raise InputError(f"rate_hz must be above 0 Hz and finite, got {rate_hz!r}")
    size = np.linalg.norm(b, axis=1)
    if not np.all(size > 0):  # nan fails too
        row = int(np.flatnonzero(~(size > 0))[0])
        raise InputError(f"b_vector_nt must be finite and not zero, got {b[row].tolist()} in row {row}")
    kinds = [name.rstrip("0123456789") for name in terms]
    if not terms or len(set(kinds)) < len(kinds):
        raise InputError(
            f"terms must name at least one kind, and each once, got {', '.join(terms) or 'none'}"
        )
    u = b / size[:, None]
    rate = np.gradient(u, 1 / rate_hz, axis=0)
    columns: list[Array] = []
    names: list[str] = []
    for term in terms:
        width = find("Tolles-Lawson term", term, TERMS)
        if term == "permanent":
            columns.append(u)
            names += [f"permanent {a}" for a in "xyz"]
        elif term == "bias":
            columns.append(np.ones((len(b), 1)))
            names.append("bias")
        elif term.startswith("induced"):
            kept = [p for p in PAIRS if width == 6 or (p != (1, 1) if width == 5 else p[0] == p[1])]
            columns += [(size * u[:, i] * u[:, j])[:, None] for i, j in kept]
            names += [f"induced {'xyz'[i]}{'xyz'[j]}" for i, j in kept]
        else:
            grid = [(i, j) for i in range(3) for j in range(3)]
            kept = [p for p in grid if width == 9 or (p != (1, 1) if width == 8 else p[0] == p[1])]
            columns += [(size * u[:, i] * rate[:, j])[:, None] for i, j in kept]
            names += [f"eddy {'xyz'[i]}d{'xyz'[j]}" for i, j in kept]
    return np.hstack(columns), tuple(names)


@dataclass(frozen=True)
class TollesLawson:
    """A fitted compensation: what of a scalar reading the platform's attitude explains."""

    terms: tuple[str, ...]
    """Names of `TERMS`."""

    coefficients: tuple[float, ...]
    """One for each column of the design matrix; see there for their units."""

    band_hz: tuple[float, float] | None
    """Pass band of the fit [Hz]; none where it was fitted to all frequencies."""

    ridge: float
    """Penalty of the fit, relative to the mean square of the standardised columns."""

    residual_sd_nt: float
    """Standard deviation of what the fit left, in its band [nT]."""

    vector: Vector = "measured"
    """Which field of a run it was fitted to, a name of `VECTORS`; it compensates by the same."""

    def interference_nt(self, b_vector_nt: ArrayLike, rate_hz: float) -> Array:
        """What the platform adds to the magnitude, less its mean unless the terms have a bias.

        Args:
            b_vector_nt: Field of the vector magnetometer in the platform's axes [nT], shape (N, 3).
            rate_hz: Readings a second [Hz].

        Returns:
            Interference [nT], shape (N,).
        """
        matrix, _ = design_matrix(b_vector_nt, rate_hz, self.terms)
        modelled = matrix @ np.asarray(self.coefficients)
        return modelled if "bias" in self.terms else modelled - modelled.mean()

    def compensate(self, b_nt: ArrayLike, b_vector_nt: ArrayLike, rate_hz: float) -> Array:
        """Scalar readings without the platform's part [nT], shape (N,)."""
        return np.asarray(b_nt, float) - self.interference_nt(b_vector_nt, rate_hz)

    def save(self, path: Path) -> None:
        """Write the model as JSON to a file."""
        path.write_text(json.dumps({"kind": "magtwin Tolles-Lawson model", **asdict(self)}, indent=2) + "\n")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "TollesLawson":
        """The model of a file that `save` wrote.

        Raises:
            InputError: The file is missing, no JSON, or no such model.
        """
        file = existing(path, "Tolles-Lawson model")
        try:
            data = json.loads(file.read_text(encoding="utf-8"))
            model = cls(
                tuple(str(t) for t in data["terms"]),
                tuple(float(c) for c in data["coefficients"]),
                None if data["band_hz"] is None else (float(data["band_hz"][0]), float(data["band_hz"][1])),
                float(data["ridge"]),
                float(data["residual_sd_nt"]),
                data.get("vector", "measured"),
            )
            find("vector of a Tolles-Lawson model", str(model.vector), VECTORS)
        except (ValueError, KeyError, TypeError, IndexError, OSError, RecursionError) as error:
            raise InputError(
                f"{file}: not a Tolles-Lawson model as `magtwin compensate fit` writes it "
                f"({type(error).__name__}: {error})"
            ) from error
        columns = sum(find("Tolles-Lawson term", term, TERMS) for term in model.terms)
        if len(model.coefficients) != columns or not np.all(np.isfinite(model.coefficients)):
            raise InputError(
                f"{file}: {len(model.coefficients)} coefficients for {columns} columns of "
                f"{', '.join(model.terms)}; each needs one, finite"
            )
        return model

    def report(self, title: str) -> Report:
        """Terms, penalty and residual."""
        band = "all frequencies" if self.band_hz is None else f"{self.band_hz[0]:g} to {self.band_hz[1]:g} Hz"
        return Report(
            title,
            (
                Figure("coefficients", len(self.coefficients)),
                Figure("ridge", self.ridge),
                Figure("residual", self.residual_sd_nt, "nT", note=f"standard deviation, {band}"),
            ),
            {"terms": list(self.terms), "vector": VECTORS[self.vector]},
        )


def fit_tolles_lawson(
    b_nt: ArrayLike,
    b_vector_nt: ArrayLike,
    rate_hz: float,
    *,
    terms: Sequence[str] = DEFAULT_TERMS,
    band_hz: tuple[float, float] | None = DEFAULT_BAND_HZ,
    ridge: float | None = None,
) -> TollesLawson:
    """Fit the coefficients by ridge regression between band-passed readings and regressors.

    min over c of |F(b - A c)|^2 + r n |D c|^2, with F a zero-phase Butterworth filter of order 4, D the
    columns' own root mean squares, and r unless given by cross-validation over ten unbroken stretches, as
    neighbouring readings are too alike to hold single ones out.

    Args:
        b_nt: Readings of the scalar magnetometer, or what remains of them after the map [nT], shape (N,).
        b_vector_nt: Field of the vector magnetometer in the platform's axes [nT], shape (N, 3).
        rate_hz: Readings a second [Hz].
        terms: Names of `TERMS`.
        band_hz: Pass band [Hz]; None fits all frequencies.
        ridge: Penalty r; None chooses it.

    Returns:
        The model.

    Raises:
        InputError: Shapes do not fit, a value is not finite, the band does not fit the rate, a bias is
            wanted in a band, or there are fewer readings than coefficients.
    """
    b = np.asarray(b_nt, float)
    matrix, names = design_matrix(b_vector_nt, rate_hz, terms)
    if b.shape != (len(matrix),):
        raise InputError(f"b_nt must have shape ({len(matrix)},), as b_vector_nt has rows, got {b.shape}")
    if not np.all(np.isfinite(b)):
        row = int(np.flatnonzero(~np.isfinite(b))[0])
        raise InputError(f"b_nt must be finite, got {b[row]} in row {row}")
    if len(b) <= len(names):
        raise InputError(f"{len(b)} readings are too few for {len(names)} coefficients")
    if ridge is not None and not 0 <= ridge < np.inf:
        raise InputError(f"ridge must not be below 0, and finite, got {ridge!r}")
    if band_hz is not None and "bias" in terms:
        raise InputError(
            "a bias is in no pass band, so a fit to one cannot tell it; leave the bias out, or fit all "
            "frequencies (band_hz=None, --no-band)"
        )
    if band_hz is not None:
        matrix, b = (_band_pass(v, band_hz, rate_hz) for v in (matrix, b))
    elif "bias" not in terms:
        matrix, b = matrix - matrix.mean(axis=0), b - b.mean()
    size = np.sqrt(np.mean(matrix * matrix, axis=0))
    size[size <= 1e-9 * size.max()] = np.inf  # a column that never moves gets no coefficient
    scaled = matrix / size
    chosen = float(ridge) if ridge is not None else _cross_validated(scaled, b)
    c = _ridge(scaled.T @ scaled, scaled.T @ b, chosen * len(b)) / size
    return TollesLawson(tuple(terms), tuple(c.tolist()), band_hz, chosen, float(np.std(b - matrix @ c)))


def fit_run(run: Run, *, vector: Vector = "measured", **options: Any) -> TollesLawson:
    """`fit_tolles_lawson` on a run: b_measured_nt less b_map_nt, against its field vectors.

    The filter needs an unbroken series, so the longest stretch of rows with a map, a reading and a vector
    is used.

    Args:
        run: A calibration run.
        vector: "measured" takes what the vector axes read, b_vector_measured_nt, with their errors and one
            after the other; "exact" the b_vector_nt of a simulated run, which shows how much they cost.
        options: Those of `fit_tolles_lawson`.

    Raises:
        InputError: The run has no such vectors, or nowhere enough of them.
    """
    b_vector, rows, rate = _unbroken(run, vector)
    b = run["b_measured_nt"][rows] - run["b_map_nt"][rows]
    return replace(fit_tolles_lawson(b, b_vector[rows], rate, **options), vector=vector)


def compensate_run(run: Run, model: TollesLawson) -> tuple[Run, Report]:
    """A run whose b_measured_nt is free of what the model explains, and how much that was.

    Returns:
        The run, with nan in b_measured_nt where there is no vector of the kind that the model was fitted
        to; and its report.
    """
    b_vector, rows, rate = _unbroken(run, model.vector)
    interference = np.full(run.rows, np.nan)
    interference[rows] = model.interference_nt(b_vector[rows], rate)
    before = (run["b_measured_nt"] - run["b_map_nt"])[rows]
    after = before - interference[rows]
    if not before.std() > 0:
        raise InputError("b_measured_nt less b_map_nt never changes, so there is nothing to take out of it")
    removed = float(1 - after.var() / before.var())
    worse = (
        "below 0: they vary more than before, as the model was fitted to too few headings or another field"
    )
    figures = (
        Figure("readings", int(rows.stop - rows.start)),
        Figure("before", float(before.std()), "nT", note="standard deviation of measured less map"),
        Figure("after", float(after.std()), "nT", note="standard deviation, compensated"),
        Figure("variance removed", removed, "", note="share, 1 is all of it" if removed >= 0 else worse),
    )
    compensated = run.with_columns(b_measured_nt=run["b_measured_nt"] - interference)
    told = {"terms": list(model.terms), "vector": VECTORS[model.vector]}
    line = verdict(
        float(after.std()),
        float(before.std()),
        than="no compensation",
        judged_on="the spread of measured less map in this run",
    )
    metadata = {"tolles_lawson": " ".join(model.terms)}
    return compensated.with_metadata(**metadata), Report("Compensation", figures, told, line)


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
    """The platform's vector field by least squares: iron, eddy currents, its supplies, and iron that turns.

    B - b = S b + h + E db/dt + m_l T_l + m_r T_r + on (l + l_c cos a + l_s sin a) + c i + (turning iron), the
    vector form of Tolles and Lawson's model with the currents and the wheels of a robot, linear in all that
    is sought; see `magtwin.sim.interference`.

    Args:
        b_ambient_nt: Field b without the robot, in base_link axes [nT], shape (N, 3).
        b_measured_nt: Field B with it, in base_link axes [nT], shape (N, 3).
        rate_hz: Readings a second [Hz].
        motor_nm: Torques of left and right wheel [N m], shape (N, 2); without them they have no part.
        lidar_on: Whether the LiDAR is on, shape (N,); without it that has no part.
        lidar_angle: Angle of its motor [rad], shape (N,); without it only its steady field is sought.
        excess_current_a: Supply current above that at rest with a full pack [A], shape (N,); without it, no
            part.
        wheel_angle: Angles turned by left and right wheel [rad], shape (N, 2); without them no iron turns.
        robot: Where its wheels, its caster and its magnetometer are; of its platform only the caster's place
            and radius are used. Goes with `wheel_angle`.

    Returns:
        The platform's figures; moments are positive. Where the readings cannot tell two of them apart, such
        as h and S along an axis on which b never changes, the smallest that explain them.

    Raises:
        InputError: Shapes do not fit, a value is not finite, or there are wheel angles and no robot.
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
    found, moments = _least_squares(matrix, iron, measured - ambient)
    row = lambda k: tuple(found[k].tolist())  # noqa: E731
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
        soft_iron=tuple(found[0:3].T.ravel().tolist()),  # type: ignore[arg-type]
        hard_iron_nt=row(3),
        eddy_s=tuple(found[4:7].T.ravel().tolist()),  # type: ignore[arg-type]
        left_motor_nt_nm=row(7),
        right_motor_nt_nm=row(8),
        lidar_nt=row(9),
        lidar_cos_nt=row(10),
        lidar_sin_nt=row(11),
        battery_nt=row(12),
        **wheels,
    )


IRON = ("left_wheel", "right_wheel", "caster")
"""What turns, by the names of its figures in a PlatformFieldSpec."""


def _turning_iron(wheel_angle: Array, robot: RobotSpec | None) -> Array:
    """Field of unit moments, up and forwards at the start, in each of `IRON` [nT], shape (N, 3, 6)."""
    if robot is None:
        raise InputError("wheel_angle needs the robot, which says where its wheels are")
    unit = {f"{name}_{what}": 0.0 for name in IRON for what in ("moment", "phase")}
    fields = []
    for name in IRON:
        for phase in (0.0, np.pi / 2):
            platform = replace(robot.platform, **{**unit, f"{name}_moment": 1.0, f"{name}_phase": phase})  # type: ignore[arg-type]
            fields.append(turning_iron_nt(replace(robot, platform=platform), wheel_angle))
    return np.stack(fields, axis=-1)


def _least_squares(matrix: Array, iron: Array, b: Array) -> tuple[Array, Array]:
    """Coefficients (K, 3) of regressors that each axis has its own for, and (M,) of those that all share.

    min |b - A c - T m|^2: the shared ones on what the others leave, then the others.

    Args:
        matrix: A, shape (N, K).
        iron: T, shape (N, 3, M).
        b: Shape (N, 3).
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
    found = np.linalg.lstsq(scaled, b - iron @ moments, rcond=1e-10)[0] / size[:, None]
    return found, moments


def platform_of_run(run: Run, scene: Scene, *, vector: Vector = "exact") -> PlatformFieldSpec:
    """`fit_platform` on a calibration run: its field vectors, in a lab whose own field is known.

    The run should turn on the spot both ways, as a motor that pulls one way all the time cannot be told from
    iron, and have the LiDAR on for a while.

    Args:
        run: What was recorded.
        scene: The lab, and the robot that the run is of; of its platform only the caster's place is used.
        vector: "exact" takes b_vector_nt, as a magnetometer that reads its axes at once would give it;
            "measured" takes b_vector_measured_nt, whose axes are read in turn and so too slowly for what
            turns fast, such as the LiDAR's motor.

    Returns:
        The platform's figures.

    Raises:
        InputError: The run has no vectors, its readings are not evenly spaced, or the scene has no
            Earth's field.
    """
    b_vector, rows, rate = _unbroken(run, vector)
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


def _band_pass(values: Array, band_hz: tuple[float, float], rate_hz: float) -> Array:
    """Values (N, ...) through a Butterworth filter of order 4, there and back: no phase."""
    from scipy.signal import butter, sosfiltfilt  # takes half a second

    low, high = band_hz
    if not 0 < low < high < rate_hz / 2:
        raise InputError(
            f"band_hz must ascend between 0 and half the rate, {rate_hz / 2:g} Hz, got {low:g}, {high:g}"
        )
    stages = butter(4, band_hz, btype="bandpass", fs=rate_hz, output="sos")
    least = 3 * (2 * len(stages) + 1)
    if len(values) <= least:
        raise InputError(f"{len(values)} readings are too few for the band-pass, {least + 1} are needed")
    return np.asarray(sosfiltfilt(stages, values, axis=0))


def _ridge(gram: Array, along: Array, penalty: float) -> Array:
    """Minimiser of c^T G c - 2 c^T a + p |c|^2, the least one along directions that G does not see."""
    strength, axes = np.linalg.eigh(gram)
    seen = strength > 1e-13 * strength[-1]
    share = np.zeros_like(strength)
    share[seen] = 1 / (strength[seen] + penalty)
    return np.asarray(axes @ (share * (axes.T @ along)))


def _cross_validated(matrix: Array, b: Array) -> float:
    """The ridge that best predicts each of `FOLDS` stretches from the others."""
    stretches = [slice(rows[0], rows[-1] + 1) for rows in np.array_split(np.arange(len(b)), FOLDS)]
    grams = [matrix[s].T @ matrix[s] for s in stretches]
    alongs = [matrix[s].T @ b[s] for s in stretches]
    gram, along = np.sum(grams, axis=0), np.sum(alongs, axis=0)
    errors = np.zeros(len(RIDGES))
    for stretch, own, own_along in zip(stretches, grams, alongs, strict=True):
        left = len(b) - (stretch.stop - stretch.start)
        for k, ridge in enumerate(RIDGES):
            c = _ridge(gram - own, along - own_along, ridge * left)
            errors[k] += np.sum((b[stretch] - matrix[stretch] @ c) ** 2)
    return float(RIDGES[np.argmin(errors)])


def _unbroken(run: Run, vector: str) -> tuple[Array, slice, float]:
    """Field vectors (N, 3) of a run, its longest stretch of rows with a map, a reading and such a vector,
    and the rate [Hz].
    """
    name = find("vector", vector, VECTORS)
    b_vector = run[name] if name in run else np.full((run.rows, 3), np.nan)
    if not np.isfinite(b_vector).any():
        other = next(o for o in VECTORS if o != vector)
        there = VECTORS[other] in run and np.isfinite(run[VECTORS[other]]).any()
        do = (
            f'ask for the {other} ones of {VECTORS[other]} (vector="{other}")'
            if there
            else "record a vector magnetometer, or simulate a scene whose Earth field is known"
        )
        raise InputError(f"the run has no field vectors in {name}, which direction cosines need; {do}")
    fine = np.isfinite(run["b_measured_nt"] - run["b_map_nt"]) & np.isfinite(b_vector).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], fine.astype(np.int8), [0]])))
    starts, stops = edges[::2], edges[1::2]
    k = int(np.argmax(stops - starts))
    rows = slice(int(starts[k]), int(stops[k]))
    t = run["t"][rows]
    if len(t) < 3:
        raise InputError(f"only {len(t)} readings in a row have a map and a vector; a fit needs more")
    step = float(np.median(np.diff(t)))
    if not step > 0 or np.abs(np.diff(t) - step).max() > 0.5 * step:
        raise InputError("the run's readings are not evenly spaced in time; resample it first")
    return b_vector, rows, 1 / step
