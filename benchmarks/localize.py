"""The particle filter with 100,000 particles: plain numpy and magtwin, one process.

Both do the same steps of the same drive on the shipped map: 12 readings, in which resampling happens as often
as it does. The plain filter is that of the tests, with numpy's random numbers and numpy's own map lookups;
with the compiled filter's random numbers it gives the same estimates, which is checked first. The ways take
turns reading by reading, so that a busy machine slows all alike; medians over the readings of all rounds, and
least times, which a busy machine spoils less. The last column is the ratio of processor times, of all threads
together.

    python benchmarks/localize.py [rounds]
"""

import copy
import math
import statistics
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "localization"))

from drives import drive
from plain_particles import PlainFilter

from magtwin import compiled
from magtwin.field.maps.lookup import LOOPS
from magtwin.io.surveys.maps import open_map
from magtwin.localization.localizers import load_localizer
from magtwin.localization.problem import Problem, Reading, SensorModel

PARTICLES = 100_000
READINGS = 12
WANTED = {"compiled, one thread": 6, "compiled, two threads": 9}
"""How many times faster than numpy."""

CASES = {"rbpf": (SensorModel(), 0.0), "rbpf-iron": (SensorModel(iron_nt=400.0), 150.0)}
"""Sensor, and standard deviation of the map [nT], by method."""


def case(method: str) -> tuple[Problem, list[Reading]]:
    sensor, error = CASES[method]
    field = open_map(Path(__file__).parents[1] / "maps" / "lab" / "lab.usdc")
    spread = np.full(field.values_nt.shape, error**2)
    belief = type(field)(
        values_nt=field.values_nt,
        origin_m=field.origin_m,
        cell_m=field.cell_m,
        headings_rad=field.headings_rad,
        variance_nt2=spread if error else None,
    )
    u = np.arange(READINGS) * 0.04
    pose = np.column_stack([u - 1.0, 0.3 * np.sin(u), np.arctan(0.3 * np.cos(u))])
    return drive(belief, pose, 1, sensor=sensor, prior_sd=(0.1, 0.1, 0.05))


def check(method: str, problem: Problem, readings: list[Reading]) -> None:
    """Stop if the two filters differ."""
    fast = load_localizer(method, {"particles": 1000, "resets": False})
    fast.reset(problem)
    plain = PlainFilter(fast, hashed=True)
    plain.uniform = copy.deepcopy(fast._rng).random
    for reading in readings:
        a, b = fast.step(reading), plain.step(reading)
        if math.hypot(a.x - b.x, a.y - b.y) > 1e-9:
            sys.exit(f"{method}: the filters differ by {math.hypot(a.x - b.x, a.y - b.y):.1e} m")


def measure(method: str, rounds: int) -> dict[str, list[tuple[float, float]]]:
    """Seconds and processor seconds of each step, by way."""
    problem, readings = case(method)
    check(method, problem, readings)
    seconds: dict[str, list[tuple[float, float]]] = {"numpy": [], **{name: [] for name in WANTED}}
    for _ in range(rounds):
        filters = {}
        for name in seconds:
            made = load_localizer(method, {"particles": PARTICLES, "resets": False})
            made.reset(problem)
            filters[name] = PlainFilter(made, hashed=False) if name == "numpy" else made
        for reading in readings:
            for name, made in filters.items():
                compiled.MOST_THREADS = 2 if "two" in name else 1
                LOOPS.code = None  # numpy's own lookups
                start, busy = time.perf_counter(), time.process_time()
                made.step(reading)
                seconds[name].append((time.perf_counter() - start, time.process_time() - busy))
    return seconds


def main(rounds: int = 5) -> None:
    LOOPS.pays = float("inf")
    print(f"{PARTICLES:,} particles, {READINGS} readings, {rounds} rounds")
    for method in CASES:
        seconds = measure(method, rounds)
        print(f"\n{method:24}{'median, ns a particle':>22}{'least':>8}{'x numpy':>10}{'least':>8}{'cpu':>8}")
        each = 1e9 / PARTICLES
        peer = [statistics.median(column) for column in zip(*seconds["numpy"], strict=True)]
        fastest = min(seconds["numpy"])[0]
        for name, took in seconds.items():
            median, busy = (statistics.median(column) for column in zip(*took, strict=True))
            least = min(took)[0]
            wanted = f"  wanted: {WANTED[name]} times numpy" if name in WANTED else ""
            print(
                f"{name:24}{median * each:22.1f}{least * each:8.1f}{peer[0] / median:10.1f}"
                f"{fastest / least:8.1f}{peer[1] / busy:8.1f}{wanted}"
            )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
