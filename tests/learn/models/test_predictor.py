"""Predictors of every kind: their files, and what a magnetometer makes of them."""

import json
import math

import numpy as np
import pytest
from learn_drives import random_run as a_run
from numpy.testing import assert_allclose, assert_array_equal
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from test_network import a_net

from magtwin.errors import InputError
from magtwin.learn.data.features import SETS, features
from magtwin.learn.data.inputs import inputs_of
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.learn.mixed.effects import Effects
from magtwin.learn.mixed.mixed import Mixed
from magtwin.learn.models.calibration import Spread
from magtwin.learn.models.hybrid import Hybrid
from magtwin.learn.models.linear import Linear
from magtwin.learn.models.predictor import load_predictor
from magtwin.twin import open_twin, simulate, sweep

NAMES = SETS["gradient"]
KINDS = ("mlp", "linear", "hybrid", "base alone", "mixed")


def a_predictor(kind, names=NAMES):
    """A small one of a kind, with figures that are all different."""
    rng = np.random.default_rng(0)
    of = inputs_of(rng.normal(0, 30, (100, len(names))), names)
    spread = Spread(400.0, rng.uniform(0, 900, len(names)))
    coefficients = rng.normal(0, 90, len(names))
    base = Linear(
        inputs=of, constant_nt=333.0, coefficients_nt=coefficients, spread=spread, penalty=0.01, weighted=True
    )

    def effects(scale):
        root = rng.normal(0, 5, (len(names) + 1, len(names) + 1))
        return Effects(rng.normal(0, 90, len(names) + 1), scale * (root @ root.T + np.eye(len(root))))

    found = {
        "mlp": lambda: a_net(names, (6, 5), residual_sd_nt=44.0),
        "linear": lambda: base,
        "hybrid": lambda: Hybrid(base=base, net=a_net(names, (6, 5), dropout=0.2), sd_factor=1.5),
        "base alone": lambda: Hybrid(base=base, net=None, sd_factor=1.5),
        "mixed": lambda: Mixed(
            inputs=of,
            prior=effects(1.0),
            session=effects(0.5),
            spread=spread,
            noise=spread.scaled(0.5),
            intervals="calibrated",
            widening=1.2,
            families=3,
            factors={"calibrated": 1.1, "online": 1.3},
        ),
    }[kind]()
    found.residual_sd_nt = 44.0
    found.metadata.update(source="here", rows=7)
    return found


@pytest.fixture(params=KINDS)
def predictor(request):
    return a_predictor(request.param)


def test_every_kind_comes_back_from_its_file_to_the_bit(predictor, tmp_path):
    predictor.save(tmp_path / "a.safetensors")
    again = load_predictor(tmp_path / "a.safetensors")
    again.save(tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    x = features(a_run(60), NAMES)
    for ours, its in zip(predictor.predict(x), again.predict(x), strict=True):
        assert_array_equal(ours, its)
    assert_array_equal(predictor.outside(x), again.outside(x))
    assert (again.kind, again.features, again.residual_sd_nt) == (predictor.kind, NAMES, 44.0)
    assert again.metadata == {"source": "here", "rows": 7}


def test_a_file_that_is_there_is_kept(predictor, tmp_path):
    (tmp_path / "a.safetensors").write_text("mine")
    with pytest.raises(InputError, match=r"a\.safetensors: exists already"):
        predictor.save(tmp_path / "a.safetensors")


def test_a_magnetometer_tells_of_each_row_its_own_spread(predictor):
    run = a_run(40)
    x = features(run, NAMES)
    (read,) = NeuralMagnetometer(predictor).read([run.with_columns(t=np.arange(40) / 135)])
    mean, sd = predictor.predict(x)
    assert_array_equal(read.disturbance_nt, mean)
    assert_array_equal(read.sd_nt, sd)
    assert_array_equal(read.outside, predictor.outside(x))
    assert (len(np.unique(sd)) == 1) == (predictor.kind == "mlp")


def test_runs_in_one_stream_are_read_as_if_each_were_alone(predictor):
    runs = [a_run(rows, seed).with_columns(t=np.arange(rows) / 135) for seed, rows in enumerate((30, 1, 520))]
    magnetometer = NeuralMagnetometer(predictor)
    for run, read in zip(runs, magnetometer.read(runs), strict=True):
        (alone,) = magnetometer.read([run])
        assert_array_equal(read.disturbance_nt, alone.disturbance_nt)
        assert_array_equal(read.sd_nt, alone.sd_nt)


def test_a_simulation_is_read_by_any_kind_and_many_as_one(lab_scene, tmp_path):
    a_predictor("hybrid").save(tmp_path / "n.safetensors")
    twin = open_twin(lab_scene, network=tmp_path / "n.safetensors")
    one = simulate(twin, seed=3, duration_s=1.0)
    assert one.metadata["network_kind"] == "hybrid"
    x = features(one, NAMES)
    noise = twin.scene.robot.magnetometer.noise_density_nt * math.sqrt(135 / 2)
    assert_allclose(one["b_sd_nt"], np.hypot(twin.magnetometer.net.predict(x)[1], noise))
    both = sweep(twin, ["figure8", "figure8"], [8, 3], duration_s=1.0)
    for name in ("b_disturbance_nt", "b_sd_nt", "b_measured_nt", "flag_out_of_distribution"):
        assert_array_equal(both[1][name], one[name])


# Files that are not what they should be


def changed(tmp_path, kind, *, about=None, drop=None, **tensors):
    """A file of a small predictor with tensors, or what it says of itself, changed."""
    path = tmp_path / "n.safetensors"
    a_predictor(kind, ("yaw_sin", "odom_v_x")).save(path)
    with safe_open(path, framework="np") as file:
        said = json.loads(file.metadata()["magtwin"])
    held = {name: value for name, value in load_file(path).items() if name != drop}
    held |= {name.replace("__", "."): value for name, value in tensors.items()}
    save_file(held, path, metadata={"magtwin": json.dumps(said | (about or {}))})
    return path


@pytest.mark.parametrize(
    ("kind", "change", "text"),
    [
        ("mlp", {"about": {"kind": "oracle", "format_version": 2}}, "no predictor kind 'oracle'"),
        ("mlp", {"about": {"kind": ["mlp"]}}, "'kind' of its metadata must be text"),
        ("linear", {"about": {"format_version": 1}}, "format version 1"),
        ("linear", {"about": {"penalty": "much"}}, "'penalty' of its metadata"),
        ("linear", {"about": {"penalty": 10**400}}, "'penalty' of its metadata"),
        ("linear", {"about": {"weighted": 1}}, "'weighted' of its metadata"),
        ("linear", {"about": {"features": ["yaw_sin", "odom_x"]}}, "no feature 'odom_x'"),
        ("linear", {"spread_floor_nt2": np.array(0.0)}, "a variance of its spread is below 0"),
        ("linear", {"x_scale": np.zeros(2)}, "a scale of its scalers is not above 0"),
        ("linear", {"coefficients_nt": np.full(2, math.nan)}, "nan or infinite"),
        ("linear", {"coefficients_nt": np.ones(3)}, "'coefficients_nt' is float64 (3,)"),
        ("hybrid", {"about": {"sd_factor": 0}}, "'sd_factor' of its metadata must be above 0"),
        ("hybrid", {"about": {"sd_factor": True}}, "'sd_factor' of its metadata must be above 0"),
        ("hybrid", {"drop": "net.layers.1.weight"}, "'layers.1.weight' is missing"),
        ("hybrid", {"drop": "base.constant_nt"}, "'constant_nt' is missing"),
        ("hybrid", {"spare": np.ones(1)}, "'spare' belongs to no layer"),
        ("mixed", {"about": {"intervals": "wide"}}, "'intervals' of its metadata"),
        ("mixed", {"drop": "noise_floor_nt2"}, "'noise_floor_nt2' is missing"),
        ("mixed", {"prior_covariance_nt2": -np.eye(3)}, "not positive definite"),
    ],
)
def test_a_file_that_does_not_hold_together_is_refused(tmp_path, kind, change, text):
    path = changed(tmp_path, kind, **change)
    with pytest.raises(InputError) as refused:
        load_predictor(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert text in str(refused.value)
