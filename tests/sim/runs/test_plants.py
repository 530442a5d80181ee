"""Plants in runs: truth columns, every way to simulate, sessions, metadata, TOML and the command line."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.io.provenance import repeat, repeat_of
from magtwin.io.tables import read_parquet
from magtwin.run.run import Run
from magtwin.sim.plant_families import PLANTS, draw_plant
from magtwin.sim.runs.live import LiveRobot
from magtwin.spec.plant import PlantSpec
from magtwin.twin import (
    in_session,
    open_twin,
    simulate,
    simulate_robots,
    with_plant,
)

BRIEF = {"duration_s": 12.0, "rate_hz": 20.0, "lidar": "on"}


@pytest.fixture(scope="module")
def plain(twin) -> Run:
    return simulate(twin, "figure8", seed=3, **BRIEF)


def added_nt(run: Run, plain: Run) -> np.ndarray:
    return run["b_truth_nt"] - plain["b_truth_nt"]


@pytest.mark.parametrize("name", PLANTS)
def test_a_plant_adds_to_the_field_and_changes_no_other_draw(twin, plain, name):
    run = simulate(twin, "figure8", seed=3, plant=name, **BRIEF)
    rms = np.sqrt(np.mean(added_nt(run, plain) ** 2))
    assert rms == 0 if name == "nominal" else 3 < rms < 2000
    assert_allclose(run["b_total_nt"], run["b_truth_nt"], atol=1e-6)
    assert_allclose(np.linalg.norm(run["b_vector_nt"], axis=1), run["b_truth_nt"], atol=1e-6)
    moved = name in ("drawn", "all")  # motion capture
    for column in plain.keys() - {c for c in plain if c.startswith("b_")}:
        if not (moved and column in ("mocap_p", "mocap_q_xyzw", "flag_pose_lost")):
            assert_array_equal(run[column], plain[column], err_msg=column)
    assert run.metadata["plant"] == name
    assert repeat(run).equal


def test_a_neural_magnetometer_reads_the_plant_beside_its_prediction(lab_scene, twin, plain):
    neural = open_twin(lab_scene)
    ours, with_it = (simulate(neural, "figure8", seed=3, plant=p, **BRIEF) for p in (None, "moving-part"))
    read = with_it["b_total_nt"] - ours["b_total_nt"]
    physical = simulate(twin, "figure8", seed=3, plant="moving-part", **BRIEF)
    assert_allclose(read, added_nt(physical, plain), atol=1e-6)
    assert np.abs(read).max() > 50
    assert_array_equal(with_it["b_model_error_nt"], ours["b_model_error_nt"])


@pytest.mark.parametrize("name", ["hysteresis", "all"])
def test_a_live_robot_reads_what_a_whole_run_reads(twin, name):
    own = in_session(with_plant(twin, name), seed=3)
    robot = LiveRobot(
        own.scene, anomaly_map=own.field, rng=np.random.default_rng(3), obstacles=own.obstacles, rate_hz=20.0
    )
    steps = [robot.step((0.2, 0.5 * np.sin(0.01 * k))) for k in range(400)]
    live = Run.concat([step for step in steps if step.rows])
    run = simulate(own, robot.commands, seed=3, duration_s=8.0, rate_hz=20.0)
    assert_allclose(live["b_truth_nt"], run["b_truth_nt"], rtol=1e-10)


def test_each_robot_of_a_scene_draws_constants_of_its_own(twin):
    second = replace(twin.scene.others[0] if twin.scene.others else _second(twin))
    pair = replace(twin, scene=replace(twin.scene, others=(second,)))
    planted = with_plant(pair, "moving-part:1")
    ours, its = planted.scene.robot.plant, planted.scene.others[0].robot.plant
    assert ours == draw_plant("moving-part", 1)
    assert its == draw_plant("moving-part", 1, which=1)
    options = {"duration_s": 2.0, "rate_hz": 20.0, "meet": "flag"}
    runs = simulate_robots(pair, plant="moving-part:1", **options)
    without = simulate_robots(pair, **options)
    for name, run in runs.items():
        assert np.abs(added_nt(run, without[name])).max() > 10
        assert run.metadata["plant"] == "moving-part:1"


def _second(twin):
    from magtwin.spec.robot import PlacedRobot

    return PlacedRobot(robot=replace(twin.scene.robot, name="other"), start=(1.0, 1.0, 0.0), path="sine")


def test_a_plant_given_as_a_spec_is_in_the_metadata_and_the_run_comes_out_again(twin, tmp_path):
    spec = PlantSpec(lidar_speed_nt_s_m=(0.0, 0.0, 400.0), warm_up_s=(50.0,), warm_up_nt=(1.0, 2.0, 300.0),
                     warm_up_soft_iron=(0.0,))  # fmt: skip
    run = simulate(twin, "figure8", seed=3, session="survey", plant=spec, **BRIEF)
    file = tmp_path / "run.parquet"
    run.save(file)
    assert repeat_of(file).equal
    damaged = run.with_metadata(plant='{"warm_up_s": 3}')
    with pytest.raises(InputError, match="warm_up_s must be"):
        repeat(damaged)


def test_commands_take_a_plant_and_reproduce_takes_it_from_the_run(
    lab_scene, twin, tmp_path, monkeypatch, capsys
):
    monkeypatch.setenv("MAGTWIN_RUN_RATE_HZ", "20")
    out = tmp_path / "run.parquet"
    options = ["--plant", "nonlinear:2", "--magnetometer", "physical", "--duration-s", "2"]
    main(["run", str(lab_scene), "--out", str(out), "--path", "figure8", *options])
    run = read_parquet(out)
    own = simulate(twin, "figure8", plant="nonlinear:2", duration_s=2.0, rate_hz=20.0)
    assert all(run[name].tobytes() == own[name].tobytes() for name in own)
    main(["reproduce", str(out)])
    assert "yes" in capsys.readouterr().out
    main(["sweep", str(lab_scene), "--out", str(tmp_path / "set"), "--count", "1", *options])
    assert read_parquet(tmp_path / "set" / "run_00000.parquet").metadata["plant"] == "nonlinear:2"
