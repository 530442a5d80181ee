import json
import sys

import numpy as np
import onnx
import onnxruntime
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_magnetometer import inputs
from test_network import RELEASED, a_net
from test_predictor import KINDS, a_predictor

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files.file import sha256
from magtwin.learn.data.features import FEATURES
from magtwin.learn.inference.onnx import export_onnx, model_of, report_onnx
from magtwin.learn.models.predictor import load_predictor


def run(file, x):
    """Disturbances and standard deviations by onnxruntime."""
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    return session.run(["disturbance_nt", "sd_nt"], {"features": x})


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A small network with ranges and an error."""
    path = tmp_path_factory.mktemp("weights") / "n.safetensors"
    a_net(["yaw_deg", "odom_w_z", "battery_v"], (16, 8), residual_sd_nt=42.0, metadata={"seed": 3}).save(path)
    return path


@pytest.fixture(scope="module")
def exported(weights):
    """The same as ONNX."""
    export_onnx(weights, weights.with_name("n.onnx"))
    return weights.with_name("n.onnx")


def test_the_released_network_gives_in_onnxruntime_what_it_gives_here(real_data, tmp_path):
    export_onnx(real_data / RELEASED, tmp_path / "n.onnx")
    net = load_predictor(real_data / RELEASED)
    x = inputs(net, 1000)
    mean, sd = run(tmp_path / "n.onnx", x)
    assert_allclose(mean, net.predict(x)[0], atol=1e-3, rtol=5e-7)  # rounding of 8,000 nT
    assert np.isnan(sd).all()  # nobody knows it


def test_a_standard_deviation_comes_with_every_row_and_nan_stays_in_its_own(exported):
    x = np.ones((6, 3))
    x[2, 1] = np.nan
    mean, sd = run(exported, x)
    assert_array_equal(np.flatnonzero(np.isnan(mean)), [2])
    assert_array_equal(sd, [42.0] * 6)


def test_the_same_weights_give_the_same_bytes(weights, exported, tmp_path):
    export_onnx(weights, tmp_path / "again.onnx")
    assert (tmp_path / "again.onnx").read_bytes() == exported.read_bytes()


def test_the_file_says_what_goes_in_and_from_which_weights_it_came(weights, exported):
    model = onnx.load(exported)
    onnx.checker.check_model(model, full_check=True)
    told = {one.key: one.value for one in model.metadata_props}
    net = load_predictor(weights)
    assert json.loads(told["features"]) == list(net.features)
    assert json.loads(told["units"]) == [FEATURES[name].unit for name in net.features]
    assert json.loads(told["training_min"]) == net.inputs.low.tolist()
    assert json.loads(told["training_max"]) == net.inputs.high.tolist()
    assert told["weights_sha256"] == sha256(weights)
    assert json.loads(told["facts"]) == {"seed": 3}


def test_info_tells_what_a_file_holds_and_runs_nothing_of_it(exported, capsys):
    main(["info", str(exported), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert told["figures"]["kind"] == "mlp"
    assert told["figures"]["layers"] == "3-16-8-1"
    assert told["figures"]["residual_sd_nt"] == 42.0
    assert list(told["metadata"]["features"]) == ["yaw_deg", "odom_w_z", "battery_v"]


def test_what_is_no_onnx_file_of_magtwins_is_refused(tmp_path):
    (tmp_path / "bad.onnx").write_bytes(b"no protobuf\xff" * 9)
    with pytest.raises(InputError, match=r"bad\.onnx: no ONNX file, or damaged"):
        report_onnx(tmp_path / "bad.onnx")
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    node = onnx.helper.make_node("Identity", ["x"], ["y"])
    graph = onnx.helper.make_graph([node], "g", [value], [])
    onnx.save(onnx.helper.make_model(graph), tmp_path / "foreign.onnx")
    with pytest.raises(InputError, match="no network of magtwin's"):
        report_onnx(tmp_path / "foreign.onnx")
    with pytest.raises(InputError, match="no such ONNX file"):
        report_onnx(tmp_path / "none.onnx")


def test_without_its_packages_it_says_how_to_get_them(weights, exported, tmp_path, monkeypatch):
    for package in ("onnx", "onnxruntime"):
        with monkeypatch.context() as without:
            without.setitem(sys.modules, package, None)
            with pytest.raises(InputError, match=r"pip install 'magtwin\[onnx\]'"):
                export_onnx(weights, tmp_path / "n.onnx")
    assert not list(tmp_path.iterdir())


def test_a_runtime_that_gives_something_else_writes_nothing(weights, tmp_path, monkeypatch):
    class Wrong:
        def __init__(self, *_, **__):
            pass

        def run(self, names, feed):
            return [np.zeros(len(feed["features"]))] * 2

    monkeypatch.setattr(onnxruntime, "InferenceSession", Wrong)
    with pytest.raises(InputError, match="differs from torch by"):
        export_onnx(weights, tmp_path / "n.onnx")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_gives_in_onnxruntime_what_it_gives_here(kind, tmp_path):
    predictor = a_predictor(kind)
    predictor.save(tmp_path / "p.safetensors")
    export_onnx(tmp_path / "p.safetensors", tmp_path / "p.onnx")
    x = 40 * np.random.default_rng(1).normal(size=(50, len(predictor.features)))  # beyond the training too
    x[7, 3] = np.nan
    for exported, expected in zip(run(tmp_path / "p.onnx", x), predictor.predict(x), strict=True):
        assert_allclose(exported, expected, atol=1e-3)
    model = onnx.load(tmp_path / "p.onnx")
    onnx.checker.check_model(model, full_check=True)
    told = report_onnx(tmp_path / "p.onnx")
    assert {f.name: f.value for f in told.figures}["kind"] == predictor.kind


def test_what_has_no_graph_is_refused_by_its_kind():
    class Foreign:
        kind = "forest"

    with pytest.raises(InputError, match="'forest' has no ONNX graph"):
        model_of(Foreign())
