"""Model error: readings are off a network's predictions by what the network says, session by session."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from test_network import a_net

from magtwin import simulate, sweep
from magtwin.run.run import COLUMNS
from magtwin.sim.sensors.model_error import ModelError
from magtwin.twin import Twin, in_session, open_twin

SD, OFFSET, TIME_S = 120.0, 80.0, 2.0
FACTS = {"residual_offset_sd_nt": OFFSET, "residual_within_sd_nt": 89.4, "residual_time_s": TIME_S}
SHORT = {"duration_s": 2.0, "rate_hz": 20.0}


def weights(folder, **options):
    file = folder / "small.safetensors"
    a_net("full", (8, 8), **options).save(file)
    return file


@pytest.fixture(scope="module")
def net(tmp_path_factory):
    return weights(tmp_path_factory.mktemp("net"), residual_sd_nt=SD, metadata=FACTS)


@pytest.fixture(scope="module")
def twin(lab_scene, net) -> Twin:
    return open_twin(lab_scene, network=net)


def test_the_variance_is_that_of_the_prediction_whatever_that_is():
    rng = np.random.default_rng(0)
    sd = np.array([10.0, 79.0, 80.0, 81.0, 150.0, 900.0])
    errors = np.array(
        [
            ModelError(OFFSET, TIME_S).in_session(rng).error_nt(sd, rng.standard_normal(len(sd)))
            for _ in range(20_000)
        ]
    )
    assert_allclose(errors.std(axis=0), sd, rtol=0.02)  # 20,000 draws tell it to 0.5 %
    assert_allclose(errors.mean(axis=0), 0, atol=0.03 * sd.max())


def test_readings_lie_in_their_intervals_on_many_sessions(twin):
    runs = sweep(twin, "figure8", range(150), columns=["b_total_nt", "b_measured_nt", "b_sd_nt"], **SHORT)
    off = np.array([(run["b_measured_nt"] - run["b_total_nt"]) / run["b_sd_nt"] for run in runs])
    # 150 sessions are 150 draws of a constant that has 44 % of the variance
    assert np.mean(np.abs(off) <= 1.6449) == pytest.approx(0.9, abs=0.04)
    assert off.std() == pytest.approx(1.0, abs=0.09)
    within = off - off.mean(axis=1, keepdims=True)
    assert off.mean(axis=1).std() > 0.6
    assert within.std() < 0.7


def test_readings_add_up_and_everything_else_is_as_without_the_error(twin):
    run = simulate(twin, "figure8", seed=3, **SHORT)
    plain = simulate(twin, "figure8", seed=3, model_error=False, **SHORT)
    total = run["b_total_nt"] + run["b_model_error_nt"]
    assert_allclose(run["b_measured_nt"], total + run["b_noise_nt"], rtol=0, atol=1e-9)
    assert np.abs(run["b_model_error_nt"]).max() > 10
    assert_array_equal(plain["b_model_error_nt"], 0)
    for name in COLUMNS.keys() - {"b_model_error_nt", "b_measured_nt"}:
        assert_array_equal(run[name], plain[name], err_msg=name)
    assert (run.metadata["model_error"], plain.metadata["model_error"]) == (True, False)


def offsets(lab_scene, tmp_path, of):
    """The constants of runs whose error is an offset alone."""
    net = weights(tmp_path, residual_sd_nt=SD, metadata=FACTS | {"residual_offset_sd_nt": SD})
    runs = of(open_twin(lab_scene, network=net))
    for run in runs:
        assert np.ptp(run["b_model_error_nt"]) < 1e-9
    return [float(run["b_model_error_nt"][0]) for run in runs]


def test_a_session_has_one_offset_and_another_session_another(lab_scene, tmp_path):
    def of(twin):
        first, second = (in_session(twin, k, seed=5) for k in (0, 1))
        made = [simulate(one, "sine", seed=seed, **SHORT) for seed in (1, 2) for one in (first, second)]
        many = sweep(twin, "sine", [1, 2], robots=[first, second], **SHORT)
        return [*made, *many]

    a, b, again, other, many_a, many_b = offsets(lab_scene, tmp_path, of)
    assert a == again == many_a
    assert b == other == many_b
    assert abs(a - b) > 1e-3 * SD
