import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from test_magnetometer import inputs
from test_network import a_net

from magtwin.learn.data.features import FULL
from magtwin.learn.models import compiled, sparse
from magtwin.learn.models.sparse import Skipping


@pytest.fixture(autouse=True)
def closed(monkeypatch):
    """Compiled code as in a process that has not opened it."""
    monkeypatch.setattr(Skipping, "compiled", None)
    monkeypatch.setattr(Skipping, "left_out", 0.0)
    monkeypatch.setattr(Skipping, "chunks", {})


@pytest.fixture(scope="module")
def net():
    """Most of whose units are 0 in most rows."""
    net = a_net(FULL, (128, 128, 160, 128))
    with torch.no_grad():
        for layer in net.linears[:-1]:
            layer.weight *= 3
            layer.bias -= 1
    return net


def a_layer(rng, rows, inputs, outputs, share):
    """Rows with a share of units that are not 0, weights and biases."""
    h = np.where(rng.random((rows, inputs)) < share, rng.normal(size=(rows, inputs)), 0)
    weight, bias = rng.normal(size=(inputs, outputs)), rng.normal(size=outputs)
    return tuple(part.astype(np.float32) for part in (h, weight, bias))


def forward(h, weight, bias, chunk):
    out = np.empty((len(h), len(bias)), np.float32)
    compiled.forward(h, weight.reshape(-1), bias, chunk, out)
    return out


@pytest.mark.parametrize("share", [0.0, 0.01, 0.1, 0.5, 1.0])
@pytest.mark.parametrize("shape", [(1, 1), (7, 3), (20, 64), (65, 17), (200, 128)])
@pytest.mark.parametrize("chunk", [16, 192])
def test_a_layer_without_its_zeros_is_the_whole_layer_to_rounding(share, shape, chunk):
    h, weight, bias = a_layer(np.random.default_rng(0), 9, *shape, share)
    whole = np.maximum(bias.astype(float) + h.astype(float) @ weight.astype(float), 0)
    # K sums of float32, each rounded to 2**-24 of what stands, which is below the sum of sizes
    sizes = np.abs(bias) + np.abs(h) @ np.abs(weight)
    assert np.all(np.abs(forward(h, weight, bias, chunk) - whole) <= (shape[0] + 2) * 2.0**-24 * sizes)


def test_nan_and_inf_come_out_of_a_layer_as_they_do_of_a_dense_one():
    h, weight, bias = a_layer(np.random.default_rng(1), 4, 40, 24, 0.1)
    h[1, 5], h[2, 7] = np.nan, np.inf
    out = forward(h, weight, bias, 192)
    assert np.isnan(out[1]).all()
    assert_array_equal(out[2], np.where(weight[7] > 0, np.inf, 0))
    assert np.isfinite(out[[0, 3]]).all()


def test_a_layer_gives_the_bits_of_this_machines_product_or_is_not_used():
    sparse.warm_up()
    for shape in ((128, 160), (160, 128), (512, 128)):
        h, weight, bias = (torch.from_numpy(a) for a in a_layer(np.random.default_rng(2), 48, *shape, 0.1))
        out = torch.full((len(h), shape[1]), -1.0)
        worked = Skipping([(weight, bias)]).forward(0, h, out)
        assert worked == (Skipping.chunk_of(*shape) is not None)
        assert torch.equal(out, torch.addmm(bias, h, weight).relu_() if worked else torch.full_like(out, -1))


def test_a_row_has_the_same_bytes_with_compiled_code_and_without_alone_and_among_others(net):
    x = inputs(net, 1100)
    x[7, 3] = np.nan
    dense = net.predict(x)[0]
    sparse.warm_up()
    assert_array_equal(net.predict(x)[0], dense)
    assert_array_equal(net.predict(x[500:533])[0], dense[500:533])
    assert np.flatnonzero(np.isnan(dense)) == [7]


def test_one_thread_and_two_give_the_same_bytes_without_zeros(net):
    sparse.warm_up()
    x, before = inputs(net, 1100), torch.get_num_threads()
    try:
        found = [(torch.set_num_threads(threads), net.predict(x)[0])[1] for threads in (1, 2)]
    finally:
        torch.set_num_threads(before)
    assert_array_equal(*found)


def test_only_layers_most_of_whose_units_are_0_are_worked_on_without(net, monkeypatch):
    shapes = []

    def spy(h, weight, bias, chunk, out):
        shapes.append(out.shape)
        compiled.forward(h, weight, bias, chunk, out)

    monkeypatch.setattr(Skipping, "compiled", SimpleNamespace(forward=spy))
    monkeypatch.setattr(Skipping, "chunks", {(128, 128): 16, (128, 160): 16, (160, 128): 16})
    net.predict(inputs(net, 64))
    assert (64, 128) in shapes  # the last hidden layer
    shapes.clear()
    a_net(FULL, (128, 128, 128)).predict(inputs(net, 64))  # half of its units are not 0
    assert not shapes


def test_small_layers_stay_dense():
    sparse.warm_up()
    h, weight, bias = (torch.from_numpy(a) for a in a_layer(np.random.default_rng(2), 48, 64, 64, 0.05))
    assert not Skipping([(weight, bias)]).forward(0, h, torch.empty(48, 64))


def test_compiled_code_is_opened_once_it_would_have_paid(net, monkeypatch):
    monkeypatch.setattr(sparse, "PAYS", 1e12)
    net.predict(inputs(net, 512))
    assert Skipping.compiled is None
    assert Skipping.left_out > 0
    monkeypatch.setattr(sparse, "PAYS", 2 * Skipping.left_out)
    monkeypatch.setattr(sparse, "NUMBA", 1)
    net.predict(inputs(net, 512))
    assert Skipping.compiled is compiled


def test_without_numba_products_stay_dense(net, monkeypatch):
    monkeypatch.setattr(sparse, "PAYS", 1.0)
    monkeypatch.setitem(sys.modules, "magtwin.learn.models.compiled", None)
    monkeypatch.delattr("magtwin.learn.models.compiled")
    x = inputs(net, 100)
    with torch.inference_mode():
        assert_allclose(net.predict(x)[0], net(torch.from_numpy(x)).numpy(), atol=1e-3)
    assert Skipping.compiled is None
    with pytest.raises(ImportError):
        sparse.warm_up()
