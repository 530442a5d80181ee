"""Distances of a round footprint from obstacles, in the language of `loop.py`, plain or compiled."""

import math
from collections.abc import Sequence

Numbers = Sequence[float]
Columns = Sequence[Numbers]

GRAZE = 1e-6
"""Share of the distance driven by which a touching robot may approach an obstacle, against rounding."""


def clearance(fence: Columns, spans: Sequence[int], x: float, y: float, most: float) -> float:
    """Distance of a point outside of all obstacles from the nearest of them, or `most` [m].

    Args:
        fence: Edges of all outlines x0, y0, x1, y1 [m], of E numbers each; then the box about each outline,
            x and y of its lower and of its upper corner [m], of O numbers each.
        spans: Edge that begins each outline, and E, of O + 1 numbers.
        x: Position in world [m].
        y: Position in world [m].
        most: Largest distance of interest [m].
    """
    x0s, y0s, x1s, y1s, low_x, low_y, high_x, high_y = fence
    best = most * most
    for o in range(len(low_x)):
        dx = low_x[o] - x if x < low_x[o] else x - high_x[o] if x > high_x[o] else 0.0
        dy = low_y[o] - y if y < low_y[o] else y - high_y[o] if y > high_y[o] else 0.0
        if dx * dx + dy * dy >= best:
            continue
        for e in range(spans[o], spans[o + 1]):
            sx, sy = x1s[e] - x0s[e], y1s[e] - y0s[e]
            px, py = x - x0s[e], y - y0s[e]
            along = (px * sx + py * sy) / (sx * sx + sy * sy)
            if along > 1.0:
                along = 1.0
            if along > 0.0:
                px, py = px - along * sx, py - along * sy
            away2 = px * px + py * py
            if away2 < best:
                best = away2
    return math.sqrt(best)


def free_way(
    fence: Columns, spans: Sequence[int], radius: float, x: float, y: float, ux: float, uy: float, way: float
) -> float:
    """Distance that a round footprint can go in a direction until it touches an obstacle, at most `way` [m].

    The centre of the footprint meets outlines grown by the radius: sides pushed out, a circle about every
    corner. Obstacles that it already touches count only if it comes nearer.

    Args:
        fence: As for `clearance`.
        spans: As for `clearance`.
        radius: Radius of the footprint [m].
        x: Position of its centre in world [m].
        y: Position of its centre in world [m].
        ux: Direction, a unit vector.
        uy: Direction, a unit vector.
        way: Wanted distance [m].
    """
    x0s, y0s, x1s, y1s, low_x, low_y, high_x, high_y = fence
    reach = radius + way
    for o in range(len(low_x)):
        if x < low_x[o] - reach or x > high_x[o] + reach or y < low_y[o] - reach or y > high_y[o] + reach:
            continue
        for e in range(spans[o], spans[o + 1]):
            px, py = x - x0s[e], y - y0s[e]
            nearing = px * ux + py * uy
            if nearing < -GRAZE * radius:
                beyond = px * px + py * py - radius * radius
                within = nearing * nearing - beyond
                if beyond <= 0.0:
                    way = 0.0
                elif within > 0.0:
                    until = -nearing - math.sqrt(within)
                    if until < way:
                        way = until
            sx, sy = x1s[e] - x0s[e], y1s[e] - y0s[e]
            length = math.sqrt(sx * sx + sy * sy)
            nearing = (ux * sy - uy * sx) / length  # outward, as outlines are anticlockwise
            height = (px * sy - py * sx) / length
            if nearing < -GRAZE and height > 0.0:
                until = (height - radius) / -nearing
                if until < 0.0:
                    until = 0.0
                if until < way:
                    along = (px + until * ux) * sx + (py + until * uy) * sy
                    if 0.0 <= along <= length * length:
                        way = until
    return way
