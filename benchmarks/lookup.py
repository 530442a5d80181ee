"""A map read at 1, 1,000 and 1,000,000 poses: scipy's RegularGridInterpolator and magtwin, one process.

The map is as large as the APRILab survey, 15 x 25 nodes in four headings. scipy's interpolator is given
the first layer once more at 360 degrees, and headings that lie between 0 and 360 degrees already, in the
column order that it wants; magtwin takes points and headings as they come. The ways take turns in rounds,
so that a busy machine slows all alike; medians over all calls, and least times, which a busy machine
spoils less: a million poses are 3 ms of two threads, and each may wait longer than that for a processor.
Compiled code is opened beforehand here; a program that does not ask for it gets it after twenty million
poses, and the same bytes before.

    python benchmarks/lookup.py [rounds]
"""

import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from magtwin.field.maps.lookup import LOOPS, warm_up
from magtwin.field.maps.map import AnomalyMap

WANTED = {1: 80, 1_000: None, 1_000_000: 50}
"""How many times faster than scipy, by number of poses."""

AGREES_NT = 1e-9


def field_map(rng: np.random.Generator) -> AnomalyMap:
    return AnomalyMap(
        values_nt=41_000 + 3_000 * rng.standard_normal((4, 15, 25)),
        origin_m=(-3.0, -1.75),
        cell_m=(0.25, 0.25),
        headings_rad=np.radians([0, 90, 180, 270]),
    )


def scipys(field: AnomalyMap) -> RegularGridInterpolator:
    headings = np.append(field.headings_rad, 2 * np.pi)
    values = np.concatenate([field.values_nt, field.values_nt[:1]])
    return RegularGridInterpolator((headings, field.y_m, field.x_m), values)


def plain(look: Callable[[], object]) -> Callable[[], object]:
    """The same without compiled code."""

    def without() -> object:
        opened, LOOPS.code = LOOPS.code, None
        try:
            return look()
        finally:
            LOOPS.code = opened

    return without


def ways(field: AnomalyMap, count: int, rng: np.random.Generator) -> dict[str, Callable[[], object]]:
    """Each way of reading the field at some poses."""
    x0, x1, y0, y1 = field.extent
    p = rng.uniform((x0, y0), (x1, y1), (count, 2))
    yaw = rng.uniform(0, 2 * np.pi, count)
    grid, rows = scipys(field), np.column_stack([yaw, p[:, 1], p[:, 0]])
    x, y, angle = float(p[0, 0]), float(p[0, 1]), float(yaw[0])
    at = {
        "at(), compiled": lambda: field.at(x, y, angle),
        "at(), plain Python": plain(lambda: field.at(x, y, angle)),
        "at_with_gradient()": lambda: field.at_with_gradient(x, y, angle),
        "the same, plain Python": plain(lambda: field.at_with_gradient(x, y, angle)),
    }
    return {
        "scipy": lambda: grid(rows),
        **(at if count == 1 else {}),
        "lookup(), compiled": lambda: field.lookup(p, yaw),
        "lookup(), numpy": plain(lambda: field.lookup(p, yaw)),
        "lookup_with_gradient()": lambda: field.lookup_with_gradient(p, yaw),
    }


def measure(works: dict[str, Callable[[], object]], rounds: int, calls: int) -> dict[str, list[float]]:
    """Seconds of each way, for groups of as many calls as given; each way has a tenth of a second a round."""
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(rounds + 1):
        for name, work in works.items():
            took: list[float] = []
            while sum(took) * calls < 0.1:
                start = time.perf_counter()
                for _ in range(calls):
                    work()
                took.append((time.perf_counter() - start) / calls)
            seconds[name] += took if turn else []  # the first is warm-up
    return seconds


def main(rounds: int = 7) -> None:
    rng = np.random.default_rng(0)
    field = field_map(rng)
    LOOPS.pays = float("inf")  # so that numpy stays numpy
    start = time.perf_counter()
    warm_up()
    print(f"compiled code opened in {time.perf_counter() - start:.2f} s; {rounds} rounds")
    for count, wanted in WANTED.items():
        works = ways(field, count, rng)
        took = measure(works, rounds, calls=max(1, 2_000 // count))
        want = np.asarray(works["scipy"]())
        size = f"{count:,} pose{'s' * (count > 1)}"
        aim = f"  wanted: {wanted} times scipy" if wanted else ""
        print(f"\n{size:24}{'median, ns a pose':>20}{'least':>10}{'x scipy':>10}{'least':>8}{aim}")
        for name, seconds in took.items():
            got = works[name]()
            b = np.asarray(got[0] if isinstance(got, tuple) else got).reshape(-1)
            off = np.abs(b - want).max()
            median, least = statistics.median(seconds), min(seconds)
            ratios = statistics.median(took["scipy"]) / median, min(took["scipy"]) / least
            print(
                f"{name:24}{median / count * 1e9:20,.1f}{least / count * 1e9:10,.1f}{ratios[0]:10.1f}"
                f"{ratios[1]:8.1f}  largest difference {off:.1e} nT"
            )
            if off > AGREES_NT:
                sys.exit(f"{name} differs from scipy by {off:.2e} nT, more than {AGREES_NT:g} nT")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
