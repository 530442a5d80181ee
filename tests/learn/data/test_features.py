import numpy as np
import pytest
from learn_drives import random_run as a_run
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.learn.compensation.tolles_lawson import design_matrix
from magtwin.learn.data.features import EDDY, FEATURES, FULL, INDUCED, SETS, features, warming
from magtwin.run.run import COLUMNS, Run


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


def test_every_feature_of_a_set_is_known_and_comes_from_a_column_of_a_run():
    for names in SETS.values():
        assert set(names) <= set(FEATURES)
    assert {column for f in FEATURES.values() for column in f.columns} <= set(COLUMNS)


def test_what_is_fixed_to_the_robot_turns_with_it():
    run = a_run()
    v = run["v_cmd"] - run["odom_v"][:, 0]
    w = run["w_cmd"] - run["odom_w"][:, 2]
    names = [
        "lag_v",
        "lag_w",
        "turning",
        "lidar_on_yaw_sin",
        "battery_a_yaw_cos",
        "turning_yaw_cos",
        "lag_w_yaw_sin",
    ]
    sin, cos, turning = np.sin(run["yaw"]), np.cos(run["yaw"]), np.abs(run["odom_w"][:, 2])
    wanted = [v, w, turning, run["lidar_on"] * sin, run["battery_a"] * cos, turning * cos, w * sin]
    assert_allclose(features(run, names), np.column_stack(wanted))


@pytest.mark.parametrize(
    ("names", "text"),
    [
        ("ful", "no feature set 'ful'; did you mean 'full'?"),
        (["yaw_deg", "odom_vx"], "no feature 'odom_vx'; did you mean 'odom_v_x'?"),
        (["yaw_deg", "yaw_deg"], "feature 'yaw_deg' is named twice; name each input once"),
    ],
)
def test_an_unknown_name_is_refused_with_the_near_one(names, text):
    with pytest.raises(InputError) as refused:
        features(a_run(2), names)
    assert str(refused.value) == text


def test_a_run_without_a_column_is_refused():
    with pytest.raises(InputError, match="no column 'yaw'"):
        features(Run({"t": np.zeros(3)}))


def test_the_heading_comes_as_sin_and_cos_of_itself_and_of_twice_itself():
    run = a_run()
    yaw = run["yaw"]
    x = features(run, ["yaw_sin", "yaw_cos", "yaw_sin_2", "yaw_cos_2"])
    assert_allclose(x, np.column_stack([np.sin(yaw), np.cos(yaw), np.sin(2 * yaw), np.cos(2 * yaw)]))
    turned = features(run.with_columns(yaw=yaw + 2 * np.pi), "circular")
    assert_allclose(turned, features(run, "circular"), atol=1e-12)


def test_nothing_in_circular_tells_one_session_from_another():
    """Charge, voltage and an IMU zero that were drawn anew leave it as it was."""
    run = a_run()
    other = run.with_columns(
        battery_v=run["battery_v"] - 3,
        battery_fraction=run["battery_fraction"] / 2,
        imu_q_xyzw=-run["mocap_q_xyzw"],
    )
    for name in ("circular", "gradient", "vector"):
        assert_array_equal(features(other, name), features(run, name))


def test_induced_and_eddy_products_are_those_of_tolles_and_lawson_in_a_field_that_stands_still():
    rate, t = 400.0, np.arange(400) / 400.0
    yaw = 0.8 * np.sin(3 * t)
    b = np.column_stack([20e3 * np.cos(yaw), -20e3 * np.sin(yaw), np.full(len(t), -40e3)])
    w = np.column_stack([np.zeros((len(t), 2)), 2.4 * np.cos(3 * t)])
    run = Run({"t": t, "b_vector_measured_nt": b, "imu_w": w})
    matrix, names = design_matrix(b, rate, ("induced6", "eddy9"))
    matrix = matrix / np.linalg.norm(b, axis=1)[:, None]
    ours = {name: f"induced {name[8:]}" for name in INDUCED}
    ours |= {name: f"eddy {name[5]}d{name[7]}" for name in EDDY}
    for name, theirs in ours.items():
        x = features(run, [name])[5:-5, 0]
        assert_allclose(x, matrix[5:-5, names.index(theirs)], atol=2e-4)


def test_what_warms_up_has_63_percent_of_its_field_after_one_time_constant():
    x = warming(np.array([0.0, 100.0, 400.0]), np.array([0.3, np.pi, np.pi / 2]))
    assert_allclose(x[0], 0.0, atol=1e-15)
    assert_allclose(x[1, :3], (1 - np.exp(-1)) * np.array([1, -1, 0]), atol=1e-15)
    assert_allclose(x[2, 3:], (1 - np.exp(-1)) * np.array([1, 0, 1]), atol=1e-15)
