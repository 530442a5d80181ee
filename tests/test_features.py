import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.learn.features import FEATURES, FULL, SETS, features
from magtwin.names import RefusedError
from magtwin.run import COLUMNS, Run


def a_run(rows=50, seed=0):
    """A run whose columns are random numbers, so that a swap of any two shows."""
    rng = np.random.default_rng(seed)
    columns = {}
    for name, spec in COLUMNS.items():
        values = rng.normal(size=(rows,) if spec.width == 1 else (rows, spec.width))
        columns[name] = values > 0 if spec.unit == "bool" else values
    return Run(columns)


def test_full_is_the_papers_20_inputs_in_its_order():
    run = a_run()
    by_hand = np.column_stack(
        [
            np.degrees(run["yaw"]) % 360,
            run["odom_v"],
            run["odom_w"],
            run["imu_q_xyzw"] * np.where(run["imu_q_xyzw"][:, 3:] < 0, -1, 1),
            run["imu_w"],
            run["imu_a"],
            run["battery_v"],
            run["battery_fraction"],
            run["lidar_on"],
        ]
    )
    assert by_hand.shape == (50, 20)
    assert_array_equal(features(run), by_hand)
    assert len(FULL) == len(set(FULL)) == 20


@pytest.mark.parametrize(
    ("yaw", "deg"), [(0.0, 0.0), (-np.pi / 2, 270.0), (np.pi, 180.0), (-1e-17, 0.0), (7.0, 41.0704566)]
)
def test_yaw_is_in_degrees_from_0_to_below_360(yaw, deg):
    run = a_run(1).with_columns(yaw=np.array([yaw]))
    assert_allclose(features(run, ["yaw_deg"]), [[deg]], atol=1e-6)


def test_q_and_minus_q_give_the_same_features_with_w_not_negative():
    run = a_run()
    turned = run.with_columns(imu_q_xyzw=-run["imu_q_xyzw"])
    assert_array_equal(features(run), features(turned))
    assert (features(run, ["imu_q_w"]) >= 0).all()


def test_lidar_is_0_or_1():
    assert set(np.unique(features(a_run(), ["lidar_on"]))) == {0.0, 1.0}


def test_features_come_in_the_order_they_are_named_in():
    run = a_run()
    x = features(run, ["battery_v", "yaw_deg", "odom_w_z"])
    assert_array_equal(x[:, 0], run["battery_v"])
    assert_array_equal(x[:, 2], run["odom_w"][:, 2])


def test_every_feature_of_a_set_is_known_and_comes_from_a_column_of_a_run():
    for names in SETS.values():
        assert set(names) <= set(FEATURES)
    assert {f.column for f in FEATURES.values()} <= set(COLUMNS)


@pytest.mark.parametrize(
    ("names", "text"),
    [
        ("ful", "no feature set 'ful'; did you mean 'full'?"),
        (["yaw_deg", "odom_vx"], "no feature 'odom_vx'; did you mean 'odom_v_x'?"),
        (["yaw_deg", "yaw_deg"], "feature 'yaw_deg' is named twice; name each input once"),
    ],
)
def test_an_unknown_name_is_refused_with_the_near_one(names, text):
    with pytest.raises(RefusedError) as refused:
        features(a_run(2), names)
    assert str(refused.value) == text


def test_a_run_without_a_column_is_refused():
    with pytest.raises(RefusedError, match="no column 'yaw'"):
        features(Run({"t": np.zeros(3)}))
