import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.learn.training.descent import Dropout
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


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3, 0.9])
def test_dropout_drops_its_share_and_scales_the_others_up(share):
    drop = Dropout(share, torch.Generator().manual_seed(5))
    out = torch.stack([drop(torch.ones(99, 999)) for _ in range(10)])
    dropped = (out == 0).double()
    sd = np.sqrt(share * (1 - share))
    assert abs(float(dropped.mean()) - share) <= 4 * sd / np.sqrt(out.numel()) + 1e-5
    assert_allclose(out[out != 0].numpy(), 1 / (1 - share), rtol=2e-4)  # to a 65,536th of 0.1
    assert_allclose(dropped.mean(dim=(0, 1)).numpy(), share, atol=6 * sd / np.sqrt(990))  # no unit is spared
    if share:
        assert not torch.equal(out[0], out[1])


def test_dropped_units_pass_no_gradient():
    h = torch.ones(8, 64, requires_grad=True)
    out = Dropout(0.5, torch.Generator().manual_seed(0))(h)
    out.sum().backward()
    assert torch.equal(h.grad, out.detach())


def test_a_device_that_is_not_there_is_refused():
    with pytest.raises(InputError, match="device 'nowhere': this torch has none"):
        a_training(n=300, epochs=1, device="nowhere")


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
    with pytest.raises(InputError) as refused:
        train(x, y, X, Y, rng=np.random.default_rng(0), **(SMALL | {"epochs": 2} | options))
    assert str(refused.value) == text


class KilledError(Exception):
    """What ends a training before its time."""


def killed_after(number):
    def progress(epoch):
        if epoch.number == number:
            raise KilledError

    return progress


def same(a, b):
    return all(np.array_equal(value, b.tensors()[name]) for name, value in a.tensors().items())


SHORT = {"n": 600, "epochs": 3, "dropout": 0.3, "batch": 64}


@pytest.mark.parametrize("number", [1, 3])
def test_a_training_that_was_killed_and_resumed_gives_the_weights_of_one_that_was_not(tmp_path, number):
    whole, history = a_training(**SHORT)
    state = tmp_path / "state"
    with pytest.raises(KilledError):
        a_training(**SHORT, checkpoint=state, progress=killed_after(number))
    rest = []
    net, again = a_training(**SHORT, checkpoint=state, resume=True, progress=rest.append)
    assert same(net, whole)
    assert again == history
    assert net.residual_sd_nt == whole.residual_sd_nt
    assert tuple(rest) == history[number:]


def test_a_training_resumed_after_its_patience_ended_goes_no_further(tmp_path):
    x, y = rows(300, 1)
    options = {**SMALL, "epochs": 50, "patience": 2, "checkpoint": tmp_path / "state"}
    first, history = train(x, y, x, -y, rng=np.random.default_rng(0), **options)
    net, again = train(x, y, x, -y, rng=np.random.default_rng(0), resume=True, **options)
    assert len(history) < 50
    assert again == history
    assert same(net, first)


def test_a_fine_tuning_is_resumed_to_the_bit_too(tmp_path):
    init, _ = a_training(n=300, epochs=1)
    options = {**SHORT, "seed": 5, "init": init, "freeze": ["layers.1"]}
    whole, history = a_training(**options)
    with pytest.raises(KilledError):
        a_training(**options, checkpoint=tmp_path / "state", progress=killed_after(1))
    net, again = a_training(**options, checkpoint=tmp_path / "state", resume=True)
    assert [epoch.number for epoch in history] == [0, 1, 2, 3]
    assert again == history
    assert same(net, whole)


def test_frozen_layers_stay_as_they_were_and_the_others_learn():
    init, _ = a_training(n=300, epochs=1)
    net, _ = a_training(seed=3, n=2000, epochs=2, init=init, freeze=["layers.0", "layers.1"])
    before, after = init.tensors(), net.tensors()
    for name in ("layers.0.weight", "layers.0.bias", "layers.1.weight", "x_mean", "y_scale"):
        assert np.array_equal(after[name], before[name])
    assert not np.array_equal(after["layers.2.weight"], before["layers.2.weight"])


def test_fine_tuning_that_does_no_good_leaves_the_weights_as_they_were():
    init, _ = a_training(n=2000, epochs=10)
    x, y = rows(50, 1)
    net, history = train(x, -y, *rows(500, 2), rng=np.random.default_rng(0), init=init, **SMALL, epochs=2)
    assert [epoch.best for epoch in history] == [True, False, False]
    assert same(net, init)
    error = rows(500, 2)[1] - net.predict(rows(500, 2)[0])[0]
    assert_allclose(history[0].val_mae_nt, np.abs(error).mean(), rtol=1e-6)  # float32 in another order


def test_fine_tuning_widens_the_training_ranges_and_leaves_unknown_ones_unknown():
    init, _ = a_training(n=300, epochs=1)
    init.inputs.high[1] = np.nan
    x, y = rows(300, 1)
    net, _ = train(x + 30, y, x, y, rng=np.random.default_rng(0), init=init, **SMALL, epochs=1)
    assert_allclose(net.inputs.low, x.min(axis=0))
    assert_allclose(net.inputs.high, [x[:, 0].max() + 30, np.nan])


def test_how_many_rows_are_done_is_told_step_by_step():
    told = []
    a_training(n=600, epochs=2, advance=lambda done, total: told.append((done, total)))
    assert told == [(n, 1200) for n in (256, 512, 600, 856, 1112, 1200)]


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"seed": 1}, "the checkpoint of another training: its seed is"),
        ({"lr": 1e-2}, "its lr is 0.003, here 0.01; resume with the same settings, or start anew"),
        ({"n": 599}, "the checkpoint of another training: its rows is"),
        ({"layers": (16, 16)}, "its layers is [32, 32], here [16, 16]"),
        ({"patience": 0}, "patience must be 1 epoch at least, got 0; leave it out to run all epochs"),
        ({"freeze": ["layers.0"]}, "freeze keeps layers of trained weights: give init too"),
        ({"checkpoint": None}, "there is no checkpoint to resume from; name one"),
    ],
)
def test_a_checkpoint_of_another_training_is_refused(tmp_path, options, text):
    state = tmp_path / "state"
    with pytest.raises(KilledError):
        a_training(**SHORT, checkpoint=state, progress=killed_after(1))
    with pytest.raises(InputError) as refused:
        a_training(**(SHORT | {"checkpoint": state, "resume": True} | options))
    assert text in str(refused.value)


@pytest.mark.parametrize("harm", ["gone", "cut", "pickle", "net", "tensor", "epochs", "keys"])
def test_a_damaged_checkpoint_is_refused(tmp_path, harm):
    state = tmp_path / "state"
    with pytest.raises(KilledError):
        a_training(**SHORT, checkpoint=state, progress=killed_after(1))
    whole = state.read_bytes()
    changed = {
        "cut": whole[:-100],
        "pickle": b"\x80\x04N.",
        "tensor": whole.replace(b'"rng.order"', b'"rnh.order"'),
        "epochs": whole.replace(b'\\"number\\": 1', b'\\"number\\": 2'),
        "keys": whole.replace(b'\\"best\\": true', b'\\"bast\\": true'),
    }
    if harm == "gone":
        state.unlink()
    elif harm == "net":
        a_training(n=300, epochs=1)[0].save(state, force=True)
    else:
        assert changed[harm] != whole
        state.write_bytes(changed[harm])
    with pytest.raises(InputError, match=r"start anew|no such checkpoint"):
        a_training(**SHORT, checkpoint=state, resume=True)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"layers": (16, 16)}, "and layers of (32, 32), this training yaw_deg, odom_v_x and (16, 16)"),
        ({"freeze": ["layer.0"]}, "no layer 'layer.0'; did you mean 'layers.0'?"),
        ({"freeze": [f"layers.{i}" for i in range(3)]}, "every layer is frozen; there is nothing left"),
    ],
)
def test_weights_that_cannot_be_gone_on_from_are_refused(options, text):
    init, _ = a_training(n=300, epochs=1)
    with pytest.raises(InputError) as refused:
        a_training(n=300, epochs=1, init=init, **options)
    assert text in str(refused.value)


def test_a_row_counts_as_much_as_it_weighs():
    rng, (x, y) = np.random.default_rng(3), rows(2000, 1)
    wrong = rng.random(len(y)) < 0.4
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
    for bad in (weight[:-1], 0 * weight, np.where(wrong, np.nan, 1.0)):
        with pytest.raises(InputError, match="weight must be above 0 and finite, one for each of 2000"):
            train(x, y, *rows(500, 2), rng=rng, weight=bad, **options)
