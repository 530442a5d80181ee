"""What small commands cost: processor time, as a ratio to that of importing numpy, OpenUSD and numba.

The commands take turns in rounds, so that a busy machine slows all alike, after one round that fills caches.
Medians over the rounds. A ratio above its goal is marked, and the exit status is 1.

    python benchmarks/startup.py [rounds]
"""

import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

BASE = ["-c", "import numpy, pxr.Usd, numba"]

COMMANDS = {
    "run lab --duration-s 20 --out y.parquet": 2.5,
    "run lab --duration-s 20 --out run": 6.0,
    "scene lab --out lab": 6.0,
    "report x.parquet --out report.html": 4.0,
    "localize x.parquet --map lab --out localized": 5.0,
    "info x.parquet": 1.3,
}
"""Commands and the most that their ratio may be."""


def processor_s(arguments: list[str], folder: Path) -> float:
    """Processor time of Python with some arguments and of its children [s]."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    child = [sys.executable, *arguments]
    subprocess.run(child, cwd=folder, env=environment, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    ways = {"": BASE}
    for command in COMMANDS:
        force = [] if command.startswith("info") else ["--force"]
        ways[command] = ["-m", "magtwin", *command.split(), *force, "--quiet"]
    times: dict[str, list[float]] = {name: [] for name in ways}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        processor_s([*ways["run lab --duration-s 20 --out y.parquet"], "--out", "x.parquet"], folder)
        for k in range(rounds + 1):
            for command, arguments in ways.items():
                spent = processor_s(arguments, folder)
                times[command] += [spent] if k else []
    base = statistics.median(times.pop(""))
    print(f"{'':46}{'s':>7}{'ratio':>8}{'goal':>7}\n{'numpy, OpenUSD and numba':46}{base:7.2f}{1:8.2f}")
    late = False
    for command, spent in times.items():
        ratio, goal = statistics.median(spent) / base, COMMANDS[command]
        late |= ratio > goal
        print(f"{command:46}{ratio * base:7.2f}{ratio:8.2f}{goal:7.1f}{'  above' if ratio > goal else ''}")
    sys.exit(late)


if __name__ == "__main__":
    main()
