import runpy

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pxr import Usd, UsdGeom, UsdPhysics
from validators import assert_valid

from magtwin.author.robot import build_robot, read_settings
from magtwin.errors import InputError
from magtwin.files.file import shipped
from magtwin.frames import rotate
from magtwin.usd.geometry import read_links, read_shapes
from magtwin.usd.robot import load_robot, read_notes, read_robot

HOME = shipped("robots", "turtlebot4")
ASSET = HOME / "turtlebot4.usda"
FILES = ("turtlebot4.usda", "turtlebot4_meshes.usdc")


@pytest.fixture(scope="module")
def stage():
    return Usd.Stage.Open(str(ASSET))


@pytest.fixture(scope="module")
def links():
    return read_links(ASSET)


@pytest.fixture(scope="module")
def solid(links):
    """All visible vertices of each link, with the robot at the origin [m]."""
    parts = {}
    for shape in read_shapes(ASSET):
        link = links[shape.link]
        placed = rotate(link.q_world_link_xyzw, shape.vertices) + link.p_world_link
        parts.setdefault(shape.link, []).append(placed)
    return {name: np.vstack(vertices) for name, vertices in parts.items()}


def test_a_fresh_build_equals_the_committed_asset_byte_for_byte(tmp_path):
    built = tmp_path / "turtlebot4.usda"
    build_robot(HOME / "turtlebot4.urdf", HOME / "robot.toml", built)
    for name in FILES:
        assert built.with_name(name).read_bytes() == (HOME / name).read_bytes(), (
            f"{name} is out of date: python robots/turtlebot4/build.py"
        )


def test_the_meshes_and_the_urdf_are_what_the_script_draws(tmp_path):
    pytest.importorskip("mapbox_earcut")
    build = runpy.run_path(str(HOME / "build.py"))
    assert build["write"](tmp_path).read_text() == (HOME / "turtlebot4.urdf").read_text()
    drawn = {p.name: p.read_text() for p in (tmp_path / "meshes").iterdir()}
    assert drawn == {p.name: p.read_text() for p in (HOME / "meshes").iterdir()}


def test_the_asset_gives_the_settings_back(links):
    settings = read_settings(HOME / "robot.toml")
    robot = load_robot(ASSET)
    assert robot.asset == ASSET
    names = ("name", "footprint_radius_m", "drive", "battery", "platform", "magnetometer", "imu", "lidar")
    for name in names:
        assert getattr(robot, name) == getattr(settings, name)
    assert robot.base_height_m == pytest.approx(links["base_link"].p_world_link[2], abs=1e-12)
    assert robot.base_height_m == pytest.approx(0.03575 - 0.0402, abs=1e-12)  # the wheels touch the floor
    assert_allclose(robot.p_base_magnetometer, links["magnetometer_link"].p_base_link, atol=1e-12)


def test_the_magnetometer_sits_six_centimetres_above_the_sensor_plate(links):
    above = np.subtract(links["magnetometer_link"].p_base_link, links["tower_sensor_plate"].p_base_link)
    assert_allclose(above, [0, 0, 0.063], atol=1e-9)  # the plate is 3 mm thick


def test_a_robot_placed_in_a_scene_reads_the_same_wherever_it_stands(stage):
    scene = Usd.Stage.CreateInMemory()
    for name, yaw in (("first", 0.0), ("second", 123.0)):
        prim = UsdGeom.Xform.Define(scene, f"/World/{name}")
        prim.AddTranslateOp().Set((1.7, -0.3, 0))
        prim.AddRotateZOp().Set(yaw)
        prim.GetPrim().GetReferences().AddReference(str(ASSET))
    first, second = (read_robot(scene.GetPrimAtPath(f"/World/{n}")) for n in ("first", "second"))
    assert first.p_base_magnetometer == second.p_base_magnetometer == load_robot(ASSET).p_base_magnetometer
    assert first.asset == second.asset == ASSET
    assert (first.name, second.name) == ("first", "second")


@pytest.mark.parametrize(
    ("link", "place"),
    [
        ("left_wheel", (0, 0.1165, 0.0402)),
        ("right_wheel", (0, -0.1165, 0.0402)),
        ("imu_link", (0.0506, 0.0437, 0.0844)),
        ("shell_link", (0, 0, 0.0942)),
        ("rplidar_link", (-0.04, 0, 0.1929)),
        ("oakd_link", (-0.0596, 0, 0.2435)),
        ("tower_sensor_plate", (0, 0, 0.3468)),
        ("front_left_tower_standoff", (0.0306, 0.1143, 0.2418)),
        ("rear_right_tower_standoff", (-0.0761, -0.0907, 0.2418)),
    ],
)
def test_links_stand_where_the_makers_figures_put_them(links, link, place):
    assert_allclose(links[link].p_base_link, place, atol=1e-4)  # figures have four decimals


def test_wheels_and_caster_touch_the_floor_and_nothing_else_does(solid):
    for name, vertices in solid.items():
        if name in ("left_wheel", "right_wheel", "front_caster"):
            assert_allclose(vertices[:, 2].min(), 0, atol=1e-4, err_msg=name)  # polygons stand for circles
        else:
            assert vertices[:, 2].min() > 0.005, name


def test_the_robot_weighs_what_its_parts_do_and_stands_over_its_wheels_and_caster(stage, links):
    total, moment = 0.0, np.zeros(3)
    for prim in stage.Traverse():
        if prim.HasAPI(UsdPhysics.MassAPI):
            mass = UsdPhysics.MassAPI(prim)
            link = links[prim.GetName()]
            centre = rotate(link.q_base_link_xyzw, mass.GetCenterOfMassAttr().Get()) + link.p_base_link
            total += mass.GetMassAttr().Get()
            moment += mass.GetMassAttr().Get() * centre
    assert_allclose(total, 4.36, atol=0.005)  # the maker's manual says 3.945, without a magnetometer
    assert 0 < (moment / total)[0] < 0.125  # between the axle and the caster


def test_the_robot_passes_the_validators(tmp_path):
    assert_valid(ASSET, tmp_path)


def test_its_conversion_lost_nothing():
    assert [note for note in read_notes(ASSET) if "without an area" not in note] == []


REFUSED = {
    "name": (('name = "turtlebot4"', 'name = "turtle"'), "name is 'turtle', but the URDF's robot"),
    "link": (
        ('link = "imu_link"', 'link = "imu_lnik"'),
        r"\[imu\] link: the URDF has no link 'imu_lnik'; did you mean 'imu_link'",
    ),
    "joint": (('"left_wheel_joint"', '"left_joint"'), "no joint 'left_joint' for left_wheel_joint"),
    "key": (("v_max =", "v_mx ="), r"robot\.toml:\d+: \[drive\] unknown key 'v_mx'; did you mean 'v_max'"),
    "computed": (('name = "turtlebot4"', 'asset = "x.usda"'), r"robot\.toml:\d+: unknown key 'asset'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_settings_that_do_not_fit_the_urdf_are_refused_and_nothing_is_written(tmp_path, case):
    (old, new), message = REFUSED[case]
    text = (HOME / "robot.toml").read_text()
    assert old in text
    settings = tmp_path / "robot.toml"
    settings.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=message):
        build_robot(HOME / "turtlebot4.urdf", settings, tmp_path / "out" / "turtlebot4.usda")
    assert not list(tmp_path.glob("out/**/*.usd*"))
