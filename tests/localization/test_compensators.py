import math

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.frames import quat_from_yaw
from magtwin.localization.compensators import COMPENSATORS, Iron, Ridge, TollesLawson, compensated
from magtwin.localization.problem import Reading
from magtwin.localization.readings import readings_of

FIELD = synthetic.wavy_map(0)


def session(seed, *, count=400, zero=0.7, iron=(300.0, -200.0), current=0.0, drift=30.0):
    """A drive with true poses, an IMU whose heading is off by `zero`, iron and a current's field."""
    rng = np.random.default_rng(seed)
    truth = synthetic.wander(rng, FIELD.extent, count, 0.2, 0.35)
    ampere = 1 + np.repeat(rng.uniform(0, 1, count // 20), 20)
    walk = np.zeros(count)
    for k in range(1, count):
        walk[k] = 0.96 * walk[k - 1] + drift * math.sqrt(1 - 0.96**2) * rng.standard_normal()
    own = iron[0] * np.cos(truth[:, 2]) + iron[1] * np.sin(truth[:, 2]) + current * ampere
    b = FIELD.mean(truth[:, :2], truth[:, 2]) + own + walk + 10 * rng.standard_normal(count)
    columns = {
        "t": np.arange(count) * 0.2,
        "p_world_base": np.column_stack([truth[:, :2], np.zeros(count)]),
        "yaw": truth[:, 2],
        "odom_p": np.zeros((count, 3)),
        "odom_q_xyzw": quat_from_yaw(truth[:, 2] - truth[0, 2]),
        "imu_q_xyzw": quat_from_yaw(truth[:, 2] + zero),
        "battery_a": ampere,
        "b_measured_nt": b,
    }
    from magtwin.run.run import Run

    return Run(columns), own


def test_iron_is_found_and_its_error_is_as_reported():
    z, misses = [], []
    for seed in range(30):
        calibration, _ = session(seed)
        run, own = session(1000 + seed)
        made = compensated(run, Iron().fit(calibration, FIELD))
        miss = made["disturbance_nt"] - own
        misses.append(miss)
        z.append(miss / made["disturbance_sd_nt"])
    assert math.sqrt(np.mean(np.square(misses))) < 20  # of 255 nT
    assert 0.6 < math.sqrt(np.mean(np.square(z))) < 1.6  # 30 drives of 3 coefficients: sd 0.1, and few lags


def test_the_prediction_uses_no_truth():
    calibration, _ = session(0)
    run, _ = session(1)
    fitted = Iron().fit(calibration, FIELD)
    blind = run.select("odom_*", "imu_*", "battery_a", "b_measured_nt")
    assert_allclose(
        compensated(blind, fitted)["disturbance_nt"], compensated(run, fitted)["disturbance_nt"], rtol=0
    )


def test_the_ridge_also_removes_a_currents_field():
    calibration, _ = session(2, current=400.0)
    run, own = session(3, current=400.0)
    by_ridge = compensated(run, Ridge().fit(calibration, FIELD))["disturbance_nt"] - own
    by_iron = compensated(run, Iron().fit(calibration, FIELD))["disturbance_nt"] - own
    assert by_ridge.std() < 0.4 * by_iron.std()


def test_tolles_lawson_finds_permanent_and_induced_terms():
    rng = np.random.default_rng(0)
    calibration, _ = session(4, iron=(0.0, 0.0), drift=0.0)
    run, _ = session(5, iron=(0.0, 0.0), drift=0.0)

    def with_vector(source):
        tilt = 0.05 * rng.standard_normal((source.rows, 2))
        yaw = source["yaw"]
        u = np.column_stack(
            [0.5 * np.cos(yaw) + tilt[:, 0], -0.5 * np.sin(yaw) + tilt[:, 1], np.full(source.rows, -0.8)]
        )
        u /= np.linalg.norm(u, axis=1)[:, None]
        b = 45_000.0
        own = u @ (200.0, -100.0, 50.0) + b * (0.004 * u[:, 0] ** 2 + 0.003 * u[:, 0] * u[:, 1])
        return source.with_columns(
            b_vector_measured_nt=b * u, b_measured_nt=source["b_measured_nt"] + own
        ), own

    calibration, _ = with_vector(calibration)
    run, own = with_vector(run)
    made = compensated(run, TollesLawson().fit(calibration, FIELD))
    miss = made["disturbance_nt"] - own
    assert np.std(miss) < 0.1 * np.std(own)


def test_a_reading_without_its_signals_gets_the_mean_and_the_spread():
    calibration, _ = session(0)
    fitted = Iron().fit(calibration, FIELD)
    mean, sd = fitted.step(Reading(0.0, 41_000.0, (0.0, 0.0, 0.0)))
    made = np.array([fitted.step(reading) for reading in readings_of(calibration)])
    assert_allclose(mean, made[:, 0].mean(), atol=1e-6)
    assert sd > 200


def test_no_compensation_is_zero():
    run, _ = session(0)
    made = compensated(run, COMPENSATORS["none"]().fit(run, FIELD))
    assert not made["disturbance_nt"].any()
    assert not made["disturbance_sd_nt"].any()


def test_what_a_compensator_lacks_is_named():
    run, _ = session(0)
    with pytest.raises(InputError, match="no column 'b_vector_measured_nt'"):
        TollesLawson().fit(run, FIELD)
    with pytest.raises(InputError, match="no column 'p_world_base'"):
        Iron().fit(run.select("odom_*", "imu_*", "b_measured_nt"), FIELD)
    with pytest.raises(InputError, match="was not fitted"):
        Iron().step(Reading(0.0, 41_000.0, (0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match="5 readings with signals and map"):
        Iron().fit(run.take(slice(0, 5)), FIELD)
    assert sorted(COMPENSATORS) == ["iron", "none", "ridge", "tolles-lawson"]
