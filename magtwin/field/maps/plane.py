"""Plane: the field of magnetised bodies at one height, computed once per square and then looked up."""

from functools import cache
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.maps.lookup import AS_MANY, LOOPS
from magtwin.field.sources.bodies import CELL_M, FARTHEST_CELL, Bodies
from magtwin.field.sources.dipoles import dipole_block, in_blocks, in_two_threads

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

HALF_M = CELL_M / 2  # Half the side of a square [m]; squares are level cuts of the cells of `Bodies`
NODES = 10  # Chebyshev nodes along each side of a square
# Distance from a square beyond which sources are interpolated [m]; nearer ones are summed for each point
CLEAR_M = 0.35
MOST_SQUARES = 40_000  # Squares kept: 2,500 m2, 0.1 GB. Beyond, all are dropped.
BLOCK = 32_768  # Points worked on at a time; they lie in fewer squares than are kept
# Points in numpy that take as long as a square takes beside its points; a point takes as long as `AS_MANY`
# poses of a map
PER_SQUARE = 100
# Bounds of the interpolation error of field and slope, relative to the largest that a source makes at
# distance `CLEAR_M`: 0.01 nT for a source as strong there as the Earth's field. A test checks them.
ERROR, SLOPE_ERROR = 2e-7, 2e-5


class Plane:
    """The field of magnetised bodies on a level plane, as polynomials over squares.

    In each square, the field of what is farther away than `CLEAR_M` is computed at Chebyshev nodes when a
    point in it is first needed. The error of the polynomial falls as rho^-n, rho = d / a + sqrt((d / a)^2 -
    1), where a is half the square's side and d the distance of the nearest source from its centre (Trefethen
    2013, Approximation Theory and Practice, theorem 8.2): 8.3^-10. The result at a point depends on its
    position only, to the last bit except for sources nearer than `CLEAR_M`.
    """

    def __init__(self, bodies: Bodies, height_m: float) -> None:
        """Take the bodies and the height of the plane above the floor [m]."""
        self.bodies, self.height_m = bodies, float(height_m)
        self._lock = Lock()
        self._forget()

    def _forget(self) -> None:
        self._slots: dict[int, int] = {}
        self._table = np.empty((64, NODES, 3 * NODES))
        self._close: dict[int, Bodies] = {}

    def field_and_slopes_nt(self, p_xy: ArrayLike) -> tuple[Array, Array]:
        """The field and its slopes along x and y.

        Points have shape (N, 2) [m], the field in world axes (N, 3) [nT], dB/dx and dB/dy (N, 2, 3) [nT/m];
        nan if a point is not finite or over 130 km from the origin.
        """
        p = np.asarray(p_xy, float)
        if p.ndim != 2 or p.shape[1] != 2:
            raise InputError(f"p_xy must have shape (N, 2), got {p.shape}")
        out = np.empty((len(p), 3, 3))
        known = np.all(np.abs(p) < CELL_M * FARTHEST_CELL, axis=1)
        if known.all():
            for start in range(0, len(p), BLOCK):
                self._evaluate(p[start : start + BLOCK], out[start : start + BLOCK])
        else:
            field, slopes = self.field_and_slopes_nt(p[known])
            out[~known] = np.nan
            out[known, 0], out[known, 1:] = field, slopes
        return out[:, 0], out[:, 1:]

    def _evaluate(self, p: Array, out: Array) -> None:
        """Field and slopes of points, into an array of shape (N, 3, 3)."""
        cell = np.floor(p / CELL_M)
        local = 2 * (p / CELL_M - cell) - 1  # exact, as CELL_M is a power of 2
        number = cell.astype(np.int64)
        # Points come along a track: sought is one square for all that follow one another in it.
        key = (number[:, 0] << 32) + number[:, 1]
        first = np.flatnonzero(np.concatenate([[True], key[1:] != key[:-1]]))
        keys, passed = np.unique(key[first], return_inverse=True)
        which = np.repeat(passed, np.diff(first, append=len(key)))
        with self._lock:
            slots = self._slots_of(keys)
            table, close = self._table, self._close
        code = LOOPS.after(AS_MANY * (len(p) + PER_SQUARE * len(keys)))
        if code is not None:
            u, w = np.ascontiguousarray(local.T)
            code.polynomials(table, slots[which], u, w, 1 / HALF_M, out)
        else:
            order = np.argsort(which, kind="stable")
            squares = np.split(order, np.cumsum(np.bincount(which))[:-1])
            for slot, rows in zip(slots.tolist(), squares, strict=True):
                out[rows] = _by_numpy(table[slot], *local[rows].T)
        for k in np.flatnonzero(np.isin(slots, list(close))) if close else ():
            rows = np.flatnonzero(which == k)
            at = np.column_stack([p[rows], np.full(len(rows), self.height_m)])
            for axis in (0, 1):
                along = np.zeros(at.shape)
                along[:, axis] = 1.0
                field, out_of_near = close[int(slots[k])].field_and_rate_nt(at, along)
                out[rows, 1 + axis] += out_of_near
            out[rows, 0] += field

    def _slots_of(self, keys: Numbers) -> Numbers:
        """Table slots of squares; new squares are computed."""
        new = [key for key in keys.tolist() if key not in self._slots]
        if len(self._slots) + len(new) > MOST_SQUARES and self._slots:
            self._forget()
            new = keys.tolist()
        if new:
            first = len(self._slots)
            room = first + len(new)
            if room > len(self._table):
                table = np.empty((max(room, 2 * len(self._table)), NODES, 3 * NODES))
                table[:first] = self._table[:first]
                self._table = table
            self._make(new, first)
            self._slots |= {key: first + k for k, key in enumerate(new)}
        return np.array([self._slots[key] for key in keys.tolist()], np.int64)

    def _make(self, keys: list[int], first: int) -> None:
        """Compute the polynomials of squares into consecutive table slots."""
        node, powers = _nodes()
        reach = CLEAR_M + np.sqrt(2) * HALF_M
        layer = np.clip(np.floor(self.height_m / CELL_M), -FARTHEST_CELL, FARTHEST_CELL - 1)
        works = []
        for slot, key in enumerate(keys, first):
            x, y = (key + (1 << 31)) >> 32, ((key + (1 << 31)) & 0xFFFF_FFFF) - (1 << 31)
            centre = CELL_M * (np.array([x, y, layer]) + 0.5)
            middle = np.append(centre[:2], self.height_m)
            places, moments, close = self.bodies.seen_from(centre)
            near = [self.bodies.solid[k] for k in close]
            clear = np.sqrt(np.square(places - middle).sum(axis=1)) >= reach
            apart = [body.clearance(middle[None])[0] >= reach for body in near]
            some = [body for body, far in zip(near, apart, strict=True) if not far]
            if some or not clear.all():
                self._close[slot] = Bodies(some, places[~clear], moments[~clear])
            whole = [body for body, far in zip(near, apart, strict=True) if far]
            works.append((slot, middle, places[clear], moments[clear], whole))

        def fit(work: tuple[int, Array, Array, Array, list]) -> None:
            slot, middle, places, moments, whole = work
            u, w = np.meshgrid(node, node, indexing="ij")
            square = middle + HALF_M * np.stack([u, w, np.zeros_like(u)], axis=-1).reshape(-1, 3)
            blocks = in_blocks(len(square), len(places))
            b = np.concatenate([dipole_block(square[rows], None, places, moments)[0] for rows in blocks])
            for body in whole:
                b += body.exact_field_nt(square)
            sums = np.einsum("ik,jl,klc->ijc", powers, powers, b.reshape(NODES, NODES, 3))
            self._table[slot] = sums.reshape(NODES, -1)

        in_two_threads(fit, works, pairs=sum(NODES**2 * len(work[2]) for work in works))


@cache
def _nodes() -> tuple[Array, Array]:
    """Chebyshev nodes in -1..1, and the matrix from values at them to coefficients of powers."""
    node = np.cos(np.pi * (np.arange(NODES) + 0.5) / NODES)
    return node, np.linalg.inv(np.vander(node, increasing=True))


def _by_numpy(table: Array, u: Array, w: Array) -> Array:
    """A square's polynomial and its slopes at points in -1..1, as `loops.polynomials` computes them."""
    a = np.repeat(table[-1][:, None], len(u), axis=1)
    slope = np.zeros(a.shape)
    for row in table[-2::-1]:
        slope *= u
        slope += a
        a *= u
        a += row[:, None]
    rows, slopes = a.reshape(NODES, 3, -1), slope.reshape(NODES, 3, -1)
    f, along_u, along_w = rows[-1].copy(), slopes[-1].copy(), np.zeros(rows[-1].shape)
    for k in range(NODES - 2, -1, -1):
        along_w *= w
        along_w += f
        f *= w
        f += rows[k]
        along_u *= w
        along_u += slopes[k]
    along_u *= 1 / HALF_M
    along_w *= 1 / HALF_M
    return np.stack([f, along_u, along_w]).transpose(2, 0, 1)
