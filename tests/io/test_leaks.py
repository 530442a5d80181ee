"""Saving a run leaves nothing in the process, however often it is done."""

import json
import subprocess
import sys

import pytest

FORMATS = ("rrd", "parquet", "mcap", "csv", "npz", "usdc")

SAVES = """
import gc, json, os, sys
from pathlib import Path
import numpy as np
from magtwin.run.run import Run

t = np.arange(50) / 10
pose = {"p_world_base": np.stack([t, t, 0 * t], 1), "q_world_base_xyzw": np.tile([0.0, 0, 0, 1], (50, 1))}
run = Run({"t": t, "b_total_nt": 45_000 + t, **pose}, {"seed": 1})

def state():
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    memory = pages * os.sysconf("SC_PAGE_SIZE")
    return len(os.listdir("/proc/self/task")), len(os.listdir("/proc/self/fd")), memory

states = {}
for suffix in sys.argv[1:]:
    for k in range(15):
        run.save(f"run.{suffix}", force=True)
        if k == 4:
            fifth = state()
    states[suffix] = fifth, state()
print(json.dumps(states))
"""

MOST = 20e6
"""Growth in ten saves [bytes]: above what an allocator keeps, half of what a recording once left in each."""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="threads and files are counted in /proc")
def test_ten_more_saves_leave_as_many_threads_and_open_files_and_no_memory(tmp_path):
    command = [sys.executable, "-c", SAVES, *FORMATS]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    states = json.loads(done.stdout)
    assert set(states) == set(FORMATS)
    for suffix, (fifth, last) in states.items():
        assert last[:2] == fifth[:2], suffix
        assert last[2] - fifth[2] < MOST, suffix
