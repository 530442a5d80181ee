"""The field of point dipoles."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.compiled import threads
from magtwin.errors import InputError

Array = NDArray[np.float64]

MU_0_OVER_4_PI = 1.00000000055e-7  # Magnetic constant over 4 pi [T m/A] (CODATA 2018)
NT_PER_T = 1e9

SHARED = 16  # Blocks from which a second thread pays; the results do not depend on it
# Pairs of a point and a dipole worked on at a time: their arrays stay in the second-level cache
PAIRS = 32_768
# Pairs whose squared distance is below this share of their squared distances from the origin are computed
# again without cancellation
CLOSE = 1e-4

T = TypeVar("T")


def dipole_field_nt(p_world: ArrayLike, p_world_dipole: ArrayLike, m_world: ArrayLike) -> Array:
    """Field of point dipoles (Jackson, Classical Electrodynamics, 3rd ed. 1999, eq. 5.56).

    B(p) = mu_0 / 4 pi * sum_d (3 (m_d . u) u - m_d) / |r|^3,  r = p - p_d,  u = r / |r|

    Points have shape (..., 3) [m], dipoles and moments [A m^2] (D, 3), the field in world axes [nT] (..., 3):
    not finite at a dipole itself, zero for no dipoles.
    """
    p, place, moment = checked(p_world, p_world_dipole, m_world)
    points = p.reshape(-1, 3)
    field = np.zeros(points.shape)

    def work(rows: slice) -> None:
        field[rows], _ = dipole_block(points[rows], None, place, moment)

    in_two_threads(work, in_blocks(len(points), len(place)), pairs=len(points) * len(place))
    return field.reshape(p.shape)


def checked(p_world: ArrayLike, p_world_dipole: ArrayLike, m_world: ArrayLike) -> tuple[Array, Array, Array]:
    """Points (..., 3), positions and moments (D, 3) as arrays; InputError if a shape is wrong."""
    p = np.asarray(p_world, float)
    place, moment = np.asarray(p_world_dipole, float), np.asarray(m_world, float)
    if p.ndim == 0 or p.shape[-1] != 3:
        raise InputError(f"p_world must have shape (..., 3), got {p.shape}")
    if place.ndim != 2 or place.shape[1] != 3 or moment.shape != place.shape:
        text = "p_world_dipole and m_world must have one shape (D, 3)"
        raise InputError(f"{text}, got {place.shape} and {moment.shape}")
    return p, place, moment


def in_blocks(points: int, dipoles: int) -> list[slice]:
    """Slices of points, each with about `PAIRS` pairs of a point and a dipole."""
    block = max(1, PAIRS // max(1, dipoles))
    return [slice(start, start + block) for start in range(0, points, block)]


def in_two_threads(work: Callable[[T], None], tasks: Sequence[T], *, pairs: int) -> None:
    """Work on tasks that share no rows, in two threads if there are enough `pairs`."""

    def several(some: Sequence[T]) -> None:
        for task in some:
            work(task)

    if pairs < SHARED * PAIRS or threads(2) < 2:
        several(tasks)
        return
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(several, (tasks[::2], tasks[1::2])))


def dipole_block(p: Array, v: Array | None, place: Array, moment: Array) -> tuple[Array, Array]:
    """Field [nT] and its rate [nT/s] at points with velocities `v`, by products of narrow matrices, (N, 3).

    With r = p - p_d, |r|^2 = |p|^2 - 2 p . p_d + |p_d|^2, and other scalar products likewise. Sums over
    dipoles are matrix products too. This loses digits if r is much shorter than p, so |r|^2 of close pairs is
    computed again. Without `v` the rate is 0.
    """
    scale = MU_0_OVER_4_PI * NT_PER_T
    home = place.mean(axis=0) if len(place) else np.zeros(3)
    p, place = p - home, place - home
    own, size = np.square(p).sum(axis=1)[:, None], np.square(place).sum(axis=1)
    there = np.column_stack([place, np.ones(len(place))])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        square = p @ (-2 * place.T)
        square += size
        square += own
        if square.size and square.min() < CLOSE * (own.max() + size.max()):
            n, d = np.nonzero(square < CLOSE * (own + size))
            square[n, d] = np.square(p[n] - place[d]).sum(axis=1)
        inverse = np.divide(1, square, out=square)
        cubed = np.sqrt(inverse)
        cubed *= inverse
        fifth = 3 * inverse
        fifth *= cubed
        along = p @ moment.T
        along -= np.einsum("di,di->d", moment, place)
        slope = along * fifth
        sums = slope @ there
        field = sums[:, 3:] * p - sums[:, :3] - cubed @ moment
        if v is None:
            return scale * field, np.zeros(p.shape)
        towards = v @ -place.T
        towards += np.einsum("ni,ni->n", v, p)[:, None]
        along *= towards
        along *= inverse
        along *= -5
        along += v @ moment.T
        along *= fifth
        towards *= fifth
        turned = along @ there
        rate = turned[:, 3:] * p - turned[:, :3] + towards @ moment + sums[:, 3:] * v
    return scale * field, scale * rate
