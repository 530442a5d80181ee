"""The released checkpoint, and hostile or damaged files that must not come through the reader."""

import builtins
import os
import pickle
import struct
import sys
import types
import zipfile
from collections import OrderedDict
from itertools import pairwise
from unittest import mock

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.learn.models.network import net_of_checkpoint
from magtwin.learn.models.predictor import load_predictor

RELEASED = "aprilab/models/nn_magnetometer_model_v0.0.1.pth"

HOME = "sklearn.preprocessing._data"
StandardScaler = type("StandardScaler", (), {"__module__": HOME})  # scikit-learn need not be installed
MODULES = {name: types.ModuleType(name) for name in ("sklearn", "sklearn.preprocessing", HOME)}
MODULES[HOME].StandardScaler = StandardScaler


def scaler(mean, scale):
    made = StandardScaler()
    made.mean_, made.scale_, made.n_samples_seen_ = np.array(mean, float), np.array(scale, float), np.int64(7)
    return made


def layers(*widths):
    torch.manual_seed(0)
    pairs = enumerate(pairwise(widths))
    state = [(f"layer{i}.{part}", value) for i, (a, b) in pairs
             for part, value in (("weight", torch.randn(b, a)), ("bias", torch.randn(b)))]  # fmt: skip
    return OrderedDict(state)


def saved(state=None, **changes):
    held = {
        "model_state_dict": layers(20, 4, 1) if state is None else state,
        "scaler_X": scaler(np.arange(20), np.ones(20)),
        "scaler_y": scaler([300.0], [500.0]),
    } | changes
    return {key: value for key, value in held.items() if value is not None}


def pth(path, held, *, pickled=None):
    """A checkpoint of `held` by torch itself, with another pickle in it if one is given."""
    with mock.patch.dict(sys.modules, MODULES):
        torch.save(held, path)
    if pickled is not None:
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in members.items():
                archive.writestr(name, pickled if name.endswith("data.pkl") else data)
    return path


def refusal(path):
    with pytest.raises(InputError) as refused:
        net_of_checkpoint(path)
    text = str(refused.value)
    assert "\n" not in text
    assert text.startswith(f"{path}: ")
    return text.removeprefix(f"{path}: ")


def test_the_released_network_has_601857_parameters_in_5_layers(real_data):
    net = load_predictor(real_data / RELEASED)
    assert net.layers_text == "20-512-512-512-128-1"
    assert net.parameters_count == 601_857


def test_the_released_scalers_are_the_published_figures(real_data):
    net = load_predictor(real_data / RELEASED)
    # Mean and scale of each input, to the digits that were noted when the file was first looked at.
    figures = """
        180.295 101.551   .232589 .0658757  3.06e-4 2.75e-3  -2.6e-6 1.35e-4  4.3e-5 .010961
        2.75e-4 .028157   .009994 .524086  -.001381 .004811  -.001085 .006556  .002862 .696160
        .664672 .271099  -2.2e-6 .012694  2.30e-4 .039108  .007966 .512536  -.004313 .424792
        .002215 .271545  .021819 .980056  15.6979 .532527  .856926 .140275  .340609 .473914
    """
    mean, scale = np.array(figures.split(), float).reshape(20, 2).T
    assert_allclose(net.inputs.mean, mean, rtol=2e-2)
    assert_allclose(net.inputs.mean[[0, 1, 17, 18, 19]], mean[[0, 1, 17, 18, 19]], rtol=1e-5)
    assert_allclose(net.inputs.scale, scale, rtol=3e-3)
    assert_allclose([net.y_mean, net.y_scale], [366.662, 524.898], rtol=1e-6)
    assert net.metadata["training_rows"] == 591_952
    assert net.metadata["scalers_by"] == "scikit-learn 1.5.2"


def test_a_checkpoint_gives_back_what_was_saved(tmp_path):
    state = layers(20, 8, 4, 1)
    state["layer0.weight"] = state["layer0.weight"].T.contiguous().T  # stored by columns
    net = load_predictor(pth(tmp_path / "a.pth", saved(state)))
    assert len(net.layers) == 3
    for i, layer in enumerate(net.layers):
        assert_array_equal(layer.weight, state[f"layer{i}.weight"])
        assert_array_equal(layer.bias, state[f"layer{i}.bias"])
    assert_array_equal(net.inputs.mean, np.arange(20))
    assert (net.y_mean, net.y_scale, net.metadata["training_rows"]) == (300.0, 500.0, 7)


# Pickles that would run something. Each leaves a mark if it does.


class Calls:
    """Pickles as a call of `function`."""

    def __init__(self, function, *args):
        self.function, self.args = function, args

    def __reduce__(self):
        return self.function, self.args


def hostile_pickles(mark):
    """Pickles that make a file `mark` when loaded, and the foreign global that each names."""
    touch = f"touch {mark}"
    code = f"open({str(mark)!r}, 'w').close()"
    stack_global = pickle.dumps(Calls(builtins.eval, code), 4)
    nested = {"model_state_dict": OrderedDict(a=[({"b": Calls(os.system, touch)},)])}
    line = touch.encode()
    return {
        "os.system by REDUCE": (pickle.dumps(Calls(os.system, touch), 2), "posix.system"),
        "builtins.eval by STACK_GLOBAL": (stack_global, ""),
        "deep inside": (pickle.dumps(nested, 2), "posix.system"),
        "by the old text protocol": (b"cos\nsystem\n(S'" + line + b"'\ntR.", "os.system"),
        "by BUILD on a class": (
            b"\x80\x02csklearn.preprocessing._data\nStandardScaler\n}X\x0c\x00\x00\x00__setstate__"
            b"cos\nsystem\nsbX" + struct.pack("<I", len(line)) + line + b"b.",
            "os.system",
        ),
        "by an import that has effects": (b"\x80\x02cantigravity\ngeohash\n.", "antigravity.geohash"),
        "torch's own unsafe loader": (b"\x80\x02ctorch\nload\n.", "torch.load"),
    }


@pytest.mark.parametrize("kind", list(hostile_pickles("x")))
def test_a_pickle_that_calls_is_refused_and_not_executed(tmp_path, kind):
    mark = tmp_path / "executed"
    pickled, name = hostile_pickles(mark)[kind]
    before = set(sys.modules)
    text = refusal(pth(tmp_path / "evil.pth", saved(), pickled=pickled))
    if name:
        assert text.startswith(f"its pickle asks for {name}, which no network needs; nothing of it was")
    assert not mark.exists()
    assert "antigravity" not in set(sys.modules) - before


def test_the_hostile_pickles_do_execute_under_pickle(tmp_path):
    pickle.loads(hostile_pickles(tmp_path / "executed")["builtins.eval by STACK_GLOBAL"][0])
    assert (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    "pickled", [b"", b"\x80\x02}", b"\x80\x02h\x05.", b"\x80\x02R.", b"\x80\x02\x82\x01."]
)
def test_a_damaged_pickle_is_refused(tmp_path, pickled):
    assert refusal(pth(tmp_path / "a.pth", saved(), pickled=pickled)).startswith("damaged checkpoint (")


def test_files_that_are_no_checkpoint_are_refused(tmp_path):
    path = tmp_path / "net.pth"
    for data in (b"GIF89a..", pickle.dumps(Calls(os.system, "true"), 2), b""):
        path.write_bytes(data)
        assert refusal(path).startswith("not the zip that torch.save writes, or damaged (")
    pth(path, saved())
    path.write_bytes(path.read_bytes()[:-100])
    assert "get the file again" in refusal(path)
    assert refusal(tmp_path / "nett.pth") == "no such checkpoint; did you mean 'net.pth'?"
    assert refusal(pth(path, 1)) == "no 'model_state_dict' in it; a checkpoint has " + (
        "model_state_dict, scaler_X, scaler_y"
    )


def test_a_flipped_bit_in_a_tensor_is_refused_by_its_checksum(tmp_path):
    path = pth(tmp_path / "a.pth", saved())
    data = bytearray(path.read_bytes())
    data[data.index(layers(20, 4, 1)["layer0.weight"].numpy().tobytes())] ^= 1
    path.write_bytes(data)
    assert refusal(path) == "member 'a/data/0' is damaged; get the file again"


# Networks that do not fit together

GOOD = layers(20, 4, 1)
NAN = GOOD["layer0.weight"].clone()
NAN[1, 2] = np.nan
HUGE = torch.zeros(1).expand(10**6, 10**6)


@pytest.mark.parametrize(
    ("held", "text"),
    [
        (saved(layers(19, 4, 1), scaler_X=scaler(np.zeros(19), np.ones(19))), "'x_mean' is float64 (19,)"),
        (saved(GOOD | {"layer1.weight": torch.ones(1, 5)}), "'layers.1.weight' is float32 (1, 5)"),
        (saved(layers(20, 4, 2)), "'layers.1.weight' is float32 (2, 4)"),
        (saved({"layer0.weight": torch.ones(4, 20)}), "'layers.0.bias' is missing"),
        (saved(GOOD | {"layer0.weight": torch.ones(20)}), "'layers.0.weight' is float32 (20,); a layer's"),
        (saved(GOOD | {"norm.running_mean": torch.ones(4)}), "'norm.running_mean' is neither weight"),
        (saved(GOOD | {"layer0.weight": NAN}), "'layers.0.weight' has numbers that are nan"),
        (saved(GOOD | {"layer0.weight": 3}), "'layer0.weight' is neither weight nor bias"),
        (saved(GOOD | {"layer0.weight": HUGE}), "'layer0.weight' is larger than what the file stores"),
        (saved(OrderedDict()), "model_state_dict holds no tensors"),
        (saved(scaler_X=None), "no 'scaler_X' in it"),
        (saved(scaler_X={}), "scaler_X is not a StandardScaler"),
        (saved(scaler_X=scaler(np.zeros(4), np.ones(4))), "'x_mean' is float64 (4,)"),
        (saved(scaler_y=scaler([0, 0], [1, 1])), "'y_mean' is float64 (2,)"),
        (saved(scaler_X=scaler(np.zeros(20), np.zeros(20))), "a scale of its scalers is not above 0"),
        (saved(scaler_y=StandardScaler()), "'y_mean' has numbers that are nan"),
    ],
)
def test_a_network_that_does_not_fit_together_is_refused(tmp_path, held, text):
    assert text in refusal(pth(tmp_path / "a.pth", held))


def test_a_checkpoint_that_is_compressed_by_lzma_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.pth", "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("a/data.pkl", pickle.dumps({}))
    assert refusal(tmp_path / "a.pth").startswith("compressed by method 14 of zip; ")
