"""How a benchmark scales with jobs on this machine, against one job.

Printed for 1, 2, 4, ... jobs up to the number of processors: elapsed time and processor time of the workers,
both relative to one job, and the largest memory of a worker. On a machine that has other work, only the
processor times mean anything. At last the cost of a chunk that does nothing.

    python benchmarks/cluster.py [runs per scenario]
"""

import resource
import subprocess
import sys
import tempfile
import time

from magtwin.bench.runner import benchmark
from magtwin.parallel import open_pool, processors

LOCALIZERS = ("odometry", "rbpf", "rbpf-iron")


def main() -> None:
    if len(sys.argv) == 3:  # one measurement, in a process of its own
        jobs, runs = map(int, sys.argv[1:])
        measure(jobs, runs)
        return
    runs = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    jobs, alone = 1, None
    print(f"{2 * runs * len(LOCALIZERS)} runs of the standard suite")
    while jobs <= processors():
        command = [sys.executable, __file__, str(jobs), str(runs)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        elapsed_s, processor_s, memory_mb = map(float, done.stdout.split())
        alone = alone or (elapsed_s, processor_s)
        speed, cost = alone[0] / elapsed_s, processor_s / alone[1]
        print(
            f"{jobs:3} jobs: {elapsed_s:6.1f} s, {speed:.2f} times as fast; processors {processor_s:6.1f} s, "
            f"{cost:.2f} times as much; {memory_mb:.0f} MB a worker"
        )
        jobs *= 2
    with open_pool(1) as pool:
        list(pool.run(abs, [0]))
        start = time.monotonic()
        list(pool.run(abs, range(5000)))
        print(f"a chunk that does nothing takes {(time.monotonic() - start) / 5000 * 1e6:.0f} us")


def measure(jobs: int, runs: int) -> None:
    """Print elapsed time [s], processor time of the workers [s] and their largest memory [MB]."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.monotonic()
        options = {"scenarios": ("exact", "tracking"), "localizers": LOCALIZERS, "runs": runs}
        benchmark("standard", f"{folder}/results", jobs=jobs, **options)
        elapsed_s = time.monotonic() - start
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    print(elapsed_s, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


if __name__ == "__main__":
    main()
