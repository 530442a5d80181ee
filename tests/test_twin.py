"""Twins and the sessions that their robots are in."""

import pickle

import numpy as np
import pytest

import magtwin
from magtwin.errors import InputError
from magtwin.twin import in_session, in_session_of, open_twin, simulate
from magtwin.twin.opening import geometry


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


def test_a_shipped_scene_is_opened_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert open_twin("lab", magnetometer="physical").scene.name == "lab"
    magtwin.author_scene("lab", tmp_path / "lab")
    assert open_twin("lab", magnetometer="physical").scene_file.as_posix() == "lab/lab.usda"
    with pytest.raises(InputError, match="no scene 'lap'; did you mean 'lab'"):
        open_twin("lap")
    with pytest.raises(InputError, match=r"author it first: magtwin scene room\.toml"):
        open_twin("room.toml")


def test_a_twin_opens_its_stage_once_and_survives_another_process(lab_scene, monkeypatch):
    twin = open_twin(lab_scene, magnetometer="physical")
    shapes, links = geometry(twin)
    copy = pickle.loads(pickle.dumps(twin))
    assert copy.opened is None
    assert geometry(copy)[1].keys() == links.keys()
    assert len(geometry(copy)[0]) == len(shapes)
    run = simulate(twin, duration_s=0.5, rate_hz=5.0)
    monkeypatch.setattr("magtwin.usd.layers.open_stage", lambda *_: pytest.fail("opened the stage again"))
    monkeypatch.setattr("magtwin.usd.scene.open_stage", lambda *_: pytest.fail("opened the stage again"))
    assert geometry(twin)[1] is links
    assert run.rows


def test_without_tracking_error_a_robot_follows_its_path_to_millimetres(lab_scene):
    exact = open_twin(lab_scene, magnetometer="map-only", tracking_error=False)
    usual = open_twin(lab_scene, magnetometer="map-only")
    line = np.array([[-1.0, 0.0], [0.5, 0.0]])
    beside = [
        np.abs(simulate(twin, line, seed=1, rate_hz=10.0)["p_world_base"][:, 1]).max()
        for twin in (exact, usual)
    ]
    assert beside[0] < 0.005 < 0.01 < beside[1] < 0.1
    run = simulate(exact, line, seed=1, rate_hz=10.0)
    assert run.metadata["tracking_error"] is False
    again = simulate(in_session_of(usual, run.metadata), line, seed=1, rate_hz=10.0)
    np.testing.assert_array_equal(again["p_world_base"], run["p_world_base"])
