import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from magtwin.learn.train import train
from magtwin.names import RefusedError

NAMES = ("yaw_deg", "odom_v_x")
SMALL = {"features": NAMES, "layers": (32, 32), "dropout": 0.0, "batch": 256, "lr": 3e-3}


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
    with torch.inference_mode():
        found = net(torch.from_numpy(x)).numpy()
    assert_allclose(found, 300 + 200 * np.cos(np.radians(x[:, 0])) + 500 * x[:, 1], atol=25)
    assert len(history) == 15


def test_one_seed_gives_one_network_and_another_seed_another():
    a, b, c = (a_training(seed, n=600, epochs=2, dropout=0.3)[0].state_dict() for seed in (0, 0, 1))
    assert all(torch.equal(a[name], b[name]) for name in a)
    assert not torch.equal(a["layers.0.weight"], c["layers.0.weight"])


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
    with torch.inference_mode():
        error = net(torch.from_numpy(x_val)).numpy() - y_val
    assert_allclose(np.sqrt(np.mean(error**2)), best.val_rmse_nt)
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
    assert_allclose(net.x_min, x.min(axis=0))
    assert_allclose(net.x_max, x.max(axis=0))
    assert_allclose(float(net.y_mean), y.mean())


X, Y = rows(50, 0)


@pytest.mark.parametrize(
    ("x", "y", "options", "text"),
    [
        (X, np.full(50, 3.0), {}, "the label is 3 nT in every training row; there is nothing to learn"),
        (
            np.where(np.arange(100).reshape(50, 2) == 41, np.nan, X),
            Y,
            {},
            "1 training rows hold nan or inf, first row 20 in odom_v_x; leave them out",
        ),
        (
            X,
            np.where(np.arange(50) >= 48, np.inf, Y),
            {},
            "2 training rows hold nan or inf, first row 48 in label; leave them out",
        ),
        (
            X[:, :1],
            Y,
            {},
            "training rows must be features (N, 2) and labels (N,), got (50, 1) and (50,)",
        ),
        (X, Y, {"epochs": 0}, "epochs, batch and lr must be above 0, got 0, 256 and 0.003"),
        (X, Y, {"lr": 1e30}, "training diverged in epoch 1; give a step size lr below 1e+30"),
        (X, Y, {"features": ("yaw_deg", "odom_vx")}, "no feature 'odom_vx'; did you mean 'odom_v_x'?"),
    ],
)
def test_what_cannot_be_trained_on_is_refused(x, y, options, text):
    with pytest.raises(RefusedError) as refused:
        train(x, y, X, Y, rng=np.random.default_rng(0), **(SMALL | {"epochs": 2} | options))
    assert str(refused.value) == text
