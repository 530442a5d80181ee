"""Plants in runs: truth columns, every way to simulate, sessions, metadata, TOML and the command line."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.author.robot import PlantTable
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.io.provenance import repeat, repeat_of
from magtwin.io.tables import read_parquet
from magtwin.learn.data.recording import session_name
from magtwin.run.run import Run
from magtwin.sim.plant_families import PLANTS, draw_plant
from magtwin.sim.runs.live import LiveRobot
from magtwin.spec.plant import PlantSpec
from magtwin.twin import (
    author_scene,
    in_session,
    open_twin,
    scene_from_toml,
    simulate,
    simulate_robots,
    sweep,
    with_plant,
)

BRIEF = {"duration_s": 12.0, "rate_hz": 20.0, "lidar": "on"}
EFFECTIVE = [name for name in PLANTS if name != "nominal"]


@pytest.fixture(scope="module")
def plain(twin) -> Run:
    return simulate(twin, "figure8", seed=3, **BRIEF)


def added_nt(run: Run, plain: Run) -> np.ndarray:
    return run["b_truth_nt"] - plain["b_truth_nt"]


def same(a: Run, b: Run) -> bool:
    return all(a[name].tobytes() == b[name].tobytes() for name in a) and dict(a.metadata) == dict(b.metadata)


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


def test_a_surveyed_map_as_truth_takes_a_plant_too(twin):
    bare = replace(twin, scene=replace(twin.scene, earth=None, sources=(), furniture=()))
    runs = [simulate(bare, "figure8", seed=3, plant=p, **BRIEF) for p in (None, "hysteresis")]
    assert np.abs(added_nt(runs[1], runs[0])).max() > 20


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


def test_a_sweep_makes_the_runs_that_simulate_makes(twin):
    runs = sweep(twin, ["figure8", "sine"], 3, seed=7, plant="all:2", duration_s=3.0, rate_hz=20.0)
    for k, run in enumerate(runs):
        options = {"seed": 7 + k, "plant": "all:2", "duration_s": 3.0, "rate_hz": 20.0}
        assert same(run, simulate(twin, ("figure8", "sine")[k % 2], **options))
    names = {"t", "b_truth_nt"}
    thin = sweep(twin, "figure8", 1, seed=7, plant="all:2", columns=names, duration_s=3.0, rate_hz=20.0)[0]
    assert_array_equal(thin["b_truth_nt"], runs[0]["b_truth_nt"])


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


def test_gym_steps_robots_with_a_plant_together_as_each_alone(twin):
    gym = pytest.importorskip("magtwin.gym", reason="needs the extra gym")
    readings = []
    for plant in ("all", None):
        env = gym.MagNavVectorEnv(2, scene=twin, plant=plant, duration_s=5.0)
        env.reset(seed=4)
        together = [env.stepped.columns["b_total_nt"].copy()]
        for _ in range(30):
            env.step(np.array([[0.2, 0.4], [0.1, -0.5]], np.float32))
            together.append(env.stepped.columns["b_total_nt"].copy())
        readings.append(np.array(together))
    assert np.abs(readings[0] - readings[1]).max() > 20
    alone = gym.MagNavVectorEnv(1, scene=twin, plant="all", duration_s=5.0)
    alone.reset(seed=5)  # the seed of the second
    single = [alone.stepped.columns["b_total_nt"][0]]
    for _ in range(30):
        alone.step(np.array([[0.1, -0.5]], np.float32))
        single.append(alone.stepped.columns["b_total_nt"][0])
    assert_allclose(single, readings[0][:, 1], rtol=1e-12)


def test_sessions_of_one_plant_differ_less_than_plants_of_a_family(twin):
    options = {"duration_s": 6.0, "rate_hz": 5.0, "seed": 3}

    def mean_nt(plant: str, session: int) -> float:
        with_it, without = (
            simulate(twin, "figure8", session=session, plant=p, **options) for p in (plant, None)
        )
        return float(np.mean(added_nt(with_it, without)))

    sessions = [mean_nt("hysteresis:1", k) for k in range(4)]
    worlds = [mean_nt(f"hysteresis:{k}", 0) for k in range(4)]
    assert 0 < np.std(sessions) < np.std(worlds)


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


def test_the_scenes_own_plant_survives_the_stage_and_an_argument_replaces_it(twin, lab_scene, tmp_path):
    scene = replace(twin.scene, robot=replace(twin.scene.robot, plant=draw_plant("all", 5)))
    opened = open_twin(author_scene(scene, tmp_path / "planted"))
    assert opened.scene.robot.plant == draw_plant("all", 5)
    run = simulate(opened, "figure8", seed=3, **BRIEF)
    assert run.metadata["plant"] == "of the scene"
    assert repeat(run).equal
    given = simulate(twin, "figure8", seed=3, plant="all:5", **BRIEF)
    assert_array_equal(run["b_truth_nt"], given["b_truth_nt"])
    without = simulate(opened, "figure8", seed=3, plant="nominal", **BRIEF)
    assert repeat(without).equal
    assert np.abs(added_nt(run, without)).max() > 20


def test_a_toml_names_a_family_or_gives_figures(tmp_path):
    def robot_of(lines: str):
        file = tmp_path / "room.toml"
        earth = "[earth]\nlatitude_deg = 29.6\nlongitude_deg = -82.3\nheight_m = 30\ndate = '2026-01-01'\n"
        file.write_text(
            "name = 'room'\n[robot]\nasset = 'turtlebot4'\n[robot.plant]\n" + lines + "\n" + earth
            + "[[source]]\nname = 'beam'\np_world = [1.0, 0.5, -0.2]\nm_world = [1.0, 0.0, 2.0]\n"
        )  # fmt: skip
        return scene_from_toml(file).robot

    assert robot_of("family = 'warm-up'\nseed = 3").plant == draw_plant("warm-up", 3)
    assert robot_of(
        "moving_moment = [0.1, 0.0, 0.0]\np_magnetometer_moving = [0.2, 0.0, 0.0]"
    ).plant == PlantSpec(moving_moment=(0.1, 0.0, 0.0), p_magnetometer_moving=(0.2, 0.0, 0.0))
    for lines, text in (
        ("family = 'warmup'", "did you mean 'warm-up'"),
        ("family = 'all'\npan_range = 1.0", "family of PlantTable must come without figures"),
        ("family = 'all'\nseed = -1", "seed of a plant"),
        ("pan_rang = 1.0", "unknown key 'pan_rang'"),
    ):
        with pytest.raises(InputError, match=text):
            robot_of(lines)
    assert PlantTable().spec == PlantSpec()


def test_a_plant_comes_before_the_session_and_not_beside_robots(twin):
    with pytest.raises(InputError, match="already; give `plant` before the session"):
        simulate(in_session(twin, 0), "figure8", plant="all", **BRIEF)
    with pytest.raises(InputError, match="give robots or plant, not both"):
        sweep(twin, "figure8", 1, plant="all", robots=twin.scene.robot)
    with pytest.raises(InputError, match="did you mean 'hysteresis'"):
        simulate(twin, "figure8", plant="histeresis", **BRIEF)


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


def test_a_data_set_keeps_sessions_of_different_plants_apart():
    known = {"session": 3, "session_seed": 1}
    names = [
        session_name(known | more) for more in ({}, {"plant": "all:1"}, {"plant": "all:2"}, {"plant": "{}"})
    ]
    assert names[:2] == ["1-3", "1-3-all:1"]
    assert len(set(names)) == 4
    assert session_name({"plant": "all"}) == ""
