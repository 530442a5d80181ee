"""Obstacles: solid things on the floor, which stop robots and which LiDARs see."""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.report.summary import Summarized, Summary, listed

Array = NDArray[np.float64]

COLLINEAR_M = 1e-9
"""A point nearer than this to the line through the two before it makes no corner [m]."""


@dataclass(frozen=True, eq=False, repr=False)
class Obstacles(Summarized):
    """Solid things in world, each with its outline on the floor and its surface.

    Outlines are convex: of another shape, the convex hull counts. Arrays are copies and read-only.
    """

    names: tuple[str, ...] = ()
    """Name of each: the path of its prim."""

    outlines: tuple[Array, ...] = ()
    """Corners of each outline in world x and y [m], counter-clockwise, shape (K, 2)."""

    triangles: Array = field(default_factory=lambda: np.empty((0, 3, 3)))
    """Surfaces of all of them in world [m], shape (T, 3, 3)."""

    def __post_init__(self) -> None:
        if len(self.names) != len(self.outlines):
            raise InputError(f"{len(self.names)} obstacles have {len(self.outlines)} outlines; each has one")
        outlines = tuple(_hull(name, o) for name, o in zip(self.names, self.outlines, strict=True))
        triangles = np.array(self.triangles, float)
        if triangles.ndim != 3 or triangles.shape[1:] != (3, 3) or not np.isfinite(triangles).all():
            raise InputError(
                f"triangles of Obstacles must be finite, of shape (T, 3, 3), got {triangles.shape}"
            )
        triangles.flags.writeable = False
        object.__setattr__(self, "outlines", outlines)
        object.__setattr__(self, "triangles", triangles)

    def __len__(self) -> int:
        return len(self.names)

    def clearance(self, p_xy: ArrayLike, *, reach_m: float = np.inf) -> tuple[Array, NDArray[np.intp]]:
        """Distance of points from the nearest outline.

        Args:
            p_xy: Points in world [m], shape (N, 2).
            reach_m: Ignore obstacles beyond this distance [m]; a small value is faster.

        Returns:
            Distance [m], negative inside an outline, inf if nothing is within reach; and the index of the
            nearest obstacle, -1 if there is none; each of shape (N,).
        """
        p = np.asarray(p_xy, float)
        x, y = p.T
        nearest, which = np.full(len(p), np.inf), np.full(len(p), -1)
        for i, outline in enumerate(self.outlines):
            low, high = outline.min(axis=0) - reach_m, outline.max(axis=0) + reach_m
            rows = np.flatnonzero((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]))
            if not len(rows):
                continue
            distance = _distance(p[rows], outline)
            closer = (distance < nearest[rows]) & (distance <= reach_m)
            nearest[rows[closer]], which[rows[closer]] = distance[closer], i
        return nearest, which

    def only(self, which: Sequence[int]) -> "Obstacles":
        """Some of them, by their numbers, without their surfaces."""
        return Obstacles(tuple(self.names[k] for k in which), tuple(self.outlines[k] for k in which))

    @functools.cached_property
    def edges(self) -> tuple[Array, NDArray[np.intp]]:
        """All outlines as edges for a compiled loop: x0, y0, x1, y1 [m], shape (E, 4), and the index of the
        first edge of each outline, shape (O + 1,).
        """
        sides = [np.hstack([o, np.roll(o, -1, axis=0)]) for o in self.outlines]
        begins = np.concatenate([[0], np.cumsum([len(s) for s in sides])]).astype(np.intp)
        return (np.vstack(sides) if sides else np.empty((0, 4))), begins

    def _summary(self) -> Summary:
        names = ["/".join(name.split("/")[-2:]) for name in self.names]
        title = f"Obstacles: {len(self)}, {len(self.triangles):,} triangles"
        return Summary(title, (("names", listed(names, 80)),))


def _distance(p: Array, outline: Array) -> Array:
    """Signed distance of points (N, 2) from a convex outline (K, 2), shape (N,)."""
    side = np.roll(outline, -1, axis=0) - outline
    x, y = p[:, None, 0] - outline[:, 0], p[:, None, 1] - outline[:, 1]
    length2 = np.sum(side * side, axis=1)
    along = np.clip((x * side[:, 0] + y * side[:, 1]) / length2, 0.0, 1.0)
    away = np.hypot(x - along * side[:, 0], y - along * side[:, 1]).min(axis=1)
    left = side[:, 0] * y - side[:, 1] * x  # above 0: on the inner side of the edge
    return np.where(np.all(left >= 0, axis=1), -away, away)


def _hull(name: str, points: ArrayLike) -> Array:
    """Convex hull of points (K, 2), counter-clockwise, by Andrew's monotone chain (1979)."""
    p = np.asarray(points, float)
    if p.ndim != 2 or p.shape[1] != 2 or not np.isfinite(p).all():
        raise InputError(f"obstacle {name!r}: its outline must be finite, of shape (K, 2), got {p.shape}")
    ordered = np.unique(p, axis=0).tolist()
    chain = [*_half(ordered)[:-1], *_half(ordered[::-1])[:-1]]
    if len(chain) < 3:
        raise InputError(f"obstacle {name!r}: its outline has no area")
    hull = np.array(chain)
    hull.flags.writeable = False
    return hull


def _half(points: Sequence[list[float]]) -> list[list[float]]:
    """Half of a hull: of points in order, those at which the outline turns left."""
    chain: list[list[float]] = []
    for x, y in points:
        while len(chain) >= 2:
            (x0, y0), (x1, y1) = chain[-2], chain[-1]
            if (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) > COLLINEAR_M * np.hypot(x1 - x0, y1 - y0):
                break
            chain.pop()
        chain.append([x, y])
    return chain
