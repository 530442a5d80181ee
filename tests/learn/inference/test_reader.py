import math
import sys

import numpy as np
import pytest
from learn_drives import random_run as a_run
from numpy.testing import assert_allclose
from test_magnetometer import forward64, inputs
from test_network import RELEASED, a_net
from test_predictor import KINDS, a_predictor

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.learn.data.features import FEATURES, FULL, SETS, features
from magtwin.learn.data.inputs import inputs_of
from magtwin.learn.inference import reader
from magtwin.learn.inference.reader import Reader
from magtwin.learn.models.predictor import load_predictor
from magtwin.run.run import COLUMNS


@pytest.fixture(scope="module")
def field():
    values = 41_000 + 3_000 * np.random.default_rng(0).standard_normal((4, 15, 25))
    return AnomalyMap(
        values_nt=values,
        origin_m=(-3.0, -1.75),
        cell_m=(0.25, 0.25),
        headings_rad=np.radians([0, 90, 180, 270]),
    )


@pytest.fixture(scope="module")
def run(field):
    """Rows with every column that a feature is made of, map gradients those of the map."""
    run = a_run(30)
    rng = np.random.default_rng(3)
    wanted = {column for feature in FEATURES.values() for column in feature.columns}
    made = {}
    for name in sorted(wanted - {"yaw"}):
        width = COLUMNS[name].width
        made[name] = rng.normal(size=(30, width) if width > 1 else 30)
    made["imu_q_xyzw"] /= np.linalg.norm(made["imu_q_xyzw"], axis=1, keepdims=True)
    made["p_world_base"] = np.column_stack([rng.uniform([-2.9, -1.7], [2.9, 1.7], (30, 2)), np.zeros(30)])
    slopes = field.gradient(made["p_world_base"][:, :2], run["yaw"])
    cos, sin = np.cos(run["yaw"]), np.sin(run["yaw"])
    made["b_map_gradient_nt_m"] = np.column_stack(
        [cos * slopes[:, 0] + sin * slopes[:, 1], cos * slopes[:, 1] - sin * slopes[:, 0]]
    )
    return run.with_columns(**made)


def signals_of(reader, run, row):
    return {name: run[name][row].tolist() for name in reader.signals}


def poses(run):
    return zip(run["p_world_base"][:, :2].tolist(), run["yaw"].tolist(), strict=True)


@pytest.mark.parametrize("names", SETS)
def test_one_reading_is_the_row_of_a_run(names, run, field):
    net = a_net(names, (16, 24, 8), residual_sd_nt=31.0)
    x = features(run, names)
    net.inputs = inputs_of(x[:20], names)
    reader = Reader(net, field)
    mean, base = net.predict(x)[0], field.lookup(run["p_world_base"][:, :2], run["yaw"])
    outside = net.outside(x)
    assert outside.any()
    assert not outside.all()
    for row, (p, yaw) in enumerate(poses(run)):
        reading = reader.read(p, yaw, signals_of(reader, run, row))
        assert_allclose(reading.b_map_nt, base[row], atol=1e-9)
        assert_allclose(reading.b_disturbance_nt, mean[row], atol=1e-3)
        assert reading.b_total_nt == reading.b_map_nt + reading.b_disturbance_nt
        assert reading.b_sd_nt == 31.0
        assert reading.outside_training == outside[row]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_read_as_in_a_run(kind, run, field):
    predictor = a_predictor(kind)
    x = features(run, predictor.features)
    reader = Reader(predictor, field)
    read = [reader.read(p, yaw, signals_of(reader, run, row)) for row, (p, yaw) in enumerate(poses(run))]
    mean, sd = predictor.predict(x)
    assert_allclose([one.b_disturbance_nt for one in read], mean, rtol=1e-5)  # of up to 10,000 nT
    assert_allclose([one.b_sd_nt for one in read], sd, rtol=1e-5)
    assert [one.outside_training for one in read] == predictor.outside(x).tolist()


def test_a_reading_of_the_released_network_errs_by_less_than_a_hundredth_nt(real_data, field):
    net = load_predictor(real_data / RELEASED)
    reader, x = Reader(net, field), inputs(net, 200)
    x[:, FULL.index("yaw_deg")] %= 360
    exact = forward64(net, x)
    for row, y in zip(x.tolist(), exact, strict=True):
        yaw, of = math.radians(row[0]), dict(zip(FULL, row, strict=True))
        vectors = ("odom_v", "odom_w", "imu_w", "imu_a")
        signals = {name: [of[f"{name}_{part}"] for part in COLUMNS[name].parts] for name in vectors}
        q = [of[f"imu_q_{part}"] for part in "xyzw"]
        if q[3] < 0:  # a quaternion that no run holds: what comes in has w >= 0
            continue
        signals |= {"imu_q_xyzw": q, **{name: of[name] for name in FULL[-3:]}}
        assert_allclose(reader.read((0.1, 0.2), yaw, signals).b_disturbance_nt, y, atol=0.01)


def test_a_lever_arm_moves_where_the_map_is_read(field, run):
    reader = Reader(a_net("correlated", (4,)), field, lever_arm_m=(0.1, -0.05))
    p, yaw = (0.3, 0.4), 2.0
    at = (0.3 + 0.1 * math.cos(yaw) + 0.05 * math.sin(yaw), 0.4 + 0.1 * math.sin(yaw) - 0.05 * math.cos(yaw))
    reading = reader.read(p, yaw, signals_of(reader, run, 0))
    assert_allclose(reading.b_map_nt, field.at(*at, yaw), atol=1e-9)


def test_nan_in_gives_nan_out_and_off_the_map_nothing_is_known(field, run):
    reader = Reader(a_net(FULL, (8, 8, 8)), field)
    signals = signals_of(reader, run, 0)
    assert math.isnan(reader.read((9.0, 0.0), 0.0, signals).b_total_nt)
    assert not math.isnan(reader.read((9.0, 0.0), 0.0, signals).b_disturbance_nt)
    reading = reader.read((0.0, 0.0), 0.0, signals | {"battery_v": math.nan})
    assert math.isnan(reading.b_total_nt)
    assert reading.outside_training
    assert not math.isnan(reader.read((0.0, 0.0), 0.0, signals).b_total_nt)  # nothing of it stays


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"odom_v": None}, "no signal 'odom_v'.*did you mean 'odom_w'"),
        ({"odom_v": (0.0, 1.0)}, r"'odom_v' has 3 numbers in a row, got shape \(2,\)"),
        ({"battery_v": (15.0, 14.0)}, r"'battery_v' has 1 numbers in a row, got shape \(2,\)"),
    ],
)
def test_signals_that_are_missing_or_of_another_width_are_refused(field, run, wrong, text):
    reader = Reader(a_net(FULL, (4,)), field)
    signals = {k: v for k, v in (signals_of(reader, run, 0) | wrong).items() if v is not None}
    with pytest.raises(InputError, match=text):
        reader.read((0.0, 0.0), 0.0, signals)


def test_without_numba_a_reading_is_the_same_and_takes_longer(field, run, monkeypatch):
    net = a_net(FULL, (16, 8))
    quick = Reader(net, field)
    monkeypatch.setattr(reader.LOOPS, "code", None)
    monkeypatch.setitem(sys.modules, reader.LOOPS.module, None)
    slow = Reader(net, field)
    signals = signals_of(quick, run, 5)
    assert_allclose(slow.read((0.5, 0.5), 1.0, signals), quick.read((0.5, 0.5), 1.0, signals), atol=1e-3)
