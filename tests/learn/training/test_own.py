"""Own torch modules: trained, saved, loaded, judged and run in a twin; and what is wrong with one."""

import inspect
import subprocess
import sys

import numpy as np
import pytest
import torch
from places import ROOT

import magtwin as mt
from magtwin import extend
from magtwin.errors import InputError
from magtwin.learn.models.predictor import NETWORKS


class Small(torch.nn.Module):
    """Mean and logarithm of the standard deviation."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        layers = torch.nn.Linear(inputs, 16), torch.nn.Tanh(), torch.nn.Dropout(0.1), torch.nn.Linear(16, 2)
        self.body = torch.nn.Sequential(*layers)

    def forward(self, z):
        return self.body(z)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    twin = mt.open_twin("lab", magnetometer="physical")
    mt.sweep(twin, seeds=6, sessions=3, duration_s=15, rate_hz=5).save(folder / "drives")
    mt.build_dataset(folder / "drives", out=folder / "set", anomaly_map=twin.field)
    return folder


@pytest.fixture(scope="module")
def trained(folder):
    return mt.train(
        folder / "set", model=Small, features="circular", epochs=5, out=folder / "small.safetensors"
    )


def test_an_own_module_saves_loads_is_judged_and_runs_in_a_twin(folder, trained):
    file = folder / "small.safetensors"
    loaded = mt.load_predictor(file)
    x = np.random.default_rng(0).standard_normal((700, len(loaded.features)))
    x[3, 2] = np.nan
    (mean, sd), part = loaded.predict(x), loaded.predict(x[10:20])
    assert [each.tobytes() for each in trained.predictor.predict(x)] == [mean.tobytes(), sd.tobytes()]
    assert [each.tobytes() for each in part] == [mean[10:20].tobytes(), sd[10:20].tobytes()]
    assert np.isnan(mean[3])
    assert np.ptp(sd[4:]) > 0  # its own standard deviations
    field = mt.open_twin("lab", magnetometer="physical").field
    judged = mt.evaluate([file, trained], folder / "set", anomaly_map=field, any_map=True)
    assert "small" in str(judged)
    runs = [mt.simulate("lab", network=network, duration_s=2, seed=3) for network in (file, loaded, trained)]
    assert (
        runs[0]["b_total_nt"].tobytes() == runs[1]["b_total_nt"].tobytes() == runs[2]["b_total_nt"].tobytes()
    )
    swept = mt.sweep("lab", "figure8", 2, seed=2, network=file, duration_s=2)
    assert swept[1]["b_total_nt"].tobytes() == runs[0]["b_total_nt"].tobytes()
    again = mt.train(folder / "set", model=Small, features="circular", epochs=5)
    assert (
        again.predictor.tensors()["net.body.0.weight"].tobytes()
        == loaded.tensors()["net.body.0.weight"].tobytes()
    )
    assert "test_own:Small" in (folder / "small.md").read_text()


def test_an_affine_module_comes_as_near_as_least_squares(folder):
    """The mean square of an affine module has one minimum, that of the linear model without a penalty."""
    options = {"features": "circular", "epochs": 300, "lr": 0.02, "batch": 64}
    module = mt.train(folder / "set", model=torch.nn.Linear(14, 1), **options)
    linear = mt.train(folder / "set", model="linear", features="circular", penalty=0.0, weighting="none")
    assert module.history[-1].train_rmse_nt < 1.1 * linear.predictor.metadata["label_sd_nt"]
    assert module.parts[0].rmse_nt < 1.2 * linear.parts[0].rmse_nt


def test_a_module_of_another_program_drives_a_room_once_its_class_is_given(folder, trained):
    program = f"""
import inspect, torch, numpy as np, magtwin as mt
{inspect.getsource(Small)}
loaded = mt.load_predictor({str(folder / "small.safetensors")!r}, module=Small)
room = mt.Room(4, 3).survey(spacing_m=1.5, headings_deg=[0], readings=2).shelf((1.5, 0.5)).robot()
given = dict(network=loaded, duration_s=1)
run, swept = mt.simulate(room, "figure8", **given), mt.sweep(room, "figure8", 1, **given)[0]
assert run["b_total_nt"].tobytes() == swept["b_total_nt"].tobytes()
assert mt.open_twin(room, network=loaded).magnetometer.name == "Small.safetensors"
assert mt.extend.network("my:Small")(Small) is Small
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert done.returncode == 0, done.stderr


def test_a_file_executes_nothing_and_its_class_is_given_or_registered(folder, trained):
    file = folder / "small.safetensors"
    program = f"import magtwin as mt\nmt.load_predictor({str(file)!r})"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert "no code is loaded from a file; give its class" in done.stderr
    assert mt.load_predictor(file, module=Small).parameters_count == trained.predictor.parameters_count
    with pytest.raises(InputError, match=r"'net\.weight' is missing"):
        mt.load_predictor(file, module=torch.nn.Linear(14, 2))
    extend.network("own-small")(Small)
    try:
        named = mt.train(folder / "set", model=Small, features="circular", epochs=1).predictor
        assert named.name == "own-small"
    finally:
        NETWORKS._loaded.pop("own-small")
    with pytest.raises(InputError, match="leave `module` out"):
        mt.load_predictor(next((ROOT / "weights").rglob("*.safetensors")), module=Small)


class Nan(torch.nn.Module):
    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.layer = torch.nn.Linear(inputs, 1)

    def forward(self, z):
        return torch.log(self.layer(z) * 0 - 1)


class Needs(torch.nn.Module):
    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (torch.nn.Linear(7, 1), r"fails on 8 rows of 14 features, shape \(8, 14\).*first layer must take 14"),
        (torch.nn.Linear(14, 3), r"gives shape \(8, 3\) for 8 rows.*it must be \(8,\) or \(8, 1\)"),
        (Nan, "is nan on row 0 of finite features, before any training"),
        (Needs, "fails: TypeError.*missing 1 required.*give an instance"),
        (torch.nn.ReLU(), "no parameters"),
        (dict, "must be a torch.nn.Module, its class, or a name, got dict"),
        ("module", "give its class, `model=MyModule`"),
        ("hybird", "did you mean 'hybrid'"),
    ],
)
def test_a_module_that_does_not_fit_is_refused_before_training(folder, model, words):
    with pytest.raises(InputError, match=words):
        mt.train(folder / "set", model=model, features="circular")


def test_options_that_a_module_does_not_read_are_refused(folder):
    with pytest.raises(InputError, match="layers is no option of 'module'"):
        mt.train(folder / "set", model=Small, layers=(3,))
