import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from torch.distributions import Normal

from magtwin.errors import InputError
from magtwin.learn.models import heads
from magtwin.learn.models.descent import _Descent
from magtwin.learn.models.ensemble import Members, fit_ensemble

NAMES = ("odom_v_x", "imu_w_z")
TINY = {"features": NAMES, "members": 3, "layers": (16,), "epochs": 25, "batch": 128, "lr": 0.02}


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Networks as small as these take longer in two threads than in one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def rows(n, seed):
    """A disturbance with a kink, and noise of 5 nT at rest that grows to 45 nT at 1 m/s."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1, 1, (n, 2))
    y = 300 + 100 * np.abs(x[:, 1]) + rng.normal(size=n) * (5 + 40 * np.abs(x[:, 0]))
    return x, y


def an_ensemble(seed=0, n=1500, **options):
    x, y = rows(n, 1)
    x_val, y_val = rows(3000, 2)
    return fit_ensemble(
        x, y, np.arange(n) // 150, x_val, y_val, rng=np.random.default_rng(seed), **(TINY | options)
    )


@pytest.fixture(scope="module")
def fitted():
    return an_ensemble()


def test_the_loss_without_its_weight_is_the_likelihood_of_the_labels():
    out, label = torch.randn(50, 2, generator=torch.Generator().manual_seed(0)), torch.linspace(-2, 2, 50)
    normal = Normal(out[:, 0], (out[:, 1] / 2).exp())
    likelihood = -normal.log_prob(label) - 0.5 * math.log(2 * math.pi)
    weight = (-heads.BETA * out[:, 1]).exp()
    assert_allclose(heads.loss(out, label, weight), likelihood.mean(), rtol=1e-5)


def test_it_finds_a_disturbance_and_how_its_noise_grows(fitted):
    model, history = fitted
    x, _ = rows(500, 3)
    mean, sd = model.predict(x)
    assert np.abs(mean - 300 - 100 * np.abs(x[:, 1])).mean() < 8
    quiet, loud = np.abs(x[:, 0]) < 0.1, np.abs(x[:, 0]) > 0.9
    assert sd[quiet].mean() < 0.5 * sd[loud].mean()
    assert sd[loud].mean() == pytest.approx(43, abs=10)
    assert len(history) == 25


def test_members_differ_where_nothing_was_learned(fitted):
    inside, outside = np.zeros((1, 2)), np.array([[0.0, 12.0]])
    assert fitted[0].predict(outside)[1] > 3 * fitted[0].predict(inside)[1]


def test_mean_and_sd_are_those_of_the_members_outputs(fitted):
    model = fitted[0]
    x = rows(40, 4)[0]
    with torch.inference_mode():
        out = model.net(torch.from_numpy(model.inputs.scaled(x)).float()).double().numpy()
    means, variances = heads.moments(out, model.y_mean_nt, model.y_scale_nt)
    mean, sd = model.predict(x)
    assert_allclose(mean, means.mean(axis=0), atol=1e-3)
    assert_allclose(sd, np.sqrt(variances.mean(axis=0) + means.var(axis=0)), atol=1e-3)


def test_a_rows_bytes_do_not_depend_on_its_neighbours_and_nan_stays_in_its_row(fitted):
    x = rows(700, 5)[0]
    x[600, 1] = np.nan
    found = np.array(fitted[0].predict(x))
    assert_array_equal(fitted[0].predict(x[595:610]), found[:, 595:610])
    assert np.unique(np.argwhere(np.isnan(found))[:, 1]).tolist() == [600]


def test_one_seed_gives_one_ensemble_and_another_seed_another():
    a, b, c = (an_ensemble(seed, n=300, epochs=1)[0].net.state_dict() for seed in (0, 0, 1))
    assert all(torch.equal(a[name], b[name]) for name in a)
    assert not torch.equal(a["weights.0"], c["weights.0"])


def test_killed_and_resumed_it_ends_in_the_same_weights(tmp_path, monkeypatch):
    whole, history = an_ensemble(n=300, epochs=3)
    file = tmp_path / "c"
    one_pass = _Descent._pass

    def killed(self, number, advance):
        if number == 3:
            raise KeyboardInterrupt
        return one_pass(self, number, advance)

    with monkeypatch.context() as patch:
        patch.setattr(_Descent, "_pass", killed)
        with pytest.raises(KeyboardInterrupt):
            an_ensemble(n=300, epochs=3, checkpoint=file)
    resumed, again = an_ensemble(n=300, epochs=3, checkpoint=file, resume=True)
    for name, value in whole.net.state_dict().items():
        assert torch.equal(resumed.net.state_dict()[name], value)
    assert again == history
    with pytest.raises(InputError, match="its members is 3, here 2"):
        an_ensemble(n=300, epochs=3, members=2, checkpoint=file, resume=True)
    with pytest.raises(InputError, match="the checkpoint of another training: its rows is"):
        an_ensemble(n=299, epochs=3, checkpoint=file, resume=True)


def test_going_on_starts_at_the_error_it_had_and_leaves_frozen_layers():
    begun, before = an_ensemble(epochs=1, lr=1e-3)
    model, history = an_ensemble(init=begun, freeze=["layers.0"], epochs=2)
    assert history[0].number == 0
    assert history[0].val_rmse_nt == pytest.approx(before[0].val_rmse_nt)
    assert torch.equal(model.net.weights[0], begun.net.weights[0])
    assert not torch.equal(model.net.weights[1], begun.net.weights[1])


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"members": 2}, r"layers of \(16,\) and 3 members, this training odom_v_x, imu_w_z, \(16,\) and 2"),
        ({"freeze": ["layers.2"]}, "no layer 'layers.2'; did you mean 'layers."),
        ({"freeze": ["layers.0", "layers.1"]}, "every layer is frozen; there is nothing left to train"),
        ({"lr": 1e30}, "training diverged in epoch 1; give a step size lr below 1e"),
    ],
)
def test_what_cannot_be_gone_on_from_is_refused(fitted, options, text):
    with pytest.raises(InputError, match=text):
        an_ensemble(n=150, init=fitted[0], epochs=1, **options)


def test_a_label_that_never_varies_is_refused():
    x, _ = rows(100, 1)
    with pytest.raises(InputError, match="the label is 5 nT in every training row"):
        fit_ensemble(
            x, np.full(100, 5.0), np.zeros(100, int), x, x[:, 0], rng=np.random.default_rng(0), **TINY
        )


def test_an_ensemble_of_none_is_refused():
    with pytest.raises(InputError, match="hidden layers above 0 wide and a member at least"):
        Members(2, (8,), 0)
