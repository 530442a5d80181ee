"""Ten minutes of readings, from the open scene to .rrd and Parquet, against the network's bare products.

A figure of eight is driven for 10 minutes at 135 Hz (81,000 readings) through a 20-512-512-512-512-1
network. The yardstick is what no implementation on this machine can do without: the float32 matrix
products of that network on as many rows, with torch.mm, in the chunking that is fastest here. Both are
measured in turn in one process, after imports and one warm-up; the ratio is the median over repetitions.
The warm-up opens what a process opens once: the compiled loop, and the table of the lab's exact field along
the path; what that takes is printed. Weights are random: how long a product takes does not depend on them.

    python benchmarks/ten_minutes.py [repetitions]
"""

import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

import magtwin
from magtwin.author.scene import author_scene
from magtwin.files.file import shipped
from magtwin.io.rerun.file import write_rrd
from magtwin.io.tables import write_parquet
from magtwin.learn.data.features import FULL, features
from magtwin.learn.data.inputs import inputs_of
from magtwin.learn.models.perceptron import in_threads
from magtwin.learn.training.module import NetModule
from magtwin.path import path_named
from magtwin.sim.motion.closed_loop import warm_up
from magtwin.twin import Twin, open_twin, scene_from_toml, simulate

HIDDEN = (512, 512, 512, 512)
DURATION_S = 600.0
CHUNKS = (256, 512, 1024, 4096, 0)
"""Rows a product to choose the yardstick from; 0 takes all rows at once."""


def seconds(work: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    start = clock()
    work()
    return clock() - start


class Products:
    """The matrix products of the network on some rows, and nothing else."""

    def __init__(self, rows: int) -> None:
        generator = torch.Generator().manual_seed(0)
        widths = (20, *HIDDEN, 1)
        self.weights = [
            torch.randn(a, b, generator=generator) / a**0.5 for a, b in itertools.pairwise(widths)
        ]
        self.x = torch.randn(rows, widths[0], generator=generator)

    def whole(self) -> None:
        """Every product on all rows, threads inside each product."""
        x = self.x
        for weight in self.weights:
            x = torch.mm(x, weight)

    def chunked(self, chunk: int, threads: int) -> None:
        """Chunks of rows, each taken through every layer by one thread; nothing allocated between."""
        starts = itertools.count(0, chunk)  # next() on it is atomic

        def work() -> None:
            blocks = [torch.empty(chunk, weight.shape[1]) for weight in self.weights]
            for start in starts:
                x = self.x[start : start + chunk]
                if not len(x):
                    return
                for weight, block in zip(self.weights, blocks, strict=True):
                    x = torch.mm(x, weight, out=block[: len(x)])

        before = torch.get_num_threads()
        torch.set_num_threads(1)  # in each of the threads
        in_threads(work, threads)
        torch.set_num_threads(before)

    def fastest(self, threads: int) -> tuple[int, Callable[[], None]]:
        """The chunk size that is fastest here, 0 for none, and the work in it."""
        works = {chunk: self._work(chunk, threads) for chunk in CHUNKS}
        took = {chunk: min(seconds(work) for _ in range(3)) for chunk, work in works.items()}
        best = min(took, key=lambda chunk: took[chunk])
        return best, works[best]

    def _work(self, chunk: int, threads: int) -> Callable[[], None]:
        return (lambda: self.chunked(chunk, threads)) if chunk else self.whole


def lab_twin(folder: Path) -> Twin:
    """The lab that ships with magtwin, with a network of the paper's shape in its magnetometer."""
    net = folder / "random.safetensors"
    torch.manual_seed(0)
    NetModule(inputs_of(np.eye(len(FULL)), FULL), HIDDEN).net().save(net)
    return open_twin(
        author_scene(scene_from_toml(shipped("scenes", "lab.toml"), network=net), folder / "lab")
    )


def whole_job(twin: Twin, folder: Path) -> dict[str, float]:
    """Seconds of each step of the job, as a user's script takes them."""
    path = path_named("figure8")
    start = time.perf_counter()
    run = simulate(twin, path, seed=0, duration_s=DURATION_S)
    simulated = time.perf_counter()
    write_parquet(run, folder / "run.parquet", force=True)
    tabled = time.perf_counter()
    write_rrd(run, folder / "run.rrd", twin, planned=path, force=True)
    end = time.perf_counter()
    return {
        "run": simulated - start,
        "parquet": tabled - simulated,
        "rrd": end - tabled,
        "total": end - start,
    }


def parts_of_run(twin: Twin, run: magtwin.Run) -> dict[str, float]:
    """Seconds of the parts of `simulate` that can be done over on its outcome."""
    x = features(run, twin.magnetometer.features)
    return {
        "  features": seconds(lambda: features(run, twin.magnetometer.features)),
        "  network": seconds(lambda: twin.magnetometer.net.predict(x)),
        "  map": seconds(lambda: twin.field.lookup(run["p_world_base"][:, :2], run["yaw"])),
    }


def main(repetitions: int = 5) -> None:
    threads = torch.get_num_threads()
    rounds = []
    with tempfile.TemporaryDirectory() as folder:
        twin = lab_twin(Path(folder))
        opening = seconds(warm_up)
        first = seconds(lambda: simulate(twin, "figure8", seed=0, duration_s=DURATION_S))
        run = simulate(twin, "figure8", seed=0, duration_s=DURATION_S)
        products = Products(run.rows)
        chunk, bare = products.fastest(threads)
        whole_job(twin, Path(folder))  # warms up
        for _ in range(repetitions):
            took = {"bare": seconds(bare), **whole_job(twin, Path(folder)), **parts_of_run(twin, run)}
            took["bare, processors"] = seconds(bare, time.process_time)
            took["total, processors"] = seconds(lambda: whole_job(twin, Path(folder)), time.process_time)
            rounds.append(took)
        sizes = {name: (Path(folder) / name).stat().st_size / 1e6 for name in ("run.parquet", "run.rrd")}

    median = {key: statistics.median(took[key] for took in rounds) for key in rounds[0]}
    parts = [key for key in median if key.startswith("  ")]
    flop = 2 * run.rows * sum(weight.numel() for weight in products.weights)
    print(f"{run.rows:,} readings, {DURATION_S:g} s, {repetitions} repetitions, {threads} threads; medians")
    print(f"{'once: open the compiled loop':32s}{opening:8.3f} s")
    print(f"{'once: field along the path':32s}{max(first - median['run'], 0):8.3f} s")
    print(f"{'simulate and read sensors':32s}{median['run']:8.3f} s")
    for key in parts:
        print(f"{key:32s}{median[key]:8.3f} s")
    print(f"{'  drive, sensors, exact field':32s}{median['run'] - sum(median[key] for key in parts):8.3f} s")
    print(f"{'write Parquet':32s}{median['parquet']:8.3f} s  {sizes['run.parquet']:6.1f} MB")
    print(f"{'write .rrd':32s}{median['rrd']:8.3f} s  {sizes['run.rrd']:6.1f} MB")
    print(f"{'total':32s}{median['total']:8.3f} s  {DURATION_S / median['total']:6.0f} x real time")
    how = f"chunks of {chunk}" if chunk else "all rows at once"
    print(f"{f'bare products, {how}':32s}{median['bare']:8.3f} s  {flop / median['bare'] / 1e9:6.0f} GFLOP/s")
    ratios = np.array([took["total"] / took["bare"] for took in rounds])
    print(
        f"ratio {np.median(ratios):.2f} (from {ratios.min():.2f} to {ratios.max():.2f}); wanted: at most 2.00"
    )
    print(
        f"of processors, which other work on the machine disturbs less: {median['total, processors']:.2f} s, "
        f"{median['total, processors'] / median['bare, processors']:.2f} times those of the products"
    )


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
