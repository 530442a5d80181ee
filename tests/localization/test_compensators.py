import math

import numpy as np
import pytest
import synthetic
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.frames import quat_from_yaw
from magtwin.localization.compensators import with_iron
from magtwin.run.run import Run

FIELD = synthetic.wavy_map(0)


def session(seed, *, count=400, zero=0.7, iron=(300.0, -200.0), drift=30.0):
    """A drive with true poses, an IMU whose heading is off by `zero`, and iron."""
    rng = np.random.default_rng(seed)
    truth = synthetic.wander(rng, FIELD.extent, count, 0.2, 0.35)
    walk = np.zeros(count)
    for k in range(1, count):
        walk[k] = 0.96 * walk[k - 1] + drift * math.sqrt(1 - 0.96**2) * rng.standard_normal()
    own = iron[0] * np.cos(truth[:, 2]) + iron[1] * np.sin(truth[:, 2])
    b = FIELD.mean(truth[:, :2], truth[:, 2]) + own + walk + 10 * rng.standard_normal(count)
    columns = {
        "t": np.arange(count) * 0.2,
        "p_world_base": np.column_stack([truth[:, :2], np.zeros(count)]),
        "yaw": truth[:, 2],
        "odom_p": np.zeros((count, 3)),
        "odom_q_xyzw": quat_from_yaw(truth[:, 2] - truth[0, 2]),
        "imu_q_xyzw": quat_from_yaw(truth[:, 2] + zero),
        "b_measured_nt": b,
    }
    return Run(columns), own


def test_iron_is_found_and_its_error_is_as_reported():
    z, misses = [], []
    for seed in range(12):
        calibration, _ = session(seed)
        run, own = session(1000 + seed)
        made = with_iron(run, calibration, FIELD)
        miss = made["disturbance_nt"] - own
        misses.append(miss)
        z.append(miss / made["disturbance_sd_nt"])
    assert math.sqrt(np.mean(np.square(misses))) < 20  # of 255 nT
    assert 0.6 < math.sqrt(np.mean(np.square(z))) < 1.6  # 12 drives of 3 coefficients: sd 0.16


def test_the_prediction_uses_no_truth_and_no_heading_gets_the_mean_and_the_spread():
    (calibration, _), (run, _) = session(0), session(1)
    blind, whole = run.select("odom_*", "imu_*", "b_measured_nt"), with_iron(run, calibration, FIELD)
    assert_allclose(with_iron(blind, calibration, FIELD)["disturbance_nt"], whole["disturbance_nt"], rtol=0)
    q = run["imu_q_xyzw"].copy()
    q[5] = np.nan
    made = with_iron(run.with_columns(imu_q_xyzw=q), calibration, FIELD)
    mean = with_iron(calibration, calibration, FIELD)["disturbance_nt"].mean()
    assert_allclose(made["disturbance_nt"][5], mean, atol=1e-6)
    assert made["disturbance_sd_nt"][5] > 200


def test_what_a_compensator_lacks_is_named():
    run, _ = session(0)
    bare = run.select("odom_*", "imu_*", "b_measured_nt")
    for drive, of, said in (
        (bare, run, "p_world_base"),
        (run, run.select("odom_*", "b_measured_nt"), "imu_q_xyzw"),
        (run.take(slice(0, 5)), run, "5 readings"),
    ):
        with pytest.raises(InputError, match=said):
            with_iron(of, drive, FIELD)
