"""Tolles-Lawson compensation: the platform's part of scalar readings, linear in functions of its attitude."""

import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError, find
from magtwin.files.file import read_text
from magtwin.report.report import Figure, Report
from magtwin.report.verdict import Z_90, verdict
from magtwin.run.run import Run
from magtwin.run.thinning import stretches

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
        "current": 3,
        "bias": 1,
    }
)
"""Number of columns of each term. induced5 drops yy and induced3 keeps xx, yy, zz; eddy8 drops y dy/dt and
eddy3 keeps x dx/dt, y dy/dt, z dz/dt. "current" is the field of the battery's current. The preset "magnav"
drops zz and z dz/dt instead."""

DEFAULT_TERMS = ("permanent", "induced6", "eddy9")
DEFAULT_BAND_HZ = (0.1, 0.9)
"""Band of an aircraft's manoeuvres [Hz]; the Earth's field and the map vary more slowly."""

Preset = Literal["magtwin", "magnav"]
PRESETS = ("magtwin", "magnav")
"""Conventions of regressors, filter and fit. "magnav" follows `create_TL_A` and `create_TL_coef` of MagNav.jl
(Gnadt et al. 2022)."""

MAGNAV_SCALE_NT = 50_000.0
"""Field that MagNav.jl divides induced and eddy terms by [nT]."""

MAGNAV_PADDING, MAGNAV_TRIM = 24, 20
"""Samples by which it extends signals at each end of the filter, and filtered samples that it discards."""

VECTOR = "b_vector_measured_nt"
"""Column of a run for the direction cosines: the reading of the vector axes."""

RIDGES = np.logspace(-12, 3, 31)
"""Ridge penalties of the cross-validation, relative to the mean square of the standardised columns."""

LEAST_OWN = 1e-6
"""Share of a column that no other columns explain, below which its coefficient is not determined."""

MOST_DELAY_S = 0.5
"""Longest delay of the battery's current that is tried [s]."""

NT_PER_GAUSS = 1e5

FOLDS = 10  # Number of stretches of a run for the cross-validation


def design_matrix(
    b_vector_nt: ArrayLike,
    rate_hz: float,
    terms: Sequence[str] = DEFAULT_TERMS,
    *,
    preset: str = "magtwin",
    current_a: ArrayLike | None = None,
) -> tuple[Array, tuple[str, ...]]:
    """The regressors of Tolles and Lawson (1950), in the form of Leliak (1961).

    With the direction cosines u = B / |B| of the total field in the platform's axes: permanent terms
    u_i, induced terms |B| u_i u_j, eddy terms |B| u_i du_j/dt, current terms I u_i, and a constant for the
    bias. Derivatives are central differences.

    Args:
        b_vector_nt: Field of a vector magnetometer in the platform's axes [nT], shape (N, 3).
        rate_hz: Readings a second [Hz].
        terms: Names of `TERMS`, in the order of the columns.
        preset: A name of `PRESETS`. With "magnav", induced terms are u_i B_j / 50,000 nT and eddy terms
            u_i dB_j / 50,000 nT, with the difference dB of B per sample.
        current_a: Current I of the battery, for "current" [A], shape (N,).

    Returns:
        Matrix of shape (N, K), and the names of the K columns. Coefficients are in nT for permanent terms and
        the bias, in nT/A for current terms, without unit for induced terms, and in s for eddy terms; with
        "magnav" all but the current's are in nT.

    Raises:
        InputError: A term is unknown or given twice, or the field is not (N, 3), zero, or not finite.
    """
    magnav, b = _is_magnav(preset), np.asarray(b_vector_nt, float)
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
    rate = np.gradient(b, axis=0) if magnav else np.gradient(u, 1 / rate_hz, axis=0)
    induced, eddy, dropped = size, size, (1, 1)
    if magnav:
        induced, eddy, dropped = size / MAGNAV_SCALE_NT, np.ones_like(size) / MAGNAV_SCALE_NT, (2, 2)
    columns: list[Array] = []
    names: list[str] = []
    for term in terms:
        width = find("Tolles-Lawson term", term, TERMS)
        if term == "permanent":
            columns.append(u)
            names += [f"permanent {a}" for a in "xyz"]
        elif term == "current":
            amperes = np.full(len(b), np.nan) if current_a is None else np.asarray(current_a, float)
            if amperes.shape != size.shape or not np.isfinite(amperes).all():
                raise InputError("the term current needs the battery's current at every reading (battery_a)")
            columns.append(u * amperes[:, None])
            names += [f"current {a}" for a in "xyz"]
        elif term == "bias":
            columns.append(np.ones((len(b), 1)))
            names.append("bias")
        elif term.startswith("induced"):
            kept = [p for p in PAIRS if width == 6 or (p != dropped if width == 5 else p[0] == p[1])]
            columns += [(induced * u[:, i] * u[:, j])[:, None] for i, j in kept]
            names += [f"induced {'xyz'[i]}{'xyz'[j]}" for i, j in kept]
        else:
            grid = [(i, j) for i in range(3) for j in range(3)]
            kept = [p for p in grid if width == 9 or (p != dropped if width == 8 else p[0] == p[1])]
            columns += [(eddy * u[:, i] * rate[:, j])[:, None] for i, j in kept]
            names += [f"eddy {'xyz'[i]}d{'xyz'[j]}" for i, j in kept]
    return np.hstack(columns), tuple(names)


@dataclass(frozen=True)
class TollesLawson:
    """A fitted compensation: the part of a scalar reading that the platform's attitude explains."""

    terms: tuple[str, ...]
    """Names of `TERMS`."""

    coefficients: tuple[float, ...]
    """One for each column of `design_matrix`, in its units."""

    band_hz: tuple[float, float] | None
    """Pass band of the fit [Hz]; None for all frequencies."""

    ridge: float
    """Penalty of the fit, in the units of its preset."""

    residual_sd_nt: float
    """Standard deviation of the residual, in its band [nT]."""

    preset: Preset = "magtwin"
    """Conventions of the regressors and the fit, a name of `PRESETS`."""

    sd: tuple[float, ...] = ()
    """Standard deviation of each coefficient, in its unit; infinite if the run does not determine it. () if
    unknown."""

    condition: float = math.nan
    """Condition number of the columns, each divided by its RMS."""

    delay_s: float = 0.0
    """Time by which the battery's current is late [s]."""

    def interference_nt(
        self, b_vector_nt: ArrayLike, rate_hz: float, current_a: ArrayLike | None = None
    ) -> Array:
        """Part of the magnitude from the platform [nT], shape (N,); arguments as for `design_matrix`.

        It is minus its mean, unless the terms have a bias or the preset is "magnav".
        """
        current = None if current_a is None else late(current_a, self.delay_s, rate_hz)
        matrix, _ = design_matrix(b_vector_nt, rate_hz, self.terms, preset=self.preset, current_a=current)
        modelled = matrix @ np.asarray(self.coefficients)
        kept = self.preset == "magnav" or "bias" in self.terms
        return modelled if kept else modelled - modelled.mean()

    def compensate(self, b_nt: ArrayLike, b_vector_nt: ArrayLike, rate_hz: float) -> Array:
        """Scalar readings without the platform's part [nT], shape (N,)."""
        return np.asarray(b_nt, float) - self.interference_nt(b_vector_nt, rate_hz)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the coefficients."""
        current = np.ones(3) if "current" in self.terms else None
        return design_matrix(np.eye(3), 1.0, self.terms, preset=self.preset, current_a=current)[1]

    def parameters(self, kind: Literal["px4", "ardupilot"]) -> dict[str, float]:
        """Offsets and current terms as parameters of an autopilot, whose axes are forward, right, down.

        PX4 subtracts CAL_MAG0_OFF [G] and adds CAL_MAG0_COMP per kA; ArduPilot adds COMPASS_OFS [mG] and
        COMPASS_MOT per A. Coefficients that the run does not determine are left out.
        """
        if not self.sd:
            raise InputError("the model has no intervals of its coefficients; fit it again")
        px4, made = kind == "px4", {}
        for name, value, sd in zip(self.columns, self.coefficients, self.sd, strict=True):
            term, _, axis = name.partition(" ")
            if term in ("permanent", "current") and math.isfinite(sd):
                turned = (value if axis == "x" else -value) / NT_PER_GAUSS
                if term == "permanent":
                    key = f"CAL_MAG0_{axis.upper()}OFF" if px4 else f"COMPASS_OFS_{axis.upper()}"
                    made[key] = turned if px4 else -1e3 * turned
                else:
                    key = f"CAL_MAG0_{axis.upper()}COMP" if px4 else f"COMPASS_MOT_{axis.upper()}"
                    made[key] = -1e3 * turned
        if "current" in self.terms:
            made["CAL_MAG_COMP_TYP" if px4 else "COMPASS_MOTCT"] = 2
        return made

    def save(self, path: Path) -> None:
        """Write the model as JSON."""
        data = {**asdict(self), "sd": [value if math.isfinite(value) else None for value in self.sd]}
        data["condition"] = self.condition if math.isfinite(self.condition) else None
        path.write_text(json.dumps({"kind": "magtwin Tolles-Lawson model", **data}, indent=2) + "\n")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "TollesLawson":
        """Load the model of a file that `save` wrote.

        Raises:
            InputError: The file is missing, no JSON, or no such model.
        """
        file = Path(path)
        text = read_text(file, "Tolles-Lawson model", "JSON")
        try:
            data = json.loads(text)
            model = cls(
                tuple(str(t) for t in data["terms"]),
                tuple(float(c) for c in data["coefficients"]),
                None if data["band_hz"] is None else (float(data["band_hz"][0]), float(data["band_hz"][1])),
                float(data["ridge"]),
                float(data["residual_sd_nt"]),
                data.get("preset", "magtwin"),
                tuple(math.inf if sd is None else float(sd) for sd in data.get("sd", ())),
                float(data.get("condition") or math.nan),
                float(data.get("delay_s", 0.0)),
            )
            _is_magnav(str(model.preset))
            if data.get("vector", "measured") != "measured":
                raise ValueError(f"fitted to {data['vector']} vectors; fit it again")
        except (ValueError, KeyError, TypeError, IndexError, OSError, RecursionError) as error:
            raise InputError(
                f"{file}: not a Tolles-Lawson model as `magtwin model compensate fit` writes it "
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
        """Terms, penalty and residual, and each coefficient with its 90 % interval."""
        units = {"induced": "", "eddy": "s", "current": "nT/A"} if self.preset == "magtwin" else {}
        each = [
            Figure(name, value, units.get(name.split()[0], "nT"), Z_90 * sd, "90 % interval")
            if math.isfinite(sd)
            else Figure(name, "not determined: the drive does not excite it")
            for name, value, sd in zip(self.columns, self.coefficients, self.sd, strict=bool(self.sd))
        ]
        if "current" in self.terms:
            each.append(Figure("delay of the current", self.delay_s, "s"))
        band = "all frequencies" if self.band_hz is None else f"{self.band_hz[0]:g} to {self.band_hz[1]:g} Hz"
        return Report(
            title,
            (
                Figure("coefficients", len(self.coefficients)),
                Figure("ridge", self.ridge),
                Figure("residual", self.residual_sd_nt, "nT", note=f"standard deviation, {band}"),
                Figure("condition number", self.condition),
                *each,
            ),
            {"terms": list(self.terms), "vector": VECTOR, "preset": self.preset},
        )


def fit_tolles_lawson(
    b_nt: ArrayLike,
    b_vector_nt: ArrayLike,
    rate_hz: float,
    *,
    terms: Sequence[str] = DEFAULT_TERMS,
    band_hz: tuple[float, float] | None = DEFAULT_BAND_HZ,
    ridge: float | None = None,
    preset: Preset = "magtwin",
    current_a: ArrayLike | None = None,
) -> TollesLawson:
    """Fit the coefficients by ridge regression between band-passed readings and regressors.

    min over c of |F(b - A c)|^2 + r n |D c|^2, with F a zero-phase Butterworth filter of order 4, D the RMS
    of each column, and r by default from cross-validation over ten contiguous stretches, because neighbouring
    readings are correlated.

    With the preset "magnav" the fit is that of MagNav.jl's `create_TL_coef`: min |F(b - A c)|^2 + r |c|^2,
    with r = 0 by default, the filter's signals extended by 24 samples, and 20 filtered samples trimmed at
    each end.

    Args:
        b_nt: Readings of the scalar magnetometer, possibly minus a map [nT], shape (N,).
        b_vector_nt: Field of the vector magnetometer in the platform's axes [nT], shape (N, 3).
        rate_hz: Readings a second [Hz].
        terms: Names of `TERMS`.
        band_hz: Pass band [Hz]; None fits all frequencies.
        ridge: Penalty r. Default: by cross-validation, or 0 with "magnav".
        preset: A name of `PRESETS`.
        current_a: As for `design_matrix`.

    Raises:
        InputError: Arguments do not fit each other, a value is not finite, or readings are too few.
    """
    b, magnav = np.asarray(b_nt, float), _is_magnav(preset)
    matrix, names = design_matrix(b_vector_nt, rate_hz, terms, preset=preset, current_a=current_a)
    if b.shape != (len(matrix),):
        raise InputError(f"b_nt must have shape ({len(matrix)},), as b_vector_nt has rows, got {b.shape}")
    if not np.all(np.isfinite(b)):
        row = int(np.flatnonzero(~np.isfinite(b))[0])
        raise InputError(f"b_nt must be finite, got {b[row]} in row {row}")
    if len(b) <= len(names):
        raise InputError(f"{len(b)} readings are too few for {len(names)} coefficients")
    if ridge is not None and not 0 <= ridge < np.inf:
        raise InputError(f"ridge must not be below 0, and finite, got {ridge!r}")
    if band_hz is not None and "bias" in terms and not magnav:
        raise InputError(
            "a pass band excludes a bias, so it cannot be fitted; leave the bias out, or fit all "
            "frequencies (band_hz=None, --no-band)"
        )
    whole = matrix
    if band_hz is not None:
        matrix, b = (band_pass(v, band_hz, rate_hz, preset=preset) for v in (matrix, b))
        if len(b) <= len(names):
            raise InputError(f"{len(b)} trimmed readings are too few for {len(names)} coefficients")
    elif "bias" not in terms and not magnav:
        matrix, b = matrix - matrix.mean(axis=0), b - b.mean()
    if magnav:
        penalty = 0.0 if ridge is None else float(ridge)
        rows = np.vstack([matrix, np.sqrt(penalty) * np.eye(len(names))])
        c = np.linalg.lstsq(rows, np.concatenate([b, np.zeros(len(names))]), rcond=None)[0]
        left = b - matrix @ c
        known = _determined(matrix, left, whole, b)
        return TollesLawson(
            tuple(terms), tuple(c.tolist()), band_hz, penalty, float(np.std(left)), preset, *known
        )
    size = np.sqrt(np.mean(matrix * matrix, axis=0))
    size[size <= 1e-9 * size.max()] = np.inf  # a constant column gets no coefficient
    scaled = matrix / size
    chosen = float(ridge) if ridge is not None else _cross_validated(scaled, b)
    c = _ridge(scaled.T @ scaled, scaled.T @ b, chosen * len(b)) / size
    left = b - matrix @ c
    fitted = tuple(terms), tuple(c.tolist()), band_hz, chosen, float(np.std(left))
    return TollesLawson(*fitted, "magtwin", *_determined(matrix, left, whole, b))


def _determined(matrix: Array, left: Array, whole: Array, b: Array) -> tuple[tuple[float, ...], float]:
    """Standard deviations of coefficients by least squares, and the condition number of the columns.

    Residuals are correlated: their sum has the variance of white ones times 1 + 2 sum of autocorrelations, up
    to the first below 0. Not determined is a column that is constant, or a sum of others up to `LEAST_OWN`;
    or whose interval, in any attitude of the `whole` run, is wider than what there is to explain, `b`.
    """
    size = np.sqrt(np.mean(matrix**2, axis=0))
    seen = size > 1e-9 * size.max()
    scaled = matrix[:, seen] / size[seen]
    strength, axes = np.linalg.eigh(scaled.T @ scaled / len(left))
    inverse = (axes**2) @ (1 / np.maximum(strength, 1e-15 * strength[-1]))
    wave = np.fft.rfft(left - left.mean(), 2 * len(left))
    lagged = np.fft.irfft(np.abs(wave) ** 2)[: len(left) // 4]
    lagged = lagged / max(lagged[0], 1e-300)
    kept = int(np.argmax(lagged < 0)) or len(lagged)
    inflated = max(1 + 2 * float(lagged[1:kept].sum()), 1.0)
    sd = np.full(len(size), np.inf)
    sd[seen] = np.sqrt(np.mean(left**2) * inflated * inverse / len(left)) / size[seen]
    vague = Z_90 * sd * np.abs(whole).max(axis=0) > b.std()
    vague[seen] |= inverse > 1 / LEAST_OWN
    sd[vague] = np.inf
    return tuple(sd.tolist()), float(np.sqrt(strength[-1] / max(strength[0], 1e-30)))


def late(values: ArrayLike, delay_s: float, rate_hz: float) -> Array:
    """Values (N,) as they were `delay_s` before."""
    known = np.asarray(values, float)
    at = np.arange(len(known)) - delay_s * rate_hz
    return np.asarray(np.interp(at, np.arange(len(known)), known))


def fit_run(run: Run, **options: Any) -> TollesLawson:
    """`fit_tolles_lawson` on a run: b_measured_nt minus b_map_nt, against its field vectors.

    The longest unbroken stretch of rows with a map, a reading and a vector is used, because the filter needs
    one. A run without a map is taken as of a uniform field. The delay of the current is that with the least
    residual, up to `MOST_DELAY_S`. `options` are those of `fit_tolles_lawson`.

    Raises:
        InputError: The run has no such vectors, or too few in a row.
    """
    b_vector, rows, rate = _unbroken(run)
    b = _above_map(run)[rows]
    if "current" not in options.get("terms", DEFAULT_TERMS):
        return fit_tolles_lawson(b, b_vector[rows], rate, **options)
    amperes = np.interp(run["t"], *_known_current(run))[rows]
    fits = [
        (delay, fit_tolles_lawson(b, b_vector[rows], rate, current_a=late(amperes, delay, rate), **options))
        for delay in np.linspace(0.0, MOST_DELAY_S, 6).tolist()
    ]
    delay, best = min(fits, key=lambda each: each[1].residual_sd_nt)
    return replace(best, delay_s=delay)


def _above_map(run: Run) -> Array:
    """Measured field less the map, or less nothing where a run has no map [nT]."""
    measured = run["b_measured_nt"]
    return np.asarray(measured - run["b_map_nt"] if "b_map_nt" in run else measured)


def _known_current(run: Run) -> tuple[Array, Array]:
    """Times and values of the battery's current."""
    amperes = run["battery_a"] if "battery_a" in run else np.full(run.rows, np.nan)
    known = np.isfinite(amperes)
    if not known.any():
        raise InputError("the run has no current of a battery (battery_a); leave out --current")
    return run["t"][known], amperes[known]


def compensate_run(run: Run, model: TollesLawson) -> tuple[Run, Report]:
    """Remove the part of b_measured_nt that a model explains.

    Returns:
        The run, with nan in b_measured_nt where it has no vector, and a report.
    """
    b_vector, rows, rate = _unbroken(run)
    interference = np.full(run.rows, np.nan)
    current = np.interp(run["t"], *_known_current(run))[rows] if "current" in model.terms else None
    interference[rows] = model.interference_nt(b_vector[rows], rate, current)
    before = _above_map(run)[rows]
    after = before - interference[rows]
    if not before.std() > 0:
        raise InputError("b_measured_nt minus b_map_nt is constant, so there is nothing to remove")
    removed = float(1 - after.var() / before.var())
    worse = "below 0: more variance than before, because the fit had too few headings or another field"
    figures = (
        Figure("readings", int(rows.stop - rows.start)),
        Figure("before", float(before.std()), "nT", note="standard deviation of measured minus map"),
        Figure("after", float(after.std()), "nT", note="standard deviation, compensated"),
        Figure("variance removed", removed, "", note="share, 1 is all of it" if removed >= 0 else worse),
    )
    compensated = run.with_columns(b_measured_nt=run["b_measured_nt"] - interference)
    about = {"terms": list(model.terms), "vector": VECTOR}
    line = verdict(
        float(after.std()),
        float(before.std()),
        than="no compensation",
        measure="standard deviation",
        judged_on="measured minus map in this run",
    )
    metadata = {"tolles_lawson": " ".join(model.terms)}
    return compensated.with_metadata(**metadata), Report("Compensation", figures, about, line)


def band_pass(
    values: ArrayLike, band_hz: tuple[float, float], rate_hz: float, *, preset: str = "magtwin"
) -> Array:
    """Filter signals as `fit_tolles_lawson` does: forward and backward by a Butterworth filter of order 4.

    Args:
        values: Signals, shape (N, ...).
        band_hz: Pass band [Hz].
        rate_hz: Readings a second [Hz].
        preset: A name of `PRESETS`. "magnav" leaves constant signals as they are.

    Returns:
        Filtered and trimmed signals, shape (N - 2 trim, ...).

    Raises:
        InputError: The preset is unknown, the band does not fit the rate, or there are too few readings.
    """
    from scipy.signal import butter, sosfiltfilt  # slow import

    magnav, values = _is_magnav(preset), np.asarray(values, float)
    low, high = band_hz
    if not 0 < low < high < rate_hz / 2:
        raise InputError(
            f"band_hz must ascend between 0 and half the rate, {rate_hz / 2:g} Hz, got {low:g}, {high:g}"
        )
    least = 0.01 * rate_hz / max(len(values), 1)
    if low < least:
        raise InputError(
            f"band_hz must begin at {least:.2g} Hz at least, a hundredth of a period in these readings; got "
            f"{low:g}"
        )
    stages = butter(4, band_hz, btype="bandpass", fs=rate_hz, output="sos")
    padding, trim = (MAGNAV_PADDING, MAGNAV_TRIM) if magnav else (3 * (2 * len(stages) + 1), 0)
    least = max(padding, 2 * trim)
    if len(values) <= least:
        raise InputError(f"{len(values)} readings are too few for the band-pass, {least + 1} are needed")
    filtered = np.asarray(sosfiltfilt(stages, values, axis=0, padlen=padding))
    if magnav:
        filtered = np.where(values.std(axis=0) <= np.finfo(float).eps, values, filtered)
    return filtered[trim : len(filtered) - trim]


def _ridge(gram: Array, along: Array, penalty: float) -> Array:
    """Minimiser of c^T G c - 2 c^T a + p |c|^2, 0 along directions that G does not determine."""
    strength, axes = np.linalg.eigh(gram)
    seen = strength > 1e-13 * strength[-1]
    share = np.zeros_like(strength)
    share[seen] = 1 / (strength[seen] + penalty)
    return np.asarray(axes @ (share * (axes.T @ along)))


def _cross_validated(matrix: Array, b: Array) -> float:
    """The penalty that best predicts each of `FOLDS` stretches from the others."""
    parts = [slice(rows[0], rows[-1] + 1) for rows in np.array_split(np.arange(len(b)), FOLDS)]
    grams = [matrix[s].T @ matrix[s] for s in parts]
    alongs = [matrix[s].T @ b[s] for s in parts]
    gram, along = np.sum(grams, axis=0), np.sum(alongs, axis=0)
    errors = np.zeros(len(RIDGES))
    for stretch, own, own_along in zip(parts, grams, alongs, strict=True):
        left = len(b) - (stretch.stop - stretch.start)
        for k, ridge in enumerate(RIDGES):
            c = _ridge(gram - own, along - own_along, ridge * left)
            errors[k] += np.sum((b[stretch] - matrix[stretch] @ c) ** 2)
    return float(RIDGES[np.argmin(errors)])


def _is_magnav(preset: str) -> bool:
    return find("preset", preset, dict.fromkeys(PRESETS, preset)) == "magnav"


def _unbroken(run: Run) -> tuple[Array, slice, float]:
    """Field vectors (N, 3) of a run, the longest stretch of rows with map, reading and vector, the rate [Hz].

    Raises:
        InputError: The run has no such vectors, too few in a row, or uneven times.
    """
    b_vector = run[VECTOR] if VECTOR in run else np.full((run.rows, 3), np.nan)
    if not np.isfinite(b_vector).any():
        raise InputError(
            f"the run has no field vectors in {VECTOR}, which direction cosines need; record a vector "
            "magnetometer, or simulate a scene whose Earth field is known"
        )
    if "b_map_nt" not in run:  # a uniform field: the size of a vector has no part in explaining the size
        size = np.linalg.norm(b_vector, axis=1, keepdims=True)
        b_vector = b_vector / np.where(size > 0, size, np.nan) * np.nanmedian(size)
    fine = np.isfinite(_above_map(run)) & np.isfinite(b_vector).all(axis=1)
    rows = slice(*max(stretches(fine).tolist(), key=lambda ends: ends[1] - ends[0], default=(0, 0)))
    t = run["t"][rows]
    if len(t) < 3:
        raise InputError(f"only {len(t)} readings in a row have a map and a vector; a fit needs more")
    step = float(np.median(np.diff(t)))
    if not step > 0 or np.abs(np.diff(t) - step).max() > 0.5 * step:
        raise InputError("the run's readings are not evenly spaced in time; resample it first")
    return b_vector, rows, 1 / step
