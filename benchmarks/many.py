"""Many robots through the neural magnetometer, against the network alone; and the closed loop of many.

Each robot drives a figure of eight for 60 s at 135 Hz, 8,100 readings, with a seed and a session of its own,
through a 20-512-512-512-512-1 network. The yardstick is the network's `predict` on as many rows, in the
chunking that the runs use: what a data set costs when its inputs are there already. Kept are poses and
readings, as for a map or a filter; `--exact` keeps every column. Both are measured in turn in one process,
by the clock and by the processors' time, which other work on the machine disturbs less; ratios are medians
over repetitions. Then the closed loop alone, compiled, for 10 to 10,000 robots. Weights are random: how long
a product takes does not depend on them.

    python benchmarks/many.py [--robots 100] [--repetitions 3] [--most 10000]
"""

import argparse
import math
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from magtwin.author.scene import author_scene
from magtwin.files.file import shipped
from magtwin.learn.data.features import FULL
from magtwin.learn.data.inputs import inputs_of
from magtwin.learn.training.module import NetModule
from magtwin.path import path_named
from magtwin.sim.motion.closed_loop import run_loops, warm_up
from magtwin.sim.motion.drive import draw_wheel_errors
from magtwin.sim.motion.follow import loop_along
from magtwin.sim.session import draw_session
from magtwin.twin import Twin, open_twin, scene_from_toml, sweep

DURATION_S, RATE_HZ = 60.0, 135.0
HIDDEN = (512, 512, 512, 512)
KEPT = ("b_total_nt", "b_measured_nt", "p_world_base", "yaw")


def seconds(work: Callable[[], object]) -> tuple[float, float]:
    """What it takes by the clock, and of all processors."""
    start, cpu = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - start, time.process_time() - cpu


def lab_twin(folder: Path) -> Twin:
    net = folder / "random.safetensors"
    torch.manual_seed(0)
    NetModule(inputs_of(np.eye(len(FULL)), FULL), HIDDEN).net().save(net)
    scene = scene_from_toml(shipped("scenes", "lab.toml"), network=net)
    return open_twin(author_scene(scene, folder / "lab"))


def beside_the_network(twin: Twin, robots: int, repetitions: int, exact: bool) -> None:
    network = twin.magnetometer
    assert network is not None
    specs = [draw_session(twin.scene.robot, np.random.default_rng(k)) for k in range(robots)]
    rows = int(DURATION_S * RATE_HZ)
    kept = None if exact else KEPT
    x = np.random.default_rng(0).standard_normal((16 * rows, len(network.features)))

    def alone() -> None:
        for first in range(0, robots, 16):
            network.net.predict(x[: rows * min(16, robots - first)])

    def whole() -> None:
        runs = sweep(
            twin, "figure8", range(robots), robots=specs, columns=kept, duration_s=DURATION_S, rate_hz=RATE_HZ
        )
        for _ in runs:
            pass

    network.net.predict(x[:rows])
    warm_up()
    ratios, best = [], math.inf
    for k in range(repetitions):
        (ours, our_cpu), (theirs, their_cpu) = seconds(whole), seconds(alone)
        ratios.append((ours / theirs, our_cpu / their_cpu))
        best = min(best, ours)
        print(
            f"  {k + 1}: {ours:.2f} s for the runs, {theirs:.2f} s for the network: {ours / theirs:.3f}; "
            f"of processors {our_cpu:.2f} and {their_cpu:.2f} s: {our_cpu / their_cpu:.3f}"
        )
    clock, cpu = (statistics.median(ratio[k] for ratio in ratios) for k in (0, 1))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6  # Linux has it in kB
    print(
        f"{robots} robots x {DURATION_S:g} s x {RATE_HZ:g} Hz: {clock:.3f} times the network alone by the "
        f"clock, {cpu:.3f} times of processors; wanted: at most 1.10\n"
        f"{robots / best:.1f} robots a second, {robots * DURATION_S / best:,.0f} times real time; memory at "
        f"its peak {peak:.2f} GB, Python, torch and the stage among it"
    )


def loop_alone(twin: Twin, most: int) -> None:
    drive = twin.scene.robot.drive
    course = loop_along(path_named("figure8"), drive, speed=0.2, duration_s=DURATION_S)
    rng = np.random.default_rng(0)
    print(f"the closed loop alone, {course.steps:,} steps a robot:")
    count = 10
    while count <= most:
        courses = [replace(course, wheel_errors=draw_wheel_errors(drive, rng)) for _ in range(count)]

        def work(courses: list = courses) -> None:
            for first in range(0, len(courses), 500):  # what they did is not kept
                run_loops(courses[first : first + 500])

        took, cpu = min(seconds(work) for _ in range(3 if count < 10_000 else 1))
        print(
            f"  {count:6,} robots: {took:8.4f} s, {took / count * 1e6:7.1f} us a robot, "
            f"{cpu / count * 1e6:7.1f} us of processors"
        )
        count *= 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--most", type=int, default=10_000, help="robots of the closed loop alone")
    parser.add_argument("--exact", action="store_true", help="keep every column")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        twin = lab_twin(Path(folder))
        beside_the_network(twin, options.robots, options.repetitions, options.exact)
        loop_alone(twin, options.most)


if __name__ == "__main__":
    main()
