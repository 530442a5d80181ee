"""A user's own robot: from its URDF into the lab, with a magnetometer on its mast."""

import json

import pytest
from places import DATA
from pxr import Usd, UsdGeom, UsdPhysics

from magtwin.author.from_urdf import RobotSettings, from_urdf
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files.file import shipped
from magtwin.spec.drive import DriveSpec
from magtwin.spec.sensors import MagnetometerSpec

CART = DATA / "robots" / "cart.urdf"

SCENE = f"""
name = "mine"
map = "{shipped("maps", "lab", "lab.usdc")}"

[robot]
urdf = "{CART}"
network = "{shipped("weights", "turtlebot4_hybrid.safetensors")}"
footprint_radius_m = 0.3

[robot.drive]
left_wheel_joint = "left"
right_wheel_joint = "right"
wheel_separation_m = 0.34
wheel_radius_m = 0.08

[robot.magnetometer]
link = "mast"
p_link_sensor = [0.0, 0.0, 0.42]
"""


def scene(tmp_path, text=SCENE):
    file = tmp_path / "mine.toml"
    file.write_text(text)
    return file


def test_a_scene_that_names_a_urdf_is_driven_in_two_commands(tmp_path, capsys):
    main(["scene", str(scene(tmp_path)), "--out", str(tmp_path / "mine")])
    main(
        [
            *("run", str(tmp_path / "mine" / "mine.usda"), "--duration-s", "3", "--json"),
            *("--out", str(tmp_path / "run.parquet"), "--out", str(tmp_path / "run.rrd")),
        ]
    )
    out = capsys.readouterr().out
    metadata = json.loads(out[out.rindex('{\n  "title"') :])["metadata"]
    assert metadata["scene"] == "mine"
    from magtwin.usd.scene import read_scene

    robot = read_scene(tmp_path / "mine" / "mine.usda").robot
    assert robot.name == "cart"
    assert robot.magnetometer.link == "mast"
    assert robot.p_base_magnetometer == pytest.approx((-0.15, 0.0, 0.57))
    assert robot.drive.wheel_separation_m == 0.34
    assert robot.imu.link == "chassis"  # the URDF tells of none: on the base, and noted


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('link = "mast"', 'link = "mst"', r"mine.toml: .*no link 'mst'; did you mean 'mast'"),
        ('joint = "left"', 'joint = "lft"', r"no joint 'lft' for left_wheel_joint; did you mean 'left'"),
        ("cart.urdf", "cat.urdf", r"cat.urdf: no such .*did you mean 'cart.urdf'"),
        ("urdf =", "udrf =", r"mine.toml:6: \[robot\] unknown key 'udrf'; did you mean 'urdf'"),
        ("urdf =", 'asset = "a.usda"\nurdf =', "needs asset .* or urdf .* and not both"),
        ('[robot.magnetometer]\nlink = "mast"', "[robot.magnetometer]", "no link 'magnetometer_link'"),
    ],
)
def test_a_scene_that_does_not_fit_its_urdf_is_refused_and_nothing_is_written(
    tmp_path, capsys, old, new, message
):
    assert old in SCENE
    file = scene(tmp_path, SCENE.replace(old, new))
    with pytest.raises(InputError, match=message):
        main(["scene", str(file), "--out", str(tmp_path / "mine"), "--debug"])
    assert [p.name for p in tmp_path.iterdir()] == ["mine.toml"]


def test_settings_name_links_and_joints_as_the_urdf_does_though_usd_calls_them_otherwise(tmp_path):
    text = CART.read_text().replace('"mast"', '"mast-top"').replace('"left"', '"left.wheel"')
    (tmp_path / "cart.urdf").write_text(text.replace('"right"', '"右"'))
    settings = RobotSettings(
        drive=DriveSpec(left_wheel_joint="left.wheel", right_wheel_joint="右"),
        magnetometer=MagnetometerSpec(link="mast-top"),
    )
    made = from_urdf(tmp_path / "cart.urdf", tmp_path / "cart", settings=settings)
    assert made.spec is not None
    assert made.spec.drive.left_wheel_joint == "left_wheel"
    assert made.spec.drive.right_wheel_joint == "右"
    assert made.spec.magnetometer.link == "mast_top"


def test_options_of_the_command_reach_the_conversion(tmp_path, capsys):
    report = tmp_path / "report.json"
    main(
        [
            *("robot", str(CART), "--out", str(tmp_path / "cart"), "--fix-base", "--report", str(report)),
            "--thumbnail",
            *("--drive", "left:position:stiffness=7:damping=2:max_force=4"),
        ]
    )
    stage = Usd.Stage.Open(str(tmp_path / "cart" / "cart.usda"))
    joints = {p.GetName(): p for p in stage.Traverse() if p.IsA(UsdPhysics.Joint)}
    drive = UsdPhysics.DriveAPI(joints["left"], "angular")
    assert drive.GetMaxForceAttr().Get() == pytest.approx(4)
    assert drive.GetStiffnessAttr().Get() == pytest.approx(7 * 3.141592653589793 / 180)
    above = [stage.GetPrimAtPath(UsdPhysics.Joint(j).GetBody0Rel().GetTargets()[0]) for j in joints.values()]
    assert sum(not prim.HasAPI(UsdPhysics.RigidBodyAPI) for prim in above) == 1  # the one that bolts the base
    assert len(list((tmp_path / "cart").rglob("*.png"))) == 1
    told = json.loads(report.read_text())
    assert told["mass_out_kg"] == pytest.approx(6.0)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--drive", "left"], "TYPE"),
        (["--drive", "left:fast"], "velocity, position, none"),
        (["--drive", "left:velocity:dampening=3"], "PATTERN:TYPE"),
        (["--drive", "left:velocity:damping=much"], "PATTERN:TYPE"),
        (["--package", "mine"], "--package takes NAME=VALUE, each once, got 'mine'"),
        (["--report", "report.txt"], "a report ends in .json"),
    ],
)
def test_options_that_make_no_sense_are_refused(tmp_path, arguments, message):
    with pytest.raises(InputError, match=message):
        main(["robot", str(CART), "--out", str(tmp_path / "cart"), *arguments, "--debug"])
    assert not list(tmp_path.iterdir())


def test_wheels_are_found_by_what_turns_without_end_and_mirrors(tmp_path):
    made = from_urdf(
        CART, tmp_path / "cart", settings=RobotSettings(magnetometer=MagnetometerSpec(link="mast"))
    )
    drive = made.spec.drive
    assert (drive.left_wheel_joint, drive.right_wheel_joint) == ("left", "right")
    assert (drive.wheel_separation_m, drive.wheel_radius_m) == pytest.approx((0.34, 0.08), abs=1e-4)
    assert made.spec.base_height_m == 0.0, "it stands on the floor already"
    assert any("'left' is the left one" in note for note in made.report.notes)


@pytest.mark.parametrize("lower", [0.0, 0.08, -0.05])
def test_a_robot_stands_on_its_wheels_wherever_its_root_is(tmp_path, lower):
    file = tmp_path / "cart.urdf"
    text = CART.read_text()
    for joint in ("0 0.17 0.08", "0 -0.17 0.08"):
        x, y, z = joint.split()
        text = text.replace(f'xyz="{joint}"', f'xyz="{x} {y} {float(z) - lower:g}"')
    file.write_text(text)
    settings = RobotSettings(magnetometer=MagnetometerSpec(link="mast"))
    made = from_urdf(file, tmp_path / "cart", settings=settings)
    stage = Usd.Stage.Open(str(made.asset))
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default", "render"])
    low = [
        cache.ComputeWorldBound(stage.GetPrimAtPath(f"/cart/{wheel}")).ComputeAlignedRange().GetMin()[2]
        for wheel in ("wheel_l", "wheel_r")
    ]
    assert low == pytest.approx([0.0, 0.0], abs=1e-4)
    chassis = stage.GetPrimAtPath("/cart/chassis")
    up = UsdGeom.XformCache().GetLocalToWorldTransform(chassis).ExtractTranslation()[2]
    assert up == pytest.approx(lower, abs=1e-4)


def test_without_a_pair_of_wheels_the_joints_must_be_named(tmp_path):
    file = tmp_path / "cart.urdf"
    file.write_text(CART.read_text().replace('xyz="0 -0.17 0.08"', 'xyz="0.1 -0.17 0.08"'))
    with pytest.raises(InputError, match=r"no joint 'left_wheel_joint' for left_wheel_joint"):
        from_urdf(file, tmp_path / "cart", settings=RobotSettings(magnetometer=MagnetometerSpec(link="mast")))
