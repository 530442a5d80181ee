from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_network import RELEASED, a_net
from threadpoolctl import threadpool_limits

from magtwin.errors import InputError
from magtwin.files.file import sha256, shipped
from magtwin.learn.data.features import FULL
from magtwin.learn.inference.magnetometer import NeuralMagnetometer
from magtwin.learn.models.perceptron import threads_of_products
from magtwin.learn.models.predictor import load_predictor
from magtwin.sim.session import session_of
from magtwin.twin import open_twin, sweep


def forward64(net, x):
    """Disturbances in float64 throughout, by plain numpy."""
    h = net.inputs.scaled(x)
    for i, (weight, bias) in enumerate(net.layers):
        h = h @ weight.astype(float).T + bias
        h = np.maximum(h, 0) if i < len(net.layers) - 1 else h
    return net.y_mean + net.y_scale * h[:, 0]


def inputs(net, rows, seed=0):
    """Features distributed as the training rows were."""
    rng = np.random.default_rng(seed)
    return net.inputs.mean + net.inputs.scale * rng.normal(size=(rows, len(net.features)))


def by_torch(net, x):
    """Disturbances by the module that trains networks."""
    import torch

    from magtwin.learn.training.module import NetModule

    with torch.inference_mode():
        return NetModule.of(net)(torch.from_numpy(x)).numpy()


@pytest.fixture(scope="module")
def paper():
    """The paper's shape with random weights."""
    return NeuralMagnetometer(a_net(FULL, (512, 512, 512, 512)))


def test_the_released_network_errs_by_less_than_a_hundredth_nt_against_float64(real_data):
    released = NeuralMagnetometer.load(real_data / RELEASED)
    x = inputs(released.net, 3000)
    assert_allclose(released.net.predict(x)[0], forward64(released.net, x), atol=0.01)  # of up to 8,000 nT


@pytest.mark.parametrize("shape", [(20, 512, 512, 512, 512), (14, 64, 64), (1, 3), (5, 17, 1, 8)])
def test_a_rows_bytes_depend_neither_on_its_neighbours_nor_on_how_many_rows_there_are(shape):
    """Features of 1 to 20 and layers of 1 to 512 take different kernels of the library of products."""
    net = a_net(FULL[: shape[0]], shape[1:])
    x, others = inputs(net, 1100), inputs(net, 1100, seed=1)
    all_at_once = net.predict(x)[0]
    for rows in (1, 2, 15, 16, 17, 511, 512, 513, 1025):
        assert_array_equal(net.predict(x[:rows])[0], all_at_once[:rows])
        mixed = np.vstack([others[:rows], x[rows:]])
        assert_array_equal(net.predict(mixed)[0][rows:], all_at_once[rows:])
    assert_array_equal(net.predict(x[512:])[0], all_at_once[512:])  # blocks of 512 rows


def test_one_thread_and_two_give_the_same_bytes_and_the_number_of_threads_stays(paper):
    x = inputs(paper.net, 1100)
    with threadpool_limits(2):
        two = paper.net.predict(x)[0]
        assert threads_of_products() == 2
    with threadpool_limits(1):
        assert_array_equal(paper.net.predict(x)[0], two)


def test_an_input_beyond_its_training_range_is_outside():
    net = a_net(["battery_fraction", "imu_w_z"])
    net.inputs = replace(net.inputs, low=np.array([0.2, -1.0]), high=np.array([1.0, 1.0]))
    x = [[0.2, 1.0], [1.0, -1.0], [-0.1, 0.0], [0.5, 1.01], [np.nan, 0.0]]
    assert net.outside(x).tolist() == [False, False, True, True, True]
    net = a_net(["battery_v"])  # rounding of an input that never varied is not outside
    net.inputs = replace(net.inputs, low=np.array([15.1]), high=np.array([15.1]))
    assert not net.outside([[np.nextafter(15.1, 16)]]).any()


def test_where_the_range_is_unknown_5_scales_from_the_mean_are_outside(real_data):
    released = NeuralMagnetometer.load(real_data / RELEASED)
    mean, scale = released.net.inputs.mean, released.net.inputs.scale
    x = np.stack([mean, mean + 4.9 * scale, mean - 5.1 * scale])
    x = np.vstack([x, np.where(np.arange(20) == 18, -0.1, mean)])  # the battery runs below empty
    assert released.net.outside(x).tolist() == [False, False, True, True]


def test_the_metadata_name_the_file_its_checksum_and_its_shape(tmp_path):
    path = tmp_path / "small.safetensors"
    a_net(hidden=(8, 4), residual_sd_nt=55.0).save(path)
    magnetometer = NeuralMagnetometer.load(path, sha256=sha256(path).upper())
    assert dict(magnetometer.metadata) == {
        "network": "small.safetensors",
        "network_sha256": sha256(path),
        "network_layers": "20-8-4-1",
        "network_parameters": 20 * 8 + 8 + 8 * 4 + 4 + 4 + 1,
    }
    assert magnetometer.residual_sd_nt == 55.0
    with pytest.raises(InputError, match=f"its sha256 is {sha256(path)}, expected 00ff"):
        NeuralMagnetometer.load(path, sha256="00ff")


# The networks that ship


@pytest.fixture(scope="module", params=["turtlebot4_paper", "turtlebot4_hybrid"])
def shipped_network(request):
    return NeuralMagnetometer.load(shipped("weights", f"{request.param}.safetensors"))


@pytest.fixture(scope="module")
def new_days():
    """Two of the paper's test paths, each on a day of its own, by physics."""
    twin = open_twin(shipped("scenes", "lab", "lab.usda"), magnetometer="physical")
    days = [session_of(twin.scene.robot, 77, day) for day in range(2)]
    runs = sweep(twin, ["narrow_figure8", "curvilinear"], (5, 6), robots=days, rate_hz=5.0)
    return [run.take(np.flatnonzero(~run["flag_outside_map"])) for run in runs]


def test_the_shipped_networks_predict_in_numpy_what_they_predict_in_torch():
    """Sums of 64 or 512 float32 products, in another order: 1e-7 of their terms times the scale of labels."""
    paper = load_predictor(shipped("weights", "turtlebot4_paper.safetensors"))
    x = inputs(paper, 3000)
    assert_allclose(paper.predict(x)[0], by_torch(paper, x), rtol=0, atol=1e-3)
    hybrid = load_predictor(shipped("weights", "turtlebot4_hybrid.safetensors"))
    x = inputs(hybrid, 3000)
    whole = hybrid.base.predict(x)[0] + by_torch(
        hybrid.net, np.clip(x, hybrid.inputs.low, hybrid.inputs.high)
    )
    assert_allclose(hybrid.predict(x)[0], whole, rtol=0, atol=1e-4)


def test_the_card_is_of_the_shipped_network(shipped_network):
    card = shipped("weights", shipped_network.name).with_suffix(".md").read_text(encoding="utf-8")
    assert f"SHA-256 `{shipped_network.sha256}`" in " ".join(card.split())


def test_the_shipped_network_does_better_than_the_mean_label_on_days_and_paths_it_never_saw(
    shipped_network, new_days
):
    label = np.concatenate([run["b_truth_nt"] - run["b_map_nt"] for run in new_days])
    found = np.concatenate([read.disturbance_nt for read in shipped_network.read(new_days)])
    naive = np.abs(label - shipped_network.net.metadata["label_mean_nt"]).mean()
    share = {"mlp": 0.85, "hybrid": 0.5}[shipped_network.net.kind]  # the cards: 0.66 and 0.27
    assert np.abs(found - label).mean() < share * naive
