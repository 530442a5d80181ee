"""Mixed models from a data set, calibrated by a drive, followed online, and used like any predictor."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import magtwin as mt
from magtwin.cli import main
from magtwin.errors import CalibrationWarning, InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.files.file import sha256, shipped
from magtwin.learn.data.features import features
from magtwin.learn.inference.calibrate import labelled_drive
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.learn.inference.online import OnlineMagnetometer, read_online
from magtwin.learn.models.linear import fit_linear
from magtwin.learn.models.predictor import load_predictor
from magtwin.path import loops
from magtwin.report.verdict import OF_DRIVE, OTHERS, OWN
from magtwin.run.run import Run

NAMES = "yaw_sin,yaw_cos,odom_v_x"
X, Y = np.meshgrid(np.linspace(-3, 3, 13), np.linspace(-3, 3, 13))
FIELD = AnomalyMap(
    values_nt=(41e3 + 300 * X**2 - 400 * Y)[None],
    origin_m=(-3.0, -3.0),
    cell_m=(0.5, 0.5),
    headings_rad=np.zeros(1),
    name="trough",
)


def a_run(seed, plant="", seconds=60.0, sector=2 * np.pi):
    """A drive at 10 Hz whose disturbance is linear, with a constant and slopes that a session draws."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 0.1)
    yaw = (sector * (0.5 + 0.499 * np.sin(0.4 * t + rng.uniform(0, 6))) + np.pi) % (2 * np.pi) - np.pi
    speed = 0.2 + 0.1 * np.sin(0.7 * t)
    p = np.column_stack([2.5 * np.sin(0.21 * t), 2.0 * np.sin(0.13 * t + 1), 0 * t])
    size = 4.0 if plant else 1.0
    beta = np.array([300, 80, -40, 100]) + size * rng.normal(0, [60, 20, 20, 100])
    label = beta[0] + beta[1] * np.sin(yaw) + beta[2] * np.cos(yaw) + beta[3] * speed
    field = FIELD.lookup(p[:, :2], yaw)
    still = np.zeros((len(t), 3))
    columns = {
        "t": t,
        "p_world_base": p,
        "yaw": yaw,
        "odom_v": np.column_stack([speed, still[:, :2]]),
        "b_measured_nt": field + label + rng.normal(0, 15, len(t)),
    }
    about = {"session": seed, "path": "loops", **({"plant": plant} if plant else {})}
    return Run(columns, about)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A mixed model of 20 nominal sessions and 4 worlds, as a file."""
    folder = tmp_path_factory.mktemp("mixed")
    runs = {f"n{k}": a_run(k) for k in range(20)}
    for world in range(4):
        runs |= {f"w{world}_{k}": a_run(100 + 10 * world + k, f"warm-up:{world}") for k in range(4)}
    data = mt.build_dataset(runs, out=folder / "set", anomaly_map=FIELD)
    out = folder / "mixed.safetensors"
    result = mt.train(data, out=out, model="mixed", features=NAMES, seed=1)
    assert "mixed model" in out.with_suffix(".md").read_text()
    assert result.predictor.kind == "mixed"
    return out


@pytest.fixture(scope="module")
def model(weights):
    return load_predictor(weights)


def errors(model, run):
    label = run["b_measured_nt"] - FIELD.lookup(run["p_world_base"][:, :2], run["yaw"])
    read = NeuralMagnetometer(model).read([run])[0]
    return read.disturbance_nt - label, read.sd_nt


def test_its_mean_is_ridge_on_the_nominal_sessions_alone(model):
    assert_allclose(model.prior.mean[0], 300 + 100 * 0.2, atol=3 * 60 / np.sqrt(14))
    assert model.families == 2
    nominal = [a_run(k) for k in range(20)]
    drives = [labelled_drive(model, run, FIELD) for run in nominal]
    x, y = (np.concatenate([getattr(drive, part) for drive in drives]) for part in "xy")
    groups = np.repeat(np.arange(20), [len(drive.y) for drive in drives])
    every = fit_linear(x, y, groups, features=NAMES, penalty=0.0).model.predict(x)[0]
    assert np.abs(every - model.predict(x)[0]).mean() < 40  # 14 of the 20 sessions, with another penalty


def test_a_minute_of_labels_makes_a_new_plant_as_good_as_its_noise(model):
    held = []
    for seed in range(200, 230):
        run = a_run(seed, "hysteresis", seconds=120.0)
        calibrated = mt.calibrate(model, run, anomaly_map=FIELD, duration_s=60.0)
        late = run["t"] > 60
        error, sd = errors(calibrated, run)
        before, narrow = errors(model, run)
        assert np.abs(error[late]).mean() < 25 < np.abs(before[late]).mean()
        assert narrow[0] > sd[0]
        held.append(np.mean(np.abs(error[late]) < 1.645 * sd[late]))
    assert 0.85 < np.mean(held) < 0.97


def test_intervals_for_an_unknown_plant_hold_where_nominal_ones_fail(model):
    runs = [a_run(seed, "hysteresis") for seed in range(200, 230)]
    held = {}
    for name, chosen in (("nominal", model), ("unknown", model.open_loop(unknown_plant=True))):
        found = [errors(chosen, run) for run in runs]
        held[name] = np.mean([np.abs(error) < 1.645 * sd for error, sd in found])
    assert held["nominal"] < 0.7
    assert held["unknown"] > 0.85
    nominal = [errors(model, a_run(seed)) for seed in range(300, 330)]
    assert np.mean([np.abs(error) < 1.645 * sd for error, sd in nominal]) == pytest.approx(0.9, abs=0.08)


def test_a_calibrated_file_records_its_drive_and_its_parent(weights, tmp_path):
    a_run(7, "hysteresis").save(tmp_path / "drive.parquet")
    out = tmp_path / "now.safetensors"
    calibrated = mt.calibrate(weights, tmp_path / "drive.parquet", anomaly_map=FIELD, out=out)
    again = load_predictor(out)
    assert again.metadata == calibrated.metadata
    kept = again.metadata
    assert (kept["calibration_drive"], kept["calibration_session"]) == ("drive.parquet", "7-hysteresis")
    assert kept["parent_sha256"] == sha256(weights)
    assert kept["calibration_duration_s"] == pytest.approx(59.8, abs=0.3)
    assert kept["calibration_residual_nt"] < 25 < kept["calibration_residual_before_nt"]
    assert kept["map"] == "trough"
    assert "calibration_warnings" not in kept
    run = a_run(8)
    assert_array_equal(errors(again, run)[0], errors(calibrated, run)[0])
    assert_array_equal(
        again.open_loop().predict(np.zeros((1, 3))), load_predictor(weights).predict(np.zeros((1, 3)))
    )


def test_the_figures_of_its_report_are_those_of_the_raw_arrays(model):
    run = a_run(31, "hysteresis")
    now = mt.calibrate(model, run, anomaly_map=FIELD)
    drive = labelled_drive(model, run, FIELD)
    phi = np.column_stack([np.ones(len(drive.y)), (drive.x - model.inputs.mean) / model.inputs.scale])
    noise = model.noise.floor_nt2 + (phi[:, 1:] ** 2) @ model.noise.slopes_nt2
    share = np.median(np.diff(drive.t)) / 2.5  # of an independent reading: errors are correlated over 2.5 s
    inverse = np.linalg.inv(model.prior.covariance)

    def posterior(at):
        weighted = phi[at].T * (share / noise[at])
        spread = np.linalg.inv(inverse + weighted @ phi[at])
        return spread @ (inverse @ model.prior.mean + weighted @ drive.y[at]), spread

    mean, spread = posterior(np.ones(len(drive.y), bool))
    block = ((drive.t - drive.t[0]) // 10).astype(int)
    error, sd = np.empty(len(drive.y)), np.empty(len(drive.y))
    for k in np.unique(block):
        m, v = posterior(block != k)
        at = block == k
        error[at] = phi[at] @ m - drive.y[at]
        sd[at] = np.sqrt(noise[at] + np.einsum("ni,ij,nj->n", phi[at], v, phi[at]))
    figures = {figure.name: figure for figure in now.report("now").figures}
    assert figures["constant of the session"].value == pytest.approx(mean[0], rel=1e-6)
    assert figures["constant of the session"].spread == pytest.approx(np.sqrt(spread[0, 0]), rel=1e-6)
    assert figures["residual sd"].value == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-6)
    ratio = np.sort(np.abs(error) / sd) / 1.6448536
    assert figures["interval factor of the drive"].value == pytest.approx(
        np.clip(ratio[int(np.ceil(0.9 * len(ratio))) - 1], 0.7, 4.0), rel=0.05
    )  # blocks weigh alike, which are of equal length but for a reading
    before = phi @ model.prior.mean - drive.y
    assert now.metadata["calibration_residual_before_nt"] == pytest.approx(
        np.sqrt(np.mean(before**2)), rel=1e-9
    )
    assert now.metadata["calibration_readings"] == len(drive.y)
    assert now.metadata["calibration_duration_s"] == drive.t[-1] - drive.t[0]


def test_what_cannot_calibrate_is_refused_in_a_line(model, weights, tmp_path):
    run = a_run(3)
    x = np.random.default_rng(0).normal(size=(50, 3))
    linear = fit_linear(x, x[:, 0], np.arange(50) % 3, features=NAMES).model
    far = run.with_columns(p_world_base=run["p_world_base"] + 50)
    simulated = Run(dict(run), {"magnetometer": "neural"})
    (tmp_path / "there.safetensors").write_bytes(b"")
    for refused, options, text in (
        (linear, {}, "kind 'linear' has no effects of a session; take the one that ships"),
        (model, {"duration_s": 2.0}, "labelled readings at most 4 a second, and 20 are needed"),
        (model, {"run": far}, "none of 600 readings has a label on the map"),
        (model, {"run": simulated}, "its readings come from a neural magnetometer"),
        (model, {"pose_sd_m": -1.0}, "pose_sd_m must be between 0 and 1000 m, got -1.0"),
        (weights, {"out": tmp_path / "there.safetensors"}, "exists"),
    ):
        with pytest.raises(InputError) as error:
            mt.calibrate(refused, options.pop("run", run), anomaly_map=FIELD, **options)
        assert text in str(error.value)
        assert "\n" not in str(error.value)


def test_a_drive_that_lacks_a_signal_calibrates_without_it_and_says_so(model):
    held = []
    for seed in range(200, 220):
        whole = a_run(seed, "hysteresis", seconds=120.0)
        run = whole.select(*(name for name in whole if name != "odom_v"))
        with pytest.warns(CalibrationWarning, match="it has no odom_v; what they would show counts as error"):
            calibrated = mt.calibrate(model, run, anomaly_map=FIELD, duration_s=60.0)
        assert calibrated.features == ("yaw_sin", "yaw_cos")
        error, sd = (values[run["t"] > 60] for values in errors(calibrated, run))
        assert np.abs(error).mean() < 60 < np.abs(errors(model, whole)[0]).mean() + 60
        held.append(np.mean(np.abs(error) < 1.645 * sd))
    assert np.mean(held) > 0.85


def test_the_model_that_ships_learns_a_load_on_board_and_turning_wheels_in_a_minute():
    """Neither is in its training: a magnet of 700 nT, and wheels of 150 nT."""

    def field(columns, robot, rng):
        angle = columns["wheel_angle"]
        turning = [150 * np.cos(angle[:, 0]), 0 * angle[:, 0], 150 * np.sin(angle[:, 1])]
        return np.add(np.column_stack(turning), (400.0, -300.0, -500.0))

    way = loops().at(np.linspace(0, 17, 700))
    options = {"magnetometer": "physical", "rate_hz": 8.0, "seed": 5, "interference": [field]}
    run, lab = mt.simulate("lab", way, **options), mt.load_map(shipped("maps", "lab", "lab.usdc"))
    today = mt.calibrate(None, run, anomaly_map=lab, duration_s=60.0)
    drive = labelled_drive(today, run, lab)
    late = (drive.t > 60) & np.isfinite(drive.y)
    before, after = (
        np.abs(each.predict(drive.x)[0] - drive.y)[late].mean() for each in (today.open_loop(), today)
    )
    assert after < before / 4
    assert after < 110


def test_told_of_poses_that_are_off_it_errs_less_and_says_so(model):
    """Errors of 20 cm, which make up to 360 nT where the map is steep."""
    found = {0.0: [], 0.2: []}
    for seed in range(400, 430):
        run = a_run(seed, "hysteresis", seconds=120.0)
        slow = np.repeat(np.random.default_rng(seed).normal(0, 0.2, (48, 2)), 25, axis=0)
        moved = run.with_columns(p_world_base=run["p_world_base"] + np.column_stack([slow, np.zeros(1200)]))
        for told, kept in found.items():
            calibrated = mt.calibrate(model, moved, anomaly_map=FIELD, duration_s=60.0, pose_sd_m=told)
            late = run["t"] > 60
            error, sd = errors(calibrated, run)
            kept.append((np.abs(error[late]).mean(), sd[late].mean()))
    untold, told = (np.mean(kept, axis=0) for kept in found.values())
    assert told[0] < untold[0]
    assert told[1] < untold[1]  # untold errors widen by the blocks that were left out


def test_online_it_follows_a_session_that_changes(model):
    first, second = a_run(500, seconds=300.0), a_run(501, "hysteresis", seconds=300.0)
    later = {name: np.concatenate([first[name], second[name]]) for name in first if name != "t"}
    run = Run({"t": np.arange(6000) / 10, **later}, {"session": 1})
    read = read_online(model, run, FIELD, delay_s=10.0)
    label = run["b_measured_nt"] - FIELD.lookup(run["p_world_base"][:, :2], run["yaw"])
    error, t = np.abs(read.disturbance_nt - label), run["t"]
    assert error[(t > 60) & (t < 300)].mean() < 25
    assert error[t > 480].mean() < 60 < error[(t > 300) & (t < 310)].mean()
    inside = error < 1.645 * read.sd_nt
    assert inside[(t > 60) & (t < 300)].mean() > 0.85


def test_live_it_reads_what_a_whole_run_gives(model):
    """A robot whose poses become known 10 s late, at the rate of the run."""
    run = a_run(600, "hysteresis", seconds=90.0)
    whole = read_online(model, run, FIELD, delay_s=9.95)
    online = OnlineMagnetometer(model, FIELD, delay_s=9.95)  # so that rounding chooses no row
    assert online.signals == ("odom_v",)

    def at(k):
        return run["p_world_base"][k, :2], float(run["yaw"][k]), {"odom_v": run["odom_v"][k]}

    for k in range(run.rows):
        if k >= 100:
            online.update(run["t"][k - 100], *at(k - 100), run["b_measured_nt"][k - 100])
        reading = online.read(run["t"][k], *at(k))
        assert_allclose(reading.b_disturbance_nt, whole.disturbance_nt[k], rtol=1e-6)
        assert_allclose(reading.b_sd_nt, whole.sd_nt[k], rtol=1e-4)
    assert online.effects.count > 200


def test_training_needs_sessions_and_a_nominal_plant(tmp_path):
    for count, plant, text in (
        (4, "", "a mixed model learns how sessions differ"),
        (9, "all", "nominal plant"),
    ):
        runs = {f"r{k}": a_run(k, plant) for k in range(count)}
        data = mt.build_dataset(runs, out=tmp_path / f"set{count}", anomaly_map=FIELD)
        with pytest.raises(InputError, match=text):
            mt.train(data, model="mixed", features=NAMES)


def test_the_commands_calibrate_and_refuse_to_widen_what_is_wide(weights, tmp_path, capsys):
    a_run(7, "hysteresis", seconds=20.0).save(tmp_path / "drive.parquet")
    mt.save_map(FIELD, tmp_path / "map.usdc")
    words = [weights, tmp_path / "drive.parquet", "--map", tmp_path / "map.usdc", "--out"]
    words.append(tmp_path / "now.safetensors")
    main(["model", "calibrate", *map(str, words), "--json"])
    out, err = capsys.readouterr()
    assert "it lasts 20 s" in err
    assert json.loads(out)
    assert load_predictor(tmp_path / "now.safetensors").intervals == "calibrated"
    words[1:1] = ["--runs"]
    with pytest.raises(SystemExit):
        main(["model", "widen", *map(str, words[:-1]), str(tmp_path / "wide.safetensors")])
    assert "a mixed model learned how robots differ in its training" in capsys.readouterr().err


def test_an_uncalibrated_model_is_wide_on_every_robot_but_its_own_and_a_calibrated_one_as_its_drive(model):
    run = a_run(900, "hysteresis", seconds=120.0)
    now = mt.calibrate(model, run, anomaly_map=FIELD, duration_s=60.0)
    for net, wanted in ((model, model.open_loop(unknown_plant=True)), (now, now)):
        read = NeuralMagnetometer(net).read([run])[0]
        x = features(run, net.features)
        assert_array_equal(read.stated_sd_nt, wanted.predict(x)[1])
        assert_array_equal(read.sd_nt, net.predict(x)[1])
    assert NeuralMagnetometer(model).read([run])[0].intervals == OTHERS
    assert NeuralMagnetometer(now).read([run])[0].intervals == OF_DRIVE
    (own,) = NeuralMagnetometer(model).read([run], known=[True])
    assert own.intervals == OWN
    assert_array_equal(own.stated_sd_nt, own.sd_nt)
