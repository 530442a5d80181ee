import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.learn.training.fit_network import train

NAMES = ("yaw_deg", "odom_v_x")
SMALL = {"features": NAMES, "layers": (32, 32), "dropout": 0.0, "batch": 256, "lr": 3e-3}


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Networks as small as these take longer in two threads than in one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def rows(n, seed):
    """A disturbance of known form: a turn of heading and a share of speed, with 10 nT of noise."""
    rng = np.random.default_rng(seed)
    x = np.column_stack([rng.uniform(0, 360, n), rng.uniform(0, 0.3, n)])
    y = 300 + 200 * np.cos(np.radians(x[:, 0])) + 500 * x[:, 1] + rng.normal(0, 10, n)
    return x, y


def a_training(seed=0, n=4000, **options):
    rng = np.random.default_rng(seed)
    return train(*rows(n, 1), *rows(1000, 2), rng=rng, **(SMALL | {"epochs": 15} | options))


def test_training_finds_a_known_disturbance_down_to_its_noise():
    net, history = a_training()
    assert 9 < net.residual_sd_nt < 15  # 10 nT of noise, and what 15 epochs leave
    x, _ = rows(5, 3)
    found = net.predict(x)[0]
    assert_allclose(found, 300 + 200 * np.cos(np.radians(x[:, 0])) + 500 * x[:, 1], atol=25)
    assert len(history) == 15


def test_one_seed_gives_one_network_and_another_seed_another():
    a, b, c = (a_training(seed, n=600, epochs=2, dropout=0.3)[0].tensors() for seed in (0, 0, 1))
    assert all(np.array_equal(a[name], b[name]) for name in a)
    assert not np.array_equal(a["layers.0.weight"], c["layers.0.weight"])


def test_training_leaves_torchs_own_generator_as_it_was():
    before = torch.random.get_rng_state()
    a_training(n=300, epochs=1)
    assert torch.equal(torch.random.get_rng_state(), before)


def test_the_weights_of_the_best_epoch_are_kept():
    rng = np.random.default_rng(0)
    x, y = rows(300, 1)
    y = y + rng.normal(0, 300, 300)  # noise enough to overfit
    x_val, y_val = rows(1000, 2)
    net, history = train(x, y, x_val, y_val, rng=rng, **(SMALL | {"epochs": 40, "batch": 32}))
    best = min(history, key=lambda epoch: epoch.val_rmse_nt)
    assert best.number < len(history)
    error = net.predict(x_val)[0] - y_val
    assert_allclose(np.sqrt(np.mean(error**2)), best.val_rmse_nt, rtol=1e-6)  # float32 in another order
    assert net.residual_sd_nt == best.val_rmse_nt


def test_training_stops_when_patience_ends():
    x, y = rows(300, 1)
    x_val, y_val = rows(300, 2)
    seen = []
    _, history = train(
        x, y, x_val, -y_val, rng=np.random.default_rng(0), patience=2, progress=seen.append,
        **(SMALL | {"epochs": 50}),
    )  # fmt: skip
    assert len(history) < 50
    assert not any(epoch.best for epoch in history[-2:])
    assert tuple(seen) == history


def test_the_network_knows_its_training_ranges():
    net, _ = a_training(n=300, epochs=1)
    x, y = rows(300, 1)
    assert_allclose(net.inputs.low, x.min(axis=0))
    assert_allclose(net.inputs.high, x.max(axis=0))
    assert_allclose(net.y_mean, y.mean())


@pytest.mark.parametrize(
    ("change", "text"),
    [({"y": np.full(50, 3.0)}, "the label is 3 nT"), ({"lr": 1e30}, "training diverged in epoch 1")],
)
def test_what_cannot_be_trained_on_is_refused(change, text):
    x, y = rows(50, 0)
    given = SMALL | {"y": y, "rng": np.random.default_rng(0), "epochs": 2} | change
    with pytest.raises(InputError, match=text):
        train(x, x_val=x, y_val=y, **given)


def same(a, b):
    return all(np.array_equal(value, b.tensors()[name]) for name, value in a.tensors().items())


def test_fine_tuning_that_does_no_good_leaves_the_weights_as_they_were():
    init, _ = a_training(n=2000, epochs=10)
    x, y = rows(50, 1)
    net, history = train(x, -y, *rows(500, 2), rng=np.random.default_rng(0), init=init, **SMALL, epochs=2)
    assert [epoch.best for epoch in history] == [True, False, False]
    assert same(net, init)
    assert history[0].val_rmse_nt == net.residual_sd_nt


def test_fine_tuning_widens_the_training_ranges_and_leaves_unknown_ones_unknown():
    init, _ = a_training(n=300, epochs=1)
    init.inputs.high[1] = np.nan
    x, y = rows(300, 1)
    net, _ = train(x + 30, y, x, y, rng=np.random.default_rng(0), init=init, **SMALL, epochs=1)
    assert_allclose(net.inputs.low, x.min(axis=0))
    assert_allclose(net.inputs.high, [x[:, 0].max() + 30, np.nan])


def test_a_network_of_other_layers_is_not_gone_on_from():
    init, _ = a_training(n=300, epochs=1)
    with pytest.raises(InputError, match=r"layers of \(32, 32\), this training \(16, 16\)"):
        a_training(n=300, epochs=1, init=init, layers=(16, 16))


def test_a_row_counts_as_much_as_it_weighs():
    x, y = rows(2000, 1)
    wrong = np.random.default_rng(3).random(len(y)) < 0.4
    spoilt = np.where(wrong, y + 800, y)
    weight = np.where(wrong, 1e-6, 7.0)
    options = SMALL | {"epochs": 25, "batch": 128}
    found = [
        train(x, spoilt, *rows(500, 2), rng=np.random.default_rng(0), weight=w, **options)[0]
        for w in (weight, 2 * weight)
    ]
    assert found[0].residual_sd_nt < 40  # over 300 nT where all count alike
    for name, value in found[0].tensors().items():
        assert_allclose(value, found[1].tensors()[name], rtol=1e-3, atol=1e-5)
