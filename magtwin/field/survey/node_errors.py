"""Errors of gridded readings about the field of their nodes, estimated from the survey itself."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magtwin.field.grid import Grid
from magtwin.field.survey.readings import Readings

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

# Standard deviation of the robot's position about its node, in x and in y, if it cannot be estimated [m]
PLACE_M = 0.01
FEWEST = 24  # Fewest differences from which errors are estimated
GROSS = 4.0  # Standard deviations at which a difference is clipped
MEDIAN = 0.4549  # Median of the square of a standard normal
ROUNDS = 8  # Rounds of the weighted fit of the two variances


@dataclass(frozen=True, kw_only=True, eq=False)
class NodeErrors:
    """Variance of the reading of a node about the field there, at the node's nominal heading."""

    # Variance of each node's reading [nT^2], shape (H, Y, X); the mean of the others at nodes without one
    variance_nt2: Array
    mean_nt2: float  # Mean variance over the readings [nT^2]
    place_m: float  # Standard deviation of the robot's position about its nodes, in x and in y [m]
    noise_nt: float  # Standard deviation of the errors that do not depend on the gradient [nT]
    estimated: bool  # Whether place_m and noise_nt were estimated; otherwise they are `PLACE_M` and 0


def node_errors(readings: Readings, grid: Grid, values_nt: Array, read: Flags) -> NodeErrors:
    """Variance of gridded readings: from headings off nominal, positions off the nodes, and noise.

    A reading at yaw t + e, at a node of nominal heading t, misses the node's field by dB/dyaw e. Recorded
    headings give e; the waves cos and sin (and cos 2, sin 2 from five headings on) through a node's readings
    give dB/dyaw.

    With two headings or more, subtract from a node's readings what they have in common (from four headings on
    also a wave, from six on two). The rest has the full errors of single readings, but of the field only its
    heading dependence, which is smooth over the floor. So its second differences along rows and columns, (c_-
    - 2 c + c_+) / sqrt(6), have the variance s^2 + p^2 |grad B|^2, for noise s and position error p. Both are
    fitted to the squared differences, not below 0; on simulated surveys p is right within a tenth. With one
    heading, errors cannot be separated from the field's curvature, and p is 1 cm.

    `values_nt` are the mean readings of the nodes, shape (H, Y, X), at nodes without one interpolated or nan;
    `read` marks the nodes with a good reading.
    """
    headings = np.asarray(grid.headings_rad)
    order = min(2, (len(headings) - 1) // 2)
    waves, slopes = _waves(headings, order)
    missed = np.zeros(grid.shape)
    if order:
        slope = np.tensordot(slopes @ np.linalg.pinv(waves), values_nt, axes=1)
        missed = slope * _deviation(readings, grid)
    steep = _steepness(grid, values_nt)
    place, noise, estimated = PLACE_M, 0.0, False
    fewer = _waves(headings, min(2, len(headings) // 2 - 1))[0] if len(headings) > 1 else waves
    left = np.linalg.svd(fewer.T)[2][fewer.shape[1] :]  # combinations of headings that no such wave enters
    if len(left):
        fitted = _fitted(left, np.where(read, values_nt - missed, np.nan), steep)
        if fitted is not None:
            (place, noise), estimated = fitted, True
    variance = missed**2 + noise**2 + place**2 * steep
    known = read & np.isfinite(variance)
    mean = float(variance[known].mean()) if known.any() else 0.0
    return NodeErrors(
        variance_nt2=np.where(known, variance, mean),
        mean_nt2=mean,
        place_m=place,
        noise_nt=noise,
        estimated=estimated,
    )


def _waves(headings: Array, order: int) -> tuple[Array, Array]:
    """1, cos, sin, ... of the headings, shape (H, 2 order + 1), and their derivatives."""
    waves, slopes = [np.ones_like(headings)], [np.zeros_like(headings)]
    for k in range(1, order + 1):
        waves += [np.cos(k * headings), np.sin(k * headings)]
        slopes += [-k * np.sin(k * headings), k * np.cos(k * headings)]
    return np.column_stack(waves), np.column_stack(slopes)


def _deviation(readings: Readings, grid: Grid) -> Array:
    """Recorded minus nominal heading, RMS over a node's readings [rad], shape (H, Y, X)."""
    node = np.asarray(readings.node)[readings.good]
    yaw = readings.yaw[readings.good]
    off = np.angle(np.exp(1j * (yaw - np.asarray(grid.headings_rad)[node[:, 0]])))
    flat = np.ravel_multi_index(tuple(node.T), grid.shape)
    size = int(np.prod(grid.shape))
    count = np.maximum(np.bincount(flat, minlength=size), 1)
    mean, square = (np.bincount(flat, v, minlength=size) / count for v in (off, off**2))
    return np.asarray(np.where(mean < 0, -1, 1) * np.sqrt(square)).reshape(grid.shape)


def _steepness(grid: Grid, values: Array) -> Array:
    """Squared gradient of the magnitude over the floor, median over headings [nT^2/m^2], shape (Y, X)."""
    along_y, along_x = np.gradient(values, grid.cell_m[1], grid.cell_m[0], axis=(1, 2))
    square: Array = np.asarray(along_x**2 + along_y**2, float)
    known = np.isfinite(square)
    mean = square[known].mean() if known.any() else 0.0
    square[:, ~known.any(axis=0)] = mean
    return np.asarray(np.nanmedian(square, axis=0))


def _fitted(left: Array, values: Array, steep: Array) -> tuple[float, float] | None:
    """Standard deviations of position [m] and noise [nT] from what no wave explains; None from too little."""
    from scipy.optimize import nnls

    rest = np.tensordot(left, values, axes=1)
    squares, slope = [], []
    for axis in (1, 2):
        c = np.moveaxis(rest, axis, -1)
        bend = (c[..., 2:] - 2 * c[..., 1:-1] + c[..., :-2]) / np.sqrt(6)
        beside = np.broadcast_to(np.moveaxis(steep[None], axis, -1)[..., 1:-1], bend.shape)
        known = np.isfinite(bend)
        squares.append(bend[known] ** 2)
        slope.append(beside[known])
    q, g = np.concatenate(squares), np.concatenate(slope)
    if len(q) < FEWEST:
        return None
    if not q.any():
        return 0.0, 0.0
    terms = np.column_stack([g, np.ones_like(g)])
    scale = np.array([max(g.mean(), np.finfo(float).tiny), 1.0])
    expected = np.full_like(q, max(np.median(q) / MEDIAN, 1e-3 * q.mean()))
    for _ in range(ROUNDS):
        kept = np.minimum(q, GROSS**2 * expected)
        solution = nnls(terms / scale / expected[:, None], kept / expected)[0] / scale
        expected = np.maximum(terms @ solution, 1e-3 * kept.mean())
    return float(np.sqrt(solution[0])), float(np.sqrt(solution[1]))
