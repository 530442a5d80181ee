import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal

from magtwin.errors import InputError
from magtwin.learn.models.descent import _Descent
from magtwin.learn.models.temporal import Convolutions, Temporal, Track, fit_temporal, padded

NAMES = ("odom_v_x", "imu_w_z")
TINY = {"features": NAMES, "step_s": 0.1, "layers": (8, 8), "epochs": 12, "batch": 256, "lr": 0.02}
LATE = 4


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """Networks as small as these take longer in two threads than in one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def tracks(count, seed, rows=150):
    """Recordings whose disturbance is 100 nT of the speed four rows ago, with 2 nT of noise."""
    found = []
    for rng in np.random.default_rng(seed).spawn(count):
        x = rng.normal(size=(rows + LATE, 2))
        y = 300 + 100 * x[:-LATE, 0] + rng.normal(0, 2, rows)
        found.append(Track(x[LATE:], np.where(np.arange(rows) < LATE, np.nan, y)))
    return found


def a_network(seed=0, count=8, **options):
    return fit_temporal(tracks(count, 1), tracks(2, 2), rng=np.random.default_rng(seed), **(TINY | options))


@pytest.fixture(scope="module")
def fitted():
    return a_network()


def test_what_an_input_did_some_rows_ago_is_learned(fitted):
    (track,) = tracks(1, 3)
    error = fitted[0].predict(track.x)[0] - track.y
    assert np.nanmean(np.abs(error)) < 20  # 80 nT without a look back


def test_a_row_looks_at_as_many_rows_as_it_says_and_at_no_later_one(fitted):
    model = fitted[0]
    (track,) = tracks(1, 4)
    before = model.predict(track.x)[0]
    x = track.x.copy()
    x[60] += 3.0
    changed = np.flatnonzero(model.predict(x)[0] != before)
    assert (changed.min(), changed.max()) == (60, 60 + model.context)
    assert model.context == 6


def test_the_bytes_of_a_row_are_those_of_the_run_cut_off_after_it(fitted):
    (track,) = tracks(1, 5, rows=1100)
    whole = np.array(fitted[0].predict(track.x))
    for end in (1, 7, 512, 513, 1100):
        assert_array_equal(np.array(fitted[0].predict(track.x[:end])), whole[:, :end])


def test_a_hole_is_nan_and_the_last_whole_row_to_those_after_it(fitted):
    (track,) = tracks(1, 6)
    holed, held = track.x.copy(), track.x.copy()
    holed[[0, 40]] = np.nan
    held[0], held[40] = held[1], held[39]
    found, peer = np.array(fitted[0].predict(holed)), np.array(fitted[0].predict(held))
    assert np.unique(np.argwhere(np.isnan(found))[:, 1]).tolist() == [0, 40]
    whole = np.isfinite(found[0])
    assert_array_equal(found[:, whole], peer[:, whole])


def test_rows_without_any_input_give_nothing(fitted):
    assert np.isnan(fitted[0].predict(np.full((3, 2), np.nan))).all()
    assert fitted[0].predict(np.empty((0, 2)))[0].shape == (0,)


def test_before_its_first_row_a_run_stands_still():
    z = np.arange(6.0).reshape(3, 2)
    assert padded(z, np.ones(3, bool), 2)[:, 0].tolist() == [0, 0, 0, 2, 4]
    assert padded(z, np.array([False, True, True]), 1)[:, 0].tolist() == [2, 2, 2, 4]


def test_training_sees_what_prediction_sees():
    net = Convolutions(2, (4, 4), 3)
    x = np.random.default_rng(0).normal(size=(130, 2))
    model = Temporal(inputs=_unscaled(), net=net.eval(), y_mean_nt=0.0, y_scale_nt=1.0, step_s=0.1)
    with torch.inference_mode():
        peer = net(torch.from_numpy(padded(x, np.ones(130, bool), model.context)).float())[:, 0].numpy()
    np.testing.assert_allclose(model.predict(x)[0], peer, atol=1e-5)


def _unscaled():
    from magtwin.learn.data.inputs import Inputs

    return Inputs(NAMES, np.zeros(2), np.ones(2), np.full(2, np.nan), np.full(2, np.nan))


def test_a_label_that_is_left_out_is_not_learned_from():
    kept, changed = tracks(3, 7), tracks(3, 7)
    for track in kept:
        track.y[50:] = np.nan
    for track in changed:
        track.y[50:] = np.nan
        track.y[:LATE] = np.nan
    a, b = (
        fit_temporal(t, tracks(1, 8), rng=np.random.default_rng(0), **(TINY | {"epochs": 1}))
        for t in (kept, changed)
    )
    assert all(torch.equal(v, b[0].net.state_dict()[n]) for n, v in a[0].net.state_dict().items())
    assert b[1][0].train_rmse_nt > 0


def test_killed_and_resumed_it_ends_in_the_same_weights(tmp_path, monkeypatch):
    whole, _ = a_network(count=2, epochs=3)
    one_pass = _Descent._pass

    def killed(self, number, advance):
        if number == 2:
            raise KeyboardInterrupt
        return one_pass(self, number, advance)

    with monkeypatch.context() as patch:
        patch.setattr(_Descent, "_pass", killed)
        with pytest.raises(KeyboardInterrupt):
            a_network(count=2, epochs=3, checkpoint=tmp_path / "c")
    resumed, _ = a_network(count=2, epochs=3, checkpoint=tmp_path / "c", resume=True)
    for name, value in whole.net.state_dict().items():
        assert torch.equal(resumed.net.state_dict()[name], value)


def test_going_on_starts_at_the_error_it_had(fitted):
    _, history = a_network(init=fitted[0], epochs=1)
    assert history[0].val_rmse_nt == pytest.approx(min(epoch.val_rmse_nt for epoch in fitted[1]))


def test_what_cannot_be_learned_is_refused(fitted):
    with pytest.raises(
        InputError, match=r"layers of \(8, 8\) and a kernel of 3, this training \(8, 8\) and 2"
    ):
        a_network(init=fitted[0], kernel=2)
    with pytest.raises(InputError, match="a kernel of 2 rows at least"):
        Convolutions(2, (4,), 1)
    empty = [Track(np.zeros((5, 2)), np.full(5, np.nan))]
    with pytest.raises(InputError, match="the label is not there in any row; there is nothing to learn"):
        fit_temporal(empty, empty, rng=np.random.default_rng(0), **TINY)
