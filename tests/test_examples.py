"""The example scripts run as they stand, are short, and do the common jobs with one import of magtwin."""

import os
import re
import subprocess
import sys

import pytest
from notebook import page
from places import ROOT

JOBS = sorted((ROOT / "examples").glob("*.py"))
EXTENSIONS = sorted((ROOT / "examples" / "extend").glob("*.py"))


@pytest.mark.parametrize("script", [*JOBS, *EXTENSIONS], ids=lambda path: path.stem)
def test_an_example_runs_in_an_empty_folder_and_prints_a_result(script, tmp_path):
    env = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONWARNINGS": "default"}
    done = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip()


def test_the_eight_common_jobs_need_one_import_of_magtwin_and_at_most_25_lines():
    assert len(JOBS) == 8
    for script in JOBS:
        text = script.read_text(encoding="utf-8")
        assert re.findall(r"^(?:import|from) magtwin.*$", text, re.MULTILINE) == ["import magtwin as mt"]
        assert len(text.splitlines()) <= 25, script


def test_each_extension_point_has_an_example():
    names = {"sensor", "interference", "path", "controller", "engine", "map_method", "predictor", "localizer"}
    assert {script.stem for script in EXTENSIONS} == names


def test_the_tutorial_shows_the_class_of_the_localizer_example():
    tutorial = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
    example = (ROOT / "examples" / "extend" / "localizer.py").read_text(encoding="utf-8")
    (shown,) = re.findall(r"^```python\n(.*?)^```$", tutorial, re.MULTILINE | re.DOTALL)
    of_magtwin = re.findall(r"^from magtwin\.localization\..*\n", example, re.MULTILINE)
    (written,) = re.findall(r"^class .*?(?=\n\n\n)", example, re.MULTILINE | re.DOTALL)
    assert shown == "import numpy as np\n\n" + "".join(of_magtwin) + "\n\n" + written + "\n"


def test_the_notebook_runs_and_shows_rooms_maps_and_runs_within_3_mb(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown = page(ROOT / "examples" / "notebook.ipynb")
    assert len(shown) < 3_000_000
    assert shown.count("data:image/png;base64,") == 5
    assert "MismatchWarning: moved.usda: has changed since its map" in shown
    assert "nT rms" in shown
