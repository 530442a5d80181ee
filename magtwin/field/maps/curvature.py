"""Curvature: the error of linear interpolation between the nodes of a map, estimated from the nodes."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.field.grid import TURN

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

PRIOR = 0.3  # Weight of the map's mean in a local mean, as a number of nodes
LEAST = 0.1  # Least local mean, as a share of the map's mean: noise may hide it
# E[(f_xx + f_yy)^2] / E[f_xx^2] of a random field that is alike in all directions
BOTH = 8 / 3


def interpolation_error_nt2(
    values_nt: Array, valid: Flags, headings_rad: ArrayLike, noise_nt2: Array | None = None
) -> Array:
    """Mean squared error of linear interpolation in the middle of a cell and midway between headings.

    Between two nodes a distance h apart the error is f'' h^2 / 8 (de Boor 1978, chapter 3), so in the middle
    of a cell it is (d_x + d_y) / 8 with the second differences d = b_- - 2 b + b_+ along x and y. Its square
    is averaged over 3 x 3 nodes and all headings, less 20/64 of the nodes' variance, which their own errors
    add, and less 3/4 of it, since in the middle of a cell the mean of four nodes errs less than each. Over
    heading, waves of order k and amplitude A through the layers err by A (1 - cos(k g / 2)) midway over a gap
    g, on the mean over their phase A^2 / 2 of the square of that.

    Values, `valid` nodes that count and the variance of the nodes' own errors (independent; 0 for a smooth
    model) have shape (H, Y, X), the result (2, H, Y, X): cells and headings. Two headings count as one phase
    of a wave; between headings the error of one is 0.
    """
    known = np.where(valid, values_nt, np.nan)
    noise = np.zeros(known.shape) if noise_nt2 is None else np.where(valid, noise_nt2, np.nan)
    along = [_second(known, axis) for axis in (1, 2)]
    square = (along[0] + along[1]) ** 2 - (20 + 48) * noise
    for one in along if not np.isfinite(square).any() else ():  # as in a map of two rows
        square = np.where(np.isfinite(square), square, BOTH * (one**2 - 6 * noise) - 48 * noise)
    cells = _local(square, float(np.nanvar(known)) if valid.any() else 0.0) / 64
    turns = np.zeros(known.shape)
    headings = np.asarray(headings_rad, float)
    gaps = np.diff(np.append(headings, headings[0] + TURN))
    gap = np.maximum(gaps, np.roll(gaps, 1))[:, None, None]
    if len(headings) == 2:
        turns += _local((((known[1] - known[0]) / 2) ** 2 - noise.mean(axis=0) / 2)[None], 0.0)
    most = min(2, (len(headings) - 1) // 2)
    inverse = np.linalg.pinv(_waves(headings, most))
    for order in range(1, most + 1):
        rows = inverse[2 * order - 1 : 2 * order + 1]
        amplitude = np.sum(np.tensordot(rows, known, axes=1) ** 2, axis=0)
        amplitude = amplitude - np.tensordot(np.sum(rows**2, axis=0), noise, axes=1)
        turns += _local(amplitude[None] / 2, 0.0) * (1 - np.cos(order * gap / 2)) ** 2
    return np.stack([np.broadcast_to(cells, known.shape), turns])


def _second(values: Array, axis: int) -> Array:
    """Second differences along an axis; nan at its ends."""
    out = np.full(values.shape, np.nan)
    if values.shape[axis] > 2:
        inner = [slice(None)] * values.ndim
        inner[axis] = slice(1, -1)
        out[tuple(inner)] = np.diff(values, 2, axis=axis)
    return out


def _local(square: Array, unknown: float) -> Array:
    """Mean over layers and 3 x 3 nodes of (H, Y, X), drawn a little to the mean of all, shape (Y, X)."""
    known = np.isfinite(square)
    if not known.any():
        return np.full(square.shape[1:], unknown)
    mean = max(float(square[known].mean()), 0.0)
    total, count = np.where(known, square, 0.0).sum(axis=0), known.sum(axis=0) / len(square)
    total /= len(square)
    box = [_box(np.asarray(part, float)) for part in (total, count)]
    return np.maximum((box[0] + PRIOR * mean) / (box[1] + PRIOR), LEAST * mean)


def _box(layer: Array) -> Array:
    """Sums over 3 x 3 nodes, shape (Y, X)."""
    wide = np.pad(layer, 1)
    rows = wide[:-2] + wide[1:-1] + wide[2:]
    return np.asarray(rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:])


def _waves(headings: Array, order: int) -> Array:
    """1, cos, sin, ... of the headings, shape (H, 2 order + 1)."""
    each = [np.ones_like(headings)]
    for k in range(1, order + 1):
        each += [np.cos(k * headings), np.sin(k * headings)]
    return np.column_stack(each)
