"""World: true fields of simulated cases, and the maps that localizers get."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from magtwin.errors import InputError
from magtwin.field.maps.curvature import interpolation_error_nt2
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import existing_file

Array = NDArray[np.float64]

CELL_M = 0.05  # Nodes of a true field [m]
HEADINGS = 24  # Headings of a true field that is fitted to a survey
MOST_NODES = 1_000_000
"""Most places of a survey; more would take gigabytes."""

SURVEY_HEADINGS = 4  # Headings of a trilinear survey
DEPTH_M = 0.3  # Depth below the sensor of an object that is moved [m]


def fit_field(folder: Path, out: Path) -> None:
    """Fit a harmonic field to a survey, which then is the truth; write it and the survey's own nodes.

    Args:
        folder: Survey, as for `magtwin map fit`.
        out: Folder to write: truth.npz and nodes.npz.
    """
    from magtwin.field.fit.fit import fit, raster
    from magtwin.io.surveys.survey import survey_and_report

    readings = survey_and_report([folder])[0]
    headings = np.linspace(0.0, 2 * np.pi, HEADINGS, endpoint=False)
    truth = raster(fit(readings, "harmonic"), readings, spacing_m=CELL_M, headings_rad=headings)
    nodes = raster(fit(readings, "trilinear"), readings)
    out.mkdir(parents=True, exist_ok=True)
    for name, made in (("truth", truth), ("nodes", nodes)):
        _save(made, out / f"{name}.npz")


@lru_cache(maxsize=8)
def fitted_field(file: Path) -> AnomalyMap:
    """A map that `fit_field` wrote."""
    with np.load(existing_file(file, "fitted map", "npz")) as saved:
        arrays = {name: saved[name] for name in saved.files}
    origin, cell = (tuple(map(float, arrays.pop(name))) for name in ("origin_m", "cell_m"))
    return AnomalyMap(origin_m=origin, cell_m=cell, name=file.stem, **arrays)  # type: ignore[arg-type]


def _save(field: AnomalyMap, file: Path) -> None:
    arrays = {
        n: getattr(field, n) for n in ("values_nt", "valid", "headings_rad", "variance_nt2", "between_nt2")
    }
    known = {name: array for name, array in arrays.items() if array is not None}
    np.savez(file, origin_m=field.origin_m, cell_m=field.cell_m, **known)


def certain(field: AnomalyMap) -> AnomalyMap:
    """A map without error."""
    return _with(field, field.values_nt, np.zeros(field.values_nt.shape))


def with_error(field: AnomalyMap, sd_nt: float, length_m: float, rng: np.random.Generator) -> AnomalyMap:
    """A map with a Gaussian random error that is equal at all headings.

    Its covariance over a distance d is sd^2 exp(-d^2 / (2 length^2)): white noise on the nodes, filtered by a
    Gaussian of standard deviation length / sqrt(2).

    Args:
        field: The true map.
        sd_nt: Standard deviation [nT].
        length_m: Correlation length [m].
        rng: Source of the error.
    """
    _, rows, columns = field.values_nt.shape
    dx, dy = field.cell_m
    sigma = (length_m / np.sqrt(2) / dy, length_m / np.sqrt(2) / dx)
    pad = tuple(int(np.ceil(4 * s)) for s in sigma)
    shape = (rows + 2 * pad[0], columns + 2 * pad[1])
    smooth = gaussian_filter(rng.standard_normal(shape), sigma, mode="constant")
    point = np.zeros(tuple(2 * p + 1 for p in pad))
    point[pad] = 1.0
    smooth /= np.sqrt(np.sum(gaussian_filter(point, sigma, mode="constant") ** 2))
    error = sd_nt * smooth[pad[0] : pad[0] + rows, pad[1] : pad[1] + columns]
    return _with(field, field.values_nt + error, np.full(field.values_nt.shape, sd_nt**2))


def trilinear(field: AnomalyMap, spacing_m: float) -> AnomalyMap:
    """The map of a survey of a true field at rest, at few nodes and four headings, read without noise.

    Its variance is that of linear interpolation between the nodes.

    Raises:
        InputError: It has more than `MOST_NODES`.
    """
    x0, x1, y0, y1 = field.extent
    columns, rows = (max(2, round((b - a) / spacing_m) + 1) for a, b in ((x0, x1), (y0, y1)))
    if columns * rows > MOST_NODES:
        raise InputError(
            f"survey_spacing_m of {spacing_m:g} m gives {float(columns):g} x {float(rows):g} nodes; at most "
            f"{MOST_NODES:,} are surveyed"
        )
    x, y = np.linspace(x0, x1, columns), np.linspace(y0, y1, rows)
    headings = np.linspace(0.0, 2 * np.pi, SURVEY_HEADINGS, endpoint=False)
    yaw, gy, gx = np.meshgrid(headings, y, x, indexing="ij")
    values = field.lookup(np.stack([gx, gy], axis=-1), yaw)
    valid = np.isfinite(values)
    return AnomalyMap(
        values_nt=np.where(valid, values, 0.0),
        valid=valid,
        origin_m=(x0, y0),
        cell_m=(float(x[1] - x[0]), float(y[1] - y[0])),
        headings_rad=headings,
        variance_nt2=np.zeros(values.shape),
        between_nt2=interpolation_error_nt2(values, valid, headings),
        name="trilinear",
    )


def with_moved_object(field: AnomalyMap, strength_nt: float, rng: np.random.Generator) -> AnomalyMap:
    """A true field after an iron object was moved by 0.6 m: a dipole goes from one place to another.

    Args:
        field: The field before.
        strength_nt: Largest change of the magnitude that one of the two dipoles makes at the sensor's height
            directly above it [nT].
        rng: Source of the place, the direction and the sign.
    """
    x0, x1, y0, y1 = field.extent
    place = rng.uniform((x0 + 0.5, y0 + 0.5), (x1 - 0.5, y1 - 0.5))
    angle = rng.uniform(0, 2 * np.pi)
    gx, gy = np.meshgrid(field.x_m, field.y_m)
    change = np.zeros(gx.shape)
    for sign, p in ((-1.0, place), (1.0, place + 0.6 * np.array([np.cos(angle), np.sin(angle)]))):
        r2 = (gx - p[0]) ** 2 + (gy - p[1]) ** 2 + DEPTH_M**2
        # vertical dipole, field along the vertical: (3 z^2 / r^2 - 1) / r^3, which is 2 / depth^3 above it
        change += sign * (3 * DEPTH_M**2 / r2 - 1) * (DEPTH_M**2 / r2) ** 1.5 / 2
    spread = np.zeros(field.values_nt.shape)
    return _with(field, field.values_nt + strength_nt * change, spread)


def _with(field: AnomalyMap, values: Array, variance: Array) -> AnomalyMap:
    if values.shape != field.values_nt.shape:
        raise InputError("values and map differ in shape")
    return AnomalyMap(
        values_nt=np.where(field.valid, values, 0.0),
        valid=field.valid,
        origin_m=field.origin_m,
        cell_m=field.cell_m,
        headings_rad=field.headings_rad,
        variance_nt2=variance,
        name=field.name,
        frame=field.frame,
    )
