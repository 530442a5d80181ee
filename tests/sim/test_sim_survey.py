import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rooms import EARTH, scene_of

from magtwin.errors import InputError
from magtwin.field.sources.dipoles import dipole_field_nt
from magtwin.field.sources.magnets import body_of
from magtwin.frames import quat_from_yaw, rotate
from magtwin.sim.at_rest import field_at_rest_nt
from magtwin.sim.interference import ambient_gradient_nt_m
from magtwin.sim.survey import pose_error_nt2, survey, survey_readings
from magtwin.spec.magnetics import PlatformFieldSpec, SourceSpec
from magtwin.spec.robot import RobotSpec
from magtwin.spec.sensors import MagnetometerSpec

SOURCE = SourceSpec(name="pipe", p_world=(0.4, -0.2, -0.5), m_world=(2.0, 5.0, -4.0))


def scene(**robot):
    sensor = MagnetometerSpec(noise_density_nt=0.0, resolution_nt=0.0)
    parts = {"p_base_magnetometer": (0.05, -0.02, 0.4), "magnetometer": sensor, **robot}
    return scene_of(RobotSpec(name="r", asset=Path("r.usda"), **parts), earth=EARTH, sources=(SOURCE,))


def rng():
    return np.random.default_rng(0)


def test_the_map_of_a_robot_without_magnetism_is_the_field_at_its_magnetometer():
    field = survey(scene(), rng=rng())
    assert field.values_nt.shape == (4, 15, 25)
    assert field.extent == (-3.0, 3.0, -1.75, 1.75)
    for layer, (dx, dy) in enumerate([(0.05, -0.02), (0.02, 0.05), (-0.05, 0.02), (-0.02, -0.05)]):
        x, y = np.meshgrid(field.x_m + dx, field.y_m + dy)
        p = np.stack([x, y, np.full_like(x, 0.4)], axis=-1)
        want = dipole_field_nt(p, [SOURCE.p_world], [SOURCE.m_world]) + EARTH.b_world_nt
        assert_allclose(field.values_nt[layer], np.linalg.norm(want, axis=-1), rtol=0, atol=1e-6)


def test_motors_lidar_battery_and_eddy_currents_are_not_in_the_map():
    moving = PlatformFieldSpec(
        eddy_s=(0.01,) * 9,
        left_motor_nt_nm=(50, 50, 50),
        right_motor_nt_nm=(50, 50, 50),
        lidar_nt=(500, 500, 500),
        battery_nt=(90, 90, 90),
    )
    assert_array_equal(
        survey(scene(platform=moving), rng=rng()).values_nt, survey(scene(), rng=rng()).values_nt
    )


def test_readings_have_the_sensors_noise_and_resolution_and_the_map_its_variance():
    noisy = scene(magnetometer=MagnetometerSpec(noise_density_nt=5.0 / np.sqrt(135 / 2), resolution_nt=0.5))
    exact = survey(scene(), rng=rng()).values_nt
    one = survey(noisy, rng=rng())
    assert_array_equal(one.values_nt, np.rint(one.values_nt / 0.5) * 0.5)
    for field, want in ((one, 25 + 0.25 / 12), (survey(noisy, rng=rng(), readings=9), (25 + 0.25 / 12) / 9)):
        assert_allclose(field.variance_nt2, want, rtol=1e-12)
        # the variance of 1,500 samples is known to sqrt(2 / 1500) = 3.7 %; 4 sigma
        assert np.mean((field.values_nt - exact) ** 2) == pytest.approx(want, rel=0.15)


# Readings, and the twin as it stands


def test_readings_stand_on_their_nodes_and_are_the_maps_values():
    read = survey_readings(scene(), rng=rng(), spacing_m=0.5)
    field = survey(scene(), rng=rng(), spacing_m=0.5)
    assert read.grid == field.grid
    p, yaw = read.grid.poses()
    assert_array_equal(read.p_xy, p.reshape(-1, 2))
    assert_array_equal(read.yaw, yaw.ravel())
    assert_array_equal(read.b_nt, field.values_nt.ravel())
    assert read.height_m == field.height_m == 0.4


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"spacing_m": 0.0}, "spacing_m must be above 0 m"),
        ({"spacing_m": np.nan}, "spacing_m must be above 0 m"),
        ({"readings": 0}, "readings must be at least 1, got 0"),
        ({"readings": 10**12}, "readings must be .* at most 100,000, got 1000000000000"),
        ({"spacing_m": 4.0}, r"spacing_m 4 leaves no cell on 6 x 3\.5 m"),
        ({"headings_rad": (0.0, 7.0)}, "headings_rad of Grid must ascend"),
        ({"heading_error_rad": -1.0}, "heading_error_rad must not be below 0, got -1"),
        ({"position_error_m": 1e9}, "position_error_m 1000000000.0 is above the spacing of 0.25 m"),
        ({"heading_error_rad": 2.0}, "heading_error_rad must not be above pi/2, got 2.0"),
        ({"position_error_m": np.nan}, "position_error_m must not be below 0, got nan"),
        ({"height_m": np.inf}, "height_m must be a height above the floor, 0 m or more, got inf"),
    ],
)
@pytest.mark.parametrize("make", [survey, survey_readings])
def test_a_survey_that_cannot_be_made_is_refused(make, options, words):
    with pytest.raises(InputError, match=words):
        make(scene(), rng=rng(), **options)


def test_a_desk_moved_in_the_stage_changes_the_next_survey_by_what_its_steel_says(tmp_path, lab_scene):
    from pxr import Gf, Usd

    from magtwin.frames import quat_conjugate, quat_from_yaw, rotate
    from magtwin.sim.interference import ambient_field_nt
    from magtwin.usd.scene import read_scene

    folder = Path(shutil.copytree(lab_scene.parent, tmp_path / "lab"))
    before = read_scene(folder / lab_scene.name)
    stage = Usd.Stage.Open(str(folder / lab_scene.name))  # plain usd-core from here
    stage.GetPrimAtPath("/World/Furniture/desk_0").GetAttribute("xformOp:translate").Set(
        Gf.Vec3d(0.3, -2.3, 0)
    )
    stage.Save()
    after = read_scene(folder / lab_scene.name)
    desk, moved = (next(piece for piece in s.furniture if piece.name == "desk_0") for s in (before, after))
    assert moved == replace(desk, p_world=(0.3, -2.3, 0.0))

    maps = [survey(s, rng=rng(), spacing_m=0.5) for s in (before, after)]
    p, yaw = maps[0].grid.poses()
    robot, turn = before.robot, quat_from_yaw(yaw)
    place = np.concatenate([p, np.full((*yaw.shape, 1), robot.base_height_m)], axis=-1)
    place += rotate(turn, np.broadcast_to(robot.p_base_magnetometer, place.shape))
    flat = place.reshape(-1, 3)
    steel = [sum(body_of(s).exact_field_nt(flat) for s in piece.sources()) for piece in (desk, moved)]
    world = ambient_field_nt(before, flat) - steel[0] + steel[1]
    body = rotate(quat_conjugate(turn.reshape(-1, 4)), world)
    platform = robot.platform
    want = np.linalg.norm(
        body + body @ np.reshape(platform.soft_iron, (3, 3)).T + platform.hard_iron_nt, axis=-1
    ).reshape(yaw.shape)
    noise = 6 * np.hypot(robot.magnetometer.noise_std_nt, robot.magnetometer.resolution_nt)
    assert np.abs(maps[1].values_nt - want).max() < noise + 0.2  # 1e-4 of 2,000 nT stands in for the steel
    assert np.abs(maps[1].values_nt - maps[0].values_nt).max() > 200


def test_a_sensor_that_loses_lock_latches_along_its_rows_and_those_nodes_are_masked():
    sensor = MagnetometerSpec(
        noise_density_nt=0.0, resolution_nt=0.0, gradient_max_nt_m=4e3, gradient_relock_nt_m=3e3
    )
    fine = survey(scene(), rng=rng())
    field = survey(scene(magnetometer=sensor), rng=rng())
    x, y = np.meshgrid(field.x_m, field.y_m)
    height = scene().robot.base_height_m + scene().robot.p_base_magnetometer[2]
    latched = np.abs(field.values_nt - fine.values_nt) > 1
    assert 0 < latched.mean() < 0.2
    assert_array_equal(~field.valid, latched)
    assert survey_readings(scene(magnetometer=sensor), rng=rng()).good.all()  # nobody tells a robot
    plateaus = np.unique(field.values_nt[latched])
    assert len(plateaus) < 0.7 * latched.sum()  # read over and over
    assert np.abs(plateaus - 35_650).max() < 5 * 50
    for layer, yaw in enumerate(field.headings_rad):
        turn = quat_from_yaw(yaw)
        lever = rotate(turn, np.array(scene().robot.p_base_magnetometer))[:2]
        p = np.stack([x + lever[0], y + lever[1], 0 * x + height], axis=-1)
        steep = ambient_gradient_nt_m(scene(), p)
        assert latched[layer][steep > 4e3].all()
        assert not latched[layer][steep < 3e3].any()


def test_the_variance_of_a_node_is_the_mean_square_of_what_errors_of_the_pose_do_there():
    errors = {"position_error_m": 0.03, "heading_error_rad": np.radians(8)}
    iron = PlatformFieldSpec(hard_iron_nt=(400.0, -250.0, 900.0))
    grid = survey(scene(), rng=rng(), spacing_m=0.8).grid
    got = pose_error_nt2(scene(platform=iron), grid, 0.4, **errors)
    p, yaw = grid.poses()
    draw, times = np.random.default_rng(1), 1000
    stands = p + errors["position_error_m"] * draw.standard_normal((times, *p.shape))
    looks = yaw + errors["heading_error_rad"] * draw.standard_normal((times, *yaw.shape))
    off = field_at_rest_nt(scene(platform=iron), stands, looks) - field_at_rest_nt(
        scene(platform=iron), p, yaw
    )
    ratio = np.mean(off**2, axis=0) / got
    assert ratio.mean() == pytest.approx(1, abs=0.03)
    assert np.abs(ratio - 1).max() < 5 * np.sqrt(2 / times)  # as known as a mean of squares of normals
