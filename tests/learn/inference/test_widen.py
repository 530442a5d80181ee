"""Intervals on robots that a model was not trained on: learned, kept in its file, used on other robots."""

import json

import numpy as np
import onnxruntime
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_calibrate import FIELD
from test_network import a_net

import magtwin as mt
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files.file import sha256, shipped
from magtwin.learn.data.inputs import inputs_of
from magtwin.learn.data.origin import same_robot
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.learn.inference.onnx import export_onnx
from magtwin.learn.inference.reader import Reader
from magtwin.learn.models.calibration import Spread
from magtwin.learn.models.linear import Linear
from magtwin.learn.models.predictor import load_predictor
from magtwin.report.verdict import ONLY_OWN, OTHERS, OWN, Z_90, Tally
from magtwin.run.run import Run
from magtwin.tasks.learning import widen

HYBRID = shipped("weights", "turtlebot4_hybrid.safetensors")


def a_robot(seed):
    """A drive whose disturbance is 300 nT, 80 nT a m/s, an offset of the robot of 200 nT sd, and noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 60, 0.25)
    speed = 0.2 + 0.1 * np.sin(0.7 * t)
    p = np.column_stack([2.5 * np.sin(0.21 * t), 2.0 * np.sin(0.13 * t + 1), 0 * t])
    yaw = np.zeros(len(t))
    label = 300 + rng.normal(0, 200) + 80 * speed + rng.normal(0, 30, len(t))
    columns = {"t": t, "p_world_base": p, "yaw": yaw, "odom_v": np.outer(speed, [1.0, 0, 0])}
    field = FIELD.lookup(p[:, :2], yaw)
    return Run({**columns, "b_measured_nt": field + label}, {"session": 0, "plant": f"all:{seed}"})


def a_linear():
    return Linear(
        inputs=inputs_of(np.random.default_rng(0).normal(0.2, 0.07, (50, 1)), ("odom_v_x",)),
        constant_nt=316.0,
        coefficients_nt=np.array([5.6]),
        spread=Spread(30.0**2, np.array([4.0])),
        penalty=0.0,
    )


@pytest.fixture(scope="module")
def wide():
    return widen(a_linear(), {f"r{k}": a_robot(k) for k in range(40)}, anomaly_map=FIELD)


def test_intervals_on_other_robots_hold_on_fresh_ones_and_predictions_stay(wide):
    held = []
    for seed in range(100, 200):
        run = a_robot(seed)
        (read,) = NeuralMagnetometer(wide).read([run])
        error = read.disturbance_nt - (
            run["b_measured_nt"] - FIELD.lookup(run["p_world_base"][:, :2], run["yaw"])
        )
        held.append(np.mean(np.abs(error) <= Z_90 * read.stated_sd_nt))
        assert read.intervals == OTHERS
    assert 0.85 < np.mean(held) < 0.97  # 40 robots know a quantile of 90 % to 5 %
    assert 180 < wide.wide.mean_nt < 280
    x = np.linspace(0, 0.4, 9)[:, None]
    assert_array_equal(wide.predict(x), a_linear().predict(x))
    assert wide.metadata["wide_robots"] == 40


def test_every_kind_keeps_them_in_its_file_and_a_live_robot_reads_them(wide, tmp_path):
    net = a_net(("odom_v_x",), (4,), residual_sd_nt=50.0)
    net.wide = wide.wide
    for name, model in (("linear", wide), ("mlp", net)):
        model.save(tmp_path / f"{name}.safetensors")
        back = load_predictor(tmp_path / f"{name}.safetensors")
        x = np.array([[0.15], [0.31]])
        assert_array_equal(back.wide_sd_nt(x), model.wide.sd_nt(model.inputs.scaled(x)))
        assert_array_equal(back.predict(x), model.predict(x))
        signals = {"odom_v": (0.31, 0.0, 0.0)}
        live = Reader(back, FIELD).read((0.3, 0.4), 0.0, signals)
        assert_allclose(live.b_sd_nt, back.wide_sd_nt(x)[1], rtol=1e-12)
        export_onnx(tmp_path / f"{name}.safetensors", tmp_path / f"{name}.onnx")
        session = onnxruntime.InferenceSession(tmp_path / f"{name}.onnx", providers=["CPUExecutionProvider"])
        assert_allclose(session.run(["sd_nt"], {"features": x})[0], back.wide_sd_nt(x), rtol=1e-9)


def test_a_file_whose_spread_on_other_robots_is_damaged_is_refused(wide, tmp_path):
    broken = a_linear()
    broken.wide = Spread(-1.0, np.array([1.0]))
    broken.save(tmp_path / "w.safetensors")
    with pytest.raises(InputError, match="a variance of its wide is below 0"):
        load_predictor(tmp_path / "w.safetensors")


def test_the_command_widens_a_file_and_carries_its_card_over(tmp_path, capsys):
    given, out = tmp_path / "n.safetensors", tmp_path / "w.safetensors"
    a_linear().save(given)
    given.with_suffix(".md").write_text(f"# n\n\nSHA-256 `{sha256(given)}`.\n", encoding="utf-8")
    mt.save_map(FIELD, tmp_path / "map.usdc")
    runs = [tmp_path / f"r{k}.parquet" for k in range(5)]
    for k, path in enumerate(runs):
        a_robot(k).save(path)
    words = ["--runs", *map(str, runs), "--map", str(tmp_path / "map.usdc"), "--out", str(out), "--json"]
    main(["model", "widen", str(given), *words])
    figures = json.loads(capsys.readouterr().out)["figures"]
    made = load_predictor(out)
    assert figures["sd, other robots"]["value"] == pytest.approx(made.wide.mean_nt)
    card = out.with_suffix(".md").read_text(encoding="utf-8")
    assert sha256(out) in card
    assert sha256(given) not in card
    assert "from 1,200 readings of 5 robots" in card


def test_what_cannot_be_learned_from_is_refused():
    runs = {f"r{k}": a_robot(k) for k in range(3)}
    with pytest.raises(InputError, match="recordings of 3 robots: how robots differ is learned from 4"):
        widen(a_linear(), runs, anomaly_map=FIELD)
    with pytest.raises(InputError, match="trained on the map 'lab', and its errors on another, 'trough'"):
        widen(HYBRID, runs, anomaly_map=FIELD)


@pytest.mark.parametrize(
    ("learned", "used", "same"),
    [
        ({}, {}, True),
        ({}, {"session": 3, "plant": "nominal"}, True),
        ({}, {"plant": "hysteresis"}, False),
        ({}, {"plant": "of the scene"}, False),
        ({"training_plants": "all:3, all:4"}, {"plant": "all:4"}, True),
        ({"training_plants": "all:3, all:4"}, {}, False),
        ({}, {"platform_sha256": "cd"}, False),
        ({}, {"sensor_m": "0, 0, 1"}, False),
        ({"platform_sha256": "unknown"}, {"platform_sha256": "unknown"}, False),
        ({}, {"session": "survey"}, False),
        ({"training_sessions": "survey"}, {"session": "survey"}, True),
    ],
)
def test_only_plant_robot_and_sensor_of_the_training_are_its_own(learned, used, same):
    either = {"platform_sha256": "ab", "sensor_m": "0, 0, 0.4"}
    assert same_robot({**either, **learned}, {**either, **used}) is same


def test_a_recording_of_a_real_robot_is_of_another_robot_and_a_model_without_says_that_it_has_no_others():
    (read,) = NeuralMagnetometer(a_linear()).read([a_robot(1)])
    assert read.intervals == ONLY_OWN
    assert_array_equal(read.stated_sd_nt, read.sd_nt)
    assert not NeuralMagnetometer.load(HYBRID).knows({"robot_name": "turtlebot4"})


@pytest.fixture(scope="module")
def twins():
    return mt.open_twin("lab"), mt.open_twin("lab", magnetometer="physical")


@pytest.mark.parametrize("plant", ["nominal", "hysteresis", "drawn"])
def test_the_verdict_of_a_run_is_that_of_an_evaluation_by_the_physical_run_of_the_same_seed(twins, plant):
    neural, physical = (mt.simulate(twin, "figure8", seed=1, plant=plant, rate_hz=8) for twin in twins)
    tally = Tally()
    neural.add_to(tally)
    made = mt.evaluate(HYBRID, {"run": physical}, anomaly_map=shipped("maps", "lab", "lab.usdc"))
    score = made.every.scores[1]
    assert tally.error_nt / tally.readings == pytest.approx(score.mae_nt, rel=0.15)
    assert tally.within / tally.with_sd == pytest.approx(score.coverage, rel=0.15)
    whose = OWN if plant == "nominal" else OTHERS
    for line in (neural.report().verdict, *made.verdicts().values()):
        assert f"Its 90 % intervals {whose} hold" in line
    assert neural.metadata.get("network_intervals", OWN) == whose
    assert ("b_unmodelled_nt" in neural) == (plant not in ("nominal", "drawn"))


@pytest.mark.parametrize("plant", ["hysteresis", "moving-part", "all"])
def test_shipped_intervals_hold_85_percent_on_every_shipped_plant_without_a_drive(twins, plant):
    options = {"sessions": 10, "seed": 5000, "rate_hz": 4, "duration_s": 40.0, "plant": plant}
    runs = mt.sweep(twins[1], list("ABCDE"), 10, **options)
    named = {f"r{k}": run for k, run in enumerate(runs)}
    made = mt.evaluate(HYBRID, named, anomaly_map=shipped("maps", "lab", "lab.usdc"))
    assert made.every.scores[1].coverage >= 0.85
    (line,) = made.verdicts().values()
    assert OTHERS in line
    assert "TOO NARROW" not in line
