"""The plant: its physics against closed forms and naive loops, and its draws."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.field.sources.dipoles import dipole_field_nt
from magtwin.sim.plant import Plant, play
from magtwin.sim.plant_families import PLANTS, draw_plant, draw_session_plant, plant_of, plant_text
from magtwin.spec.plant import PlantSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.sensors import MocapSpec

RNG = np.random.default_rng(5)
FIELD = np.array([0.0, 24e3, -38e3])


def plant_of_spec(spec: PlantSpec) -> Plant:
    return Plant(spec)


def naive_play(u: np.ndarray, r: float, w: float = 0.0) -> np.ndarray:
    out = []
    for now in u:
        if now - w > r:
            w = now - r
        elif w - now > r:
            w = now + r
        out.append(w)
    return np.array(out)


@given(st.lists(st.floats(-1e5, 1e5), min_size=1, max_size=70), st.floats(0, 2e4), st.floats(-1e5, 1e5))
def test_play_agrees_with_a_naive_loop_to_the_bit(u: list[float], r: float, start: float) -> None:
    wanted = naive_play(np.array(u), r, start)
    assert_array_equal(play(np.array(u)[:, None], [r], np.array([[start]]))[:, 0, 0], wanted)


def test_hysteresis_weighs_the_operators_of_each_axis_and_survives_a_nan() -> None:
    matrix = RNG.normal(0, 0.01, (3, 3))
    spec = PlantSpec(
        hysteresis=tuple(matrix.ravel().tolist()),
        play_thresholds_nt=(1000.0, 5000.0),
        play_weights=(0.4, 0.6),
        start_field_nt=(0.0, 60e3, 0.0),
    )
    b = FIELD + RNG.normal(0, 8e3, (40, 3))
    b[17] = np.nan
    known = np.delete(b, 17, axis=0)
    played = [
        sum(
            w * naive_play(known[:, k], r, naive_play(np.array([h]), r)[-1])
            for w, r in ((0.4, 1000.0), (0.6, 5000.0))
        )
        for k, h in enumerate(spec.start_field_nt)
    ]
    field = plant_of_spec(spec).field_nt(np.arange(40.0), b)
    assert np.isnan(field[17]).all()
    assert_allclose(np.delete(field, 17, axis=0), np.transpose(played) @ matrix.T, rtol=1e-12)


def test_warm_up_rises_exponentially_along_its_axis_and_the_field() -> None:
    spec = PlantSpec(
        warm_up_s=(100.0, 400.0),
        warm_up_nt=(90.0, 0.0, 0.0, 0.0, -50.0, 20.0),
        warm_up_soft_iron=(0.002, -0.001),
        warm_up_age_s=30.0,
    )
    t = np.array([0.0, 100.0, 1e6])
    field = plant_of_spec(spec).field_nt(t, np.broadcast_to(FIELD, (3, 3)))
    fast, slow = 1 - np.exp(-(t + 30) / 100), 1 - np.exp(-(t + 30) / 400)
    wanted = fast[:, None] * (np.array([90.0, 0, 0]) + 0.002 * FIELD)
    wanted += slow[:, None] * (np.array([0, -50.0, 20.0]) - 0.001 * FIELD)
    assert_allclose(field, wanted, rtol=1e-12, atol=1e-9)


def test_nonlinear_currents_go_with_the_size_and_the_square_of_torques_and_with_the_lidar() -> None:
    spec = PlantSpec(
        motor_abs_nt_nm=(1000.0, 0.0, 0.0),
        motor_square_nt_nm2=(0.0, 1e4, 0.0),
        lidar_speed_nt_s_m=(0.0, 0.0, 500.0),
        lidar_supply_nt_a=(0.0, 0.0, 200.0),
    )
    field = plant_of_spec(spec).field_nt(
        np.zeros(2),
        np.broadcast_to(FIELD, (2, 3)),
        torques_nm=np.array([[0.04, -0.03], [0.0, 0.0]]),
        speed=np.array([-0.2, 0.3]),
        lidar_on=np.array([False, True]),
        supply_a=np.array([0.5, 0.25]),
    )
    assert_allclose(field, [[70.0, 25.0, 0.0], [0.0, 0.0, 200.0]], atol=1e-9)


def test_the_moving_part_is_a_dipole_that_pans_about_the_vertical() -> None:
    spec = PlantSpec(
        moving_moment=(0.02, 0.01, -0.005),
        p_magnetometer_moving=(0.05, -0.12, 0.1),
        moving_arm_m=0.03,
        pan_range=1.2,
        pan_period_s=40.0,
        pan_dwell=0.25,
        pan_phase=0.1,
    )
    plant, t = plant_of_spec(spec), np.linspace(0, 55, 30)
    field = plant.field_nt(t, np.broadcast_to(FIELD, (30, 3)))
    for angle, seen in zip(plant.pan(t), field, strict=True):
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        place = spec.p_magnetometer_moving + turn @ [0.03, 0, 0]
        wanted = dipole_field_nt(np.zeros(3), place[None], (turn @ spec.moving_moment)[None])
        assert_allclose(seen, wanted, rtol=1e-9)


@pytest.mark.parametrize("name", [name for name in PLANTS if name != "nominal"])
def test_pieces_give_the_bytes_of_the_whole(name: str) -> None:
    robot = RobotSpec(name="r", asset=".", plant=draw_plant(name, 3))
    spec = draw_session_plant(robot, np.random.default_rng(1)).plant
    n = 1000
    t, b = np.arange(n) / 135, FIELD + 5e3 * np.cumsum(RNG.normal(0, 0.1, (n, 3)), axis=0)
    more = {
        "torques_nm": RNG.normal(0, 0.05, (n, 2)),
        "speed": RNG.normal(0, 0.2, n),
        "lidar_on": RNG.random(n) < 0.4,
        "supply_a": RNG.normal(0, 0.2, n),
    }
    whole, plant = plant_of_spec(spec).field_nt(t, b, **more), plant_of_spec(spec)
    cuts = [0, 1, 1, 4, 9, 300, 301, 777, n]
    pieces = [
        plant.field_nt(t[i:j], b[i:j], **{key: value[i:j] for key, value in more.items()})
        for i, j in pairwise(cuts)
    ]
    assert_array_equal(np.concatenate(pieces), whole)
    assert name == "drawn" or np.ptp(whole) > 10


@pytest.mark.parametrize("name", PLANTS)
def test_a_family_draws_other_constants_for_another_seed_and_its_text_brings_them_back(name: str) -> None:
    first, again, other = draw_plant(name, 1), draw_plant(name, 1), draw_plant(name, 2)
    assert first == again == plant_of(f"{name}:1") == plant_of(plant_text(first))
    assert (first != other) == (name != "nominal")
    assert (draw_plant(name, 1, which=1) != first) == (name != "nominal")
    assert plant_of(name) == draw_plant(name, 0)


def test_sessions_of_a_plant_differ_a_little_and_spread_motion_capture_and_currents() -> None:
    robot = RobotSpec(name="r", asset=".", plant=draw_plant("all", 1), mocap=MocapSpec(latency_s=0.02))
    robot = replace(robot, platform=replace(robot.platform, lidar_nt=(100.0, 0.0, 0.0)))
    drawn = [draw_session_plant(robot, np.random.default_rng(k)) for k in range(400)]
    spec = robot.plant
    moment = np.linalg.norm([one.plant.moving_moment for one in drawn], axis=1)
    assert_allclose(moment.std() / np.linalg.norm(spec.moving_moment), spec.session_std, rtol=0.15)
    offset = np.array([one.mocap.offset_m for one in drawn])
    assert_allclose(offset.std(axis=0), spec.marker_offset_std_m, rtol=0.15)
    assert min(one.mocap.latency_s for one in drawn) >= 0
    lidar = np.array([one.platform.lidar_nt for one in drawn])
    assert_allclose(np.linalg.norm(lidar, axis=1), 100.0)  # turned, not scaled
    assert_allclose(lidar[:, 1].std() / 100, spec.current_direction_std, rtol=0.2)
    change = np.array([one.platform.hard_iron_change_nt for one in drawn])
    assert_allclose(change.std(axis=0), spec.hard_iron_std_nt, rtol=0.15)
    again = draw_session_plant(drawn[0], np.random.default_rng(9)).plant
    assert again == replace(drawn[0].plant, pan_phase=again.pan_phase)  # nothing is left to draw
