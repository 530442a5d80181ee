"""A few full disks and kills; `make faults` tries all of them."""

import json
import subprocess
import sys
from pathlib import Path

import pytest


def test_a_full_disk_or_a_kill_leaves_old_or_new_outputs(tmp_path):
    words = ["new", "schema", "--full", "6", "--kills", "6", "--json", tmp_path / "results.json"]
    program = Path(__file__).with_name("faults.py")
    done = subprocess.run([sys.executable, program, *words], capture_output=True, text=True, check=False)
    if done.returncode == 77:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stdout + done.stderr
    results = json.loads((tmp_path / "results.json").read_text())
    assert [(result["command"], result["faults"]) for result in results] == [("new", []), ("schema", [])]
    assert all(result["full"] >= 3 and result["kills"] >= 3 for result in results)
