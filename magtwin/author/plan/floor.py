"""Polygons of a plan: the floor that walls enclose, and thin rectangles."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from magtwin.author.plan.drawing import Array

GAP_M = 1.3
"""A wider gap between walls is no door: the floor does not end there [m]."""

THIN_M = 0.6
"""A rectangle that is thinner is a wall or a pillar [m]."""

ROUGH_M = 0.02
"""Largest distance of a floor's border from the walls that it follows [m]."""


def section(polygons: Sequence[Array]) -> Any:
    """The union of polygons (N, 2), which may run either way, as a `manifold3d.CrossSection`."""
    from manifold3d import CrossSection, FillRule  # takes 0.05 s

    return CrossSection([np.asarray(p, float) for p in polygons], FillRule.NonZero)


def area(p: Array) -> float:
    """Area of a polygon (N, 2), below 0 if it runs clockwise."""
    x, y = p.T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2


def outline(shape: Any) -> Array:
    """The outer border of the largest part of a section, counter-clockwise, shape (N, 2)."""
    borders = [np.asarray(p, float) for p in shape.to_polygons()]
    return max(borders, key=area, default=np.empty((0, 2)))


def enclosed(bodies: Sequence[Array]) -> Array:
    """The outer border of what walls enclose, across gaps as wide as doors, shape (N, 2).

    Args:
        bodies: Outlines of the walls on the floor, counter-clockwise.
    """
    from manifold3d import JoinType

    closing = section(bodies).offset(GAP_M / 2, JoinType.Miter, 2.0)
    whole = section([outline(closing)]).offset(-GAP_M / 2, JoinType.Miter, 2.0)
    return outline(section([outline(whole.simplify(ROUGH_M))]))


def as_bar(p: Array) -> tuple[Array, float] | None:
    """Centre line (2, 2) and thickness of a thin rectangle (4, 2); None if it is none."""
    if len(p) != 4:
        return None
    sides = np.roll(p, -1, axis=0) - p
    lengths = np.hypot(*sides.T)
    square = np.abs(np.sum(sides[0] * sides[1])) < 0.02 * lengths[0] * lengths[1]
    even = np.allclose(sides[0], -sides[2], atol=0.02 * lengths[0] + 1e-9)
    if not (square and even and lengths.min() < THIN_M and lengths.min() > 0):
        return None
    k = int(lengths[1] < lengths[0])  # the first side across
    ends = [(p[j] + p[(j + 1) % 4]) / 2 for j in (k, k + 2)]
    return np.array(ends), float(lengths[k])
