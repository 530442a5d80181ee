"""Twins and the sessions that their robots are in."""

import numpy as np
import pytest

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files import shipped
from magtwin.twin import in_session, open_twin, simulate, simulate_many


def test_a_run_is_in_a_session_of_its_seed_unless_another_is_chosen(lab_scene):
    twin = open_twin(lab_scene, magnetometer="physical")
    short = {"duration_s": 60.0, "rate_hz": 5.0, "lidar": "off"}
    first = simulate(twin, seed=3, **short)
    assert (first.metadata["session"], first.metadata["session_seed"]) == (0, 3)
    same = simulate(in_session(twin, 0, seed=3), seed=3, **short)
    assert all(first[name].tobytes() == same[name].tobytes() for name in first)
    other = simulate(twin, seed=3, session=1, **short)
    surveyed = simulate(twin, seed=3, session="survey", **short)
    assert surveyed.metadata["session"] == "survey"
    assert "session_seed" not in surveyed.metadata
    offsets = [float(np.mean(run["b_total_nt"] - run["b_map_nt"])) for run in (first, other, surveyed)]
    assert min(offsets[0], offsets[1]) - offsets[2] > 200  # hard_iron_drift_nt since the survey
    assert offsets[0] != offsets[1]


def test_a_session_that_is_none_is_refused(lab_scene):
    twin = open_twin(lab_scene, magnetometer="physical")
    for session in (-1, 0.5, "monday", True):
        with pytest.raises(InputError, match='session must be a whole number from 0 up, or "survey"'):
            in_session(twin, session)
    with pytest.raises(InputError, match="in session 2 already"):
        simulate(in_session(twin, 2), session="survey")
    with pytest.raises(InputError, match="give robots or session, not both"):
        simulate_many(twin, "figure8", [1], session=1, robots=twin.scene.robot)


def test_a_network_for_a_magnetometer_that_reads_none_is_refused(lab_scene):
    with pytest.raises(InputError, match="net is for a neural magnetometer, not for 'physical'"):
        open_twin(lab_scene, net=shipped("weights", "turtlebot4_paper.safetensors"), magnetometer="physical")


def test_a_survey_in_millimetres_is_doubted(tmp_path, capsys):
    rng = np.random.default_rng(1)
    p, yaw = rng.uniform(-2500, 2500, (300, 2)), rng.uniform(-3, 3, 300)
    rows = np.column_stack([p, yaw, 45_000 + 50 * np.sin(p[:, 0] / 400)])
    np.savetxt(tmp_path / "mm.csv", rows, delimiter=",", header="x,y,yaw,b", comments="")
    main(["map", "fit", str(tmp_path / "mm.csv"), "--method", "trilinear", "--out", str(tmp_path / "m.usdc")])
    assert "are their positions in metres?" in capsys.readouterr().out
