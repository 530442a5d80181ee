import itertools
import json
import math

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from magtwin.errors import InputError
from magtwin.learn.data.features import FULL, feature_names
from magtwin.learn.data.inputs import inputs_of
from magtwin.learn.models.checkpoint import read_checkpoint
from magtwin.learn.models.network import FieldNet, convert
from magtwin.learn.models.perceptron import Layer
from magtwin.learn.models.predictor import load_predictor
from magtwin.learn.training.config import TrainConfig

RELEASED = "aprilab/models/nn_magnetometer_model_v0.0.1.pth"


def a_net(features=FULL, hidden=(8, 4), seed=0, **options):
    """A small network with weights, scalers and ranges that are all different."""
    rng, names = np.random.default_rng(seed), feature_names(features)
    widths = [len(names), *hidden, 1]
    layers = [
        Layer(*(rng.uniform(-1, 1, shape).astype(np.float32) / a**0.5 for shape in ((b, a), b)))
        for a, b in itertools.pairwise(widths)
    ]
    return FieldNet(
        inputs=inputs_of(rng.normal(3, 2, (100, len(names))), names),
        layers=tuple(layers),
        y_mean=340.0,
        y_scale=480.0,
        **options,
    )


def test_the_papers_network_has_799233_parameters():
    assert a_net(hidden=TrainConfig().options["layers"]).parameters_count == 799_233


def test_the_released_network_converts_once_and_stays_itself(real_data, tmp_path):
    out = tmp_path / "released.safetensors"
    converted = convert(real_data / RELEASED, out)
    net, (checkpoint, _) = load_predictor(out), read_checkpoint(real_data / RELEASED)
    assert net.hidden == (512, 512, 512, 128)
    assert net.features == FULL
    for i, layer in enumerate(net.layers):
        assert_array_equal(layer.weight, checkpoint[f"layers.{i}.weight"])
        assert_array_equal(layer.bias, checkpoint[f"layers.{i}.bias"])
    assert net.metadata == converted.metadata
    for name, value in load_predictor(real_data / RELEASED).tensors().items():  # without conversion
        assert_array_equal(net.tensors()[name], value)
    assert net.metadata["source_sha256"] == "2418abc80cb0eab578e1e8af35f53566db2efa84b1cfa5257710d15273a07cf0"
    assert math.isnan(net.residual_sd_nt)
    assert np.isnan(net.inputs.low).all()


# Files that are refused


def changed(tmp_path, *, about=None, drop=(), metadata=None, **tensors):
    """A file of a small network with tensors, or what it says of itself, changed."""
    path = tmp_path / "n.safetensors"
    a_net(["yaw_deg", "odom_v_x"]).save(path, force=True)
    with safe_open(path, framework="np") as file:
        said = json.loads(file.metadata()["magtwin"])
    held = {k: v for k, v in load_file(path).items() if k not in drop}
    held |= {k.replace("__", "."): np.asarray(v) for k, v in tensors.items()}
    metadata = {"magtwin": json.dumps(said | (about or {}))} if metadata is None else metadata
    save_file(held, path, metadata=metadata)
    return path


def ones(*shape):
    return np.ones(shape, np.float32)


DEEP = {"metadata": {"magtwin": "[" * 100_000}}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"drop": ["x_mean"]}, "tensor 'x_mean' is missing"),
        ({"drop": ["layers.1.bias"]}, "tensor 'layers.1.bias' is missing"),
        ({"drop": ["layers.1.weight", "layers.2.weight"]}, "tensor 'layers.1.weight' is missing"),
        ({"layers__0__weight": ones(8, 3)}, "'layers.0.weight' is float32 (8, 3)"),
        ({"layers__1__weight": ones(4, 9)}, "'layers.1.weight' is float32 (4, 9)"),
        ({"layers__0__weight": ones()}, "'layers.0.weight' is float32 (); a layer's"),
        ({"layers__2__weight": ones(4)}, "'layers.2.weight' is float32 (4,); a layer's"),
        ({"x_mean": 0 * ones(2)}, "'x_mean' is float32 (2,)"),
        ({"layers__2__bias": math.nan * ones(1)}, "nan or infinite"),
        ({"x_scale": np.array([1.0, 0.0])}, "a scale of its scalers"),
        ({"spare": ones(1)}, "'spare' belongs to no layer"),
        ({"about": {"features": ["yaw_deg", "odom_vx"]}}, "did you mean 'odom_v_x'"),
        ({"about": {"units": ["rad", "m/s"]}}, "reads yaw_deg in 'rad'"),
        ({"about": {"dropout": "much"}}, "'dropout' of its metadata"),
        ({"about": {"dropout": 1.0}}, "dropout in 0..1"),
        ({"about": {"features": [1, 2]}}, "'features' of its metadata must be names"),
        ({"about": {"features": []}}, "'features' of its metadata must be names"),
        ({"about": {"features": 5}}, "'features' of its metadata is missing"),
        ({"about": {"residual_sd_nt": math.inf}}, "'residual_sd_nt' of its metadata must be 0 nT or more"),
        ({"about": {"facts": {"a": [1]}}}, "'a' of its metadata"),
        ({"about": {"facts": {"a": 10**400}}}, "'a' of its metadata"),
        ({"about": {"format_version": 2}}, "format version 2"),
        ({"metadata": {"magtwin": "5"}}, "format version None"),
        ({"metadata": {"magtwin": "{"}}, "its metadata is not JSON"),
        (DEEP, "its metadata is not JSON"),
        ({"metadata": {"format": "pt"}}, "without magtwin's metadata"),
    ],
)
def test_a_weights_file_that_does_not_hold_together_is_refused(tmp_path, change, text):
    path = changed(tmp_path, **change)
    with pytest.raises(InputError) as refused:
        load_predictor(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert text in str(refused.value)


@pytest.mark.parametrize(
    ("content", "text"),
    [(b"", "is empty"), (b"weights", "no weights"), (b"\x89PNG\r\n\x1a\n" + bytes(20), "no weights")],
)
def test_a_file_of_another_kind_is_refused(tmp_path, content, text):
    (tmp_path / "n.bin").write_bytes(content)
    with pytest.raises(InputError, match=text):
        load_predictor(tmp_path / "n.bin")
    with pytest.raises(InputError, match="a folder; give a weights file"):
        load_predictor(tmp_path)


def test_a_truncated_weights_file_is_refused(tmp_path):
    path = changed(tmp_path)
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(InputError, match="damaged safetensors"):
        load_predictor(path)
