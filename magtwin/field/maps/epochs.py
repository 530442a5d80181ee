"""Epochs: one map surveyed on several days, the field between them, and its drift."""

import datetime
import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from magtwin.errors import InputError
from magtwin.field.days import day_number, parse_day
from magtwin.field.maps.map import OFFSET, AnomalyMap
from magtwin.report import Figure, Report

# What all epochs of a map share, besides the number of nodes
COMMON = ("headings_rad", "origin_m", "cell_m", "frame", "datum", "height_m")
GRAIN = 1e-9  # Lengths [m] and angles [rad] closer than this are equal


def day_of(field: AnomalyMap) -> datetime.date:
    """The day of a map.

    Raises:
        InputError: It is unknown.
    """
    if field.created == "":
        raise InputError(
            f"map {field.name!r} has no day; give it when the map is made (--created YYYY-MM-DD)"
        )
    return parse_day(field.created, f"created of map {field.name!r}")


def in_order(maps: Sequence[AnomalyMap]) -> tuple[AnomalyMap, ...]:
    """Sort maps of one floor by day.

    Args:
        maps: Two or more, each with its day in `created`.

    Raises:
        InputError: There are fewer than two, a day is missing or occurs twice, or nodes, frame, datum or
            height differ.
    """
    if len(maps) < 2:
        raise InputError(f"epochs of a map are two at least, got {len(maps)}; save_map keeps a single one")
    days = [day_of(m) for m in maps]
    order = sorted(range(len(maps)), key=lambda k: days[k])
    for early, late in itertools.pairwise(order):
        if days[early] == days[late]:
            raise InputError(
                f"maps {maps[early].name!r} and {maps[late].name!r} are both of {days[late]}; an epoch is a "
                "day, so keep one of the two"
            )
    first = maps[order[0]]
    for other in (maps[k] for k in order[1:]):
        for name in COMMON:
            mine, theirs = getattr(first, name), getattr(other, name)
            if not _same(mine, theirs):
                mine, theirs = (v.tolist() if isinstance(v, np.ndarray) else repr(v) for v in (mine, theirs))
                raise InputError(
                    f"epochs lie on one grid, but {name} is {mine} on {first.created} and {theirs} on "
                    f"{other.created}; fit or survey both on one grid"
                )
        if first.values_nt.shape != other.values_nt.shape:
            raise InputError(
                f"epochs lie on one grid, but there are {first.values_nt.shape} nodes on {first.created} "
                f"and {other.values_nt.shape} on {other.created}; fit or survey both on one grid"
            )
    return tuple(maps[k] for k in order)


def at_date(maps: Sequence[AnomalyMap], date: str | datetime.date) -> AnomalyMap:
    """The map of a day: an epoch, or the linear interpolation in time between two epochs.

    B = (1 - w) B_0 + w B_1, where w is the elapsed share of the time. The surveys' errors are independent, so
    the variance is (1 - w)^2 V_0 + w^2 V_1. It is below that of either epoch between them, which holds if the
    field drifted evenly. A node is valid if it is valid on both days. An interpolated map has no harmonic
    field, since magnitudes are interpolated, not vectors.

    Args:
        maps: One map, or epochs from `in_order`.
        date: The day, or YYYY-MM-DD.

    Raises:
        InputError: It is not a day, or outside the epochs.
    """
    day = parse_day(date)
    days = [day_of(m) for m in maps]
    if not days[0] <= day <= days[-1]:
        span = f"is of {days[0]} only" if len(days) == 1 else f"reaches from {days[0]} to {days[-1]}"
        raise InputError(f"date {day} lies beyond the map {maps[-1].name!r}, which {span}")
    k = int(np.searchsorted([d.toordinal() for d in days], day.toordinal()))
    if days[k] == day:
        return maps[k]
    before, after = maps[k - 1], maps[k]
    w = (day - days[k - 1]) / (days[k] - days[k - 1])
    variance = error = None
    if before.variance_nt2 is not None and after.variance_nt2 is not None:
        variance = (1 - w) ** 2 * before.variance_nt2 + w**2 * after.variance_nt2
        if before.between_nt2 is not None and after.between_nt2 is not None:
            error = (1 - w) * before.between_nt2 + w * after.between_nt2  # alike on both days
    parameters = before.parameters
    if before.parameters != after.parameters:
        offset = float(np.hypot((1 - w) * before.offset_sd_nt, w * after.offset_sd_nt))
        parameters = {OFFSET: offset} if offset else {}
    between = f"linear in time between {before.created} and {after.created}"
    return replace(
        after,
        values_nt=(1 - w) * before.values_nt + w * after.values_nt,
        variance_nt2=variance,
        between_nt2=error,
        valid=before.valid & after.valid,
        method=f"{_joined(before.method, after.method)}; {between}",
        source=_joined(before.source, after.source),
        licence=_joined(before.licence, after.licence),
        created=day.isoformat(),
        parameters=parameters,
        harmonic=None,
        recorded_yaw=None,
    )


def drift(maps: Sequence[AnomalyMap]) -> Report:
    """Drift of the field at the nodes that are valid on every day.

    A node's drift is the slope of the least-squares line through its values. Its standard deviation follows
    from the variances, if every epoch has them.

    Args:
        maps: Epochs from `in_order`.

    Returns:
        Days, mean drift with its spread over the nodes, and the largest drift with place and standard
        deviation [nT/day].
    """
    days = np.array([day_number(day_of(m)) for m in maps], float)
    figures = [
        Figure("epochs", len(maps), note=", ".join(m.created for m in maps)),
        Figure("span", int(days[-1] - days[0]), "days"),
    ]
    valid = np.logical_and.reduce([m.valid for m in maps])
    if valid.any():
        weight = (days - days.mean()) / np.sum((days - days.mean()) ** 2)
        slope = sum(w * np.where(valid, m.values_nt, 0.0) for w, m in zip(weight, maps, strict=True))
        known = slope[valid]
        note = "mean and spread over the nodes"
        figures.append(Figure("drift", float(known.mean()), "nT/day", float(known.std()), note))
        h, j, i = np.unravel_index(np.argmax(np.where(valid, np.abs(slope), -1.0)), slope.shape)
        sd = None
        variances = [m.variance_nt2 for m in maps]
        if all(v is not None for v in variances):
            sd = float(np.sqrt(sum(w**2 * v[h, j, i] for w, v in zip(weight, variances, strict=True))))  # type: ignore[index]
        m = maps[0]
        where = f"at ({m.x_m[i]:g}, {m.y_m[j]:g}) m, heading {np.degrees(m.headings_rad[h]):g} deg"
        figures.append(Figure("greatest drift", float(slope[h, j, i]), "nT/day", sd, where))
    return Report(f"drift of map {maps[-1].name}", tuple(figures))


def _same(a: Any, b: Any) -> bool:
    """Whether texts are equal, and lengths and angles up to rounding."""
    if isinstance(a, str) or a is None or b is None:
        return a == b
    return np.shape(a) == np.shape(b) and bool(np.allclose(a, b, rtol=0, atol=GRAIN))


def _joined(first: str, second: str) -> str:
    return first if first == second else "; ".join(text for text in (first, second) if text)
