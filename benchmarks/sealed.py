"""What the jail of a localizer costs: a process for each run, and a reading in lock-step or in a whole run.

    python benchmarks/sealed.py [repeats]

Least of the repeats, by the clock, and by the processor of both processes. The localizers do nothing, so that
what is measured is the way of a reading there and of an estimate back.
"""

import math
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from magtwin.bench.drawn import drawn_case
from magtwin.bench.sealed import Contestant, close
from magtwin.bench.suite import Entry, Scenario

CODE = """
from magtwin.localization.problem import Estimate

class Steps:
    def reset(self, problem):
        self.covariance = None

    def step(self, reading):
        return Estimate(reading.t, 0.0, 0.0, 0.0)

class Whole:
    def run(self, problem, readings):
        return [Estimate(t, 0.0, 0.0, 0.0) for t in readings["t"].tolist()]
"""


def main() -> None:
    """Print the figures."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    case = drawn_case(Scenario(name="tracking", source="drawn", duration_s=600.0, rate_hz=5.0), 4)
    count = case.readings.rows
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "nothing_at_all.py").write_text(CODE, encoding="utf-8")
        sys.path.insert(0, folder)
        for name in ("Steps", "Whole"):
            entry, took = Entry(method=f"nothing_at_all:{name}"), []
            for _ in range(repeats + 1):
                begin, before = time.perf_counter(), time.process_time()
                contestant = Contestant(entry, case.problem, 1, case.readings, 60.0)
                try:
                    contestant.load()
                    ready, mine = time.perf_counter(), time.process_time()
                    born = mine - before + time.clock_gettime(contestant.clock)
                    contestant.run(case.problem, case.readings)
                    run = time.perf_counter() - ready
                    spent = time.process_time() - mine + contestant.step_s * count
                    took.append((1e3 * (ready - begin), 1e3 * born, 1e6 * run / count, 1e6 * spent / count))
                finally:
                    contestant.end()
            child, born, clock, processor = np.min(took[1:], axis=0)
            assert math.isfinite(processor)
            print(
                f"{name:6} ready in {child:5.1f} ms; a reading {clock:5.1f} us, processor {processor:5.1f} us"
            )
        close()


if __name__ == "__main__":
    main()
