"""A mobile robot from its URDF, in one command: a room, a magnetometer on a link, a map, and a path."""

import math

import numpy as np
import pytest
from places import DATA
from pxr import Usd, UsdGeom

from magtwin import load_run
from magtwin.author.robot import RobotSettings, build_robot
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.io.bags.topics import JOINTS
from magtwin.io.bags.twin_sender import sender_for
from magtwin.spec.drive import DriveSpec
from magtwin.spec.sensors import MagnetometerSpec
from magtwin.twin import author_scene, open_twin, scene_with_robot, simulate
from magtwin.usd.robot import load_robot, read_notes
from magtwin.usd.scene import read_scene

CART = DATA / "robots" / "cart.urdf"


def test_one_command_puts_a_magnetometer_on_a_link_and_another_drives_the_robot(tmp_path):
    main(["scene", "--urdf", str(CART), "--magnetometer", "mast:0,0,0.42", "--out", str(tmp_path / "mine")])
    scene = read_scene(tmp_path / "mine" / "mine.usda")
    robot = scene.robot
    assert (robot.magnetometer.link, robot.magnetometer.p_link_sensor) == ("mast", (0, 0, 0.42))
    assert robot.drive.sides == {"left": 0, "right": 1}
    assert max(scene.lab.floor_m) >= 5 * robot.footprint_radius_m / 0.3 - 1e-3
    main(["run", str(tmp_path / "mine"), "--duration-s", "5", "--out", str(tmp_path / "run.parquet")])
    run = load_run(tmp_path / "run.parquet")
    assert np.isfinite(run["b_measured_nt"]).all()
    # This robot surveyed the map, so readings are those of the map, but for its spacing.
    assert np.median(np.abs(run["b_truth_nt"] - run["b_map_nt"])) < 300


@pytest.mark.parametrize(
    ("mount", "message"),
    [
        ("mast:0,0", r"magnetometer must be LINK or LINK:X,Y,Z, got 'mast:0,0'"),
        ("mast:0,0,-0.5", "35 m below the floor"),
        (None, r"no link 'magnetometer_link'.* --magnetometer LINK:X,Y,Z .*; links: chassis, mast"),
        ("must:0,0,1", r"\[magnetometer\] link: the URDF has no link 'must'; did you mean 'mast'"),
    ],
)
def test_a_wrong_mount_is_refused_in_one_line(mount, message):
    with pytest.raises(InputError, match=message):
        scene_with_robot(CART, mount)


def test_options_of_the_robot_without_a_robot_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        main(["scene", "lab", "--magnetometer", "mast", "--out", str(tmp_path / "x")])
    assert "--magnetometer goes with --urdf" in capsys.readouterr().err


def test_keys_of_the_drive_override_those_of_the_plugin_which_fill_in_the_rest(tmp_path):
    text = CART.read_text()
    plugin = (
        '<gazebo><plugin name="d" filename="libgazebo_ros_diff_drive.so"><left_joint>left</left_joint>'
        "<right_joint>right</right_joint><wheel_separation>0.5</wheel_separation><wheel_radius>0.09</wheel_radius>"
        "<odom_publish_frequency>33</odom_publish_frequency></plugin></gazebo></robot>"
    )
    urdf = tmp_path / "cart.urdf"
    urdf.write_text(text.replace("</robot>", plugin))
    settings = RobotSettings(
        drive=DriveSpec(wheel_radius_m=0.1, v_max=0.7), magnetometer=MagnetometerSpec(link="mast")
    )
    report = build_robot(urdf, settings, tmp_path / "cart.usda")
    drive = load_robot(tmp_path / "cart.usda").drive
    assert (drive.wheel_radius_m, drive.v_max) == (0.1, 0.7)
    assert (drive.wheel_separation_m, drive.odometry_rate_hz) == (0.5, 33)
    assert drive.sides == {"left": 0, "right": 1}
    filled = next(note for note in report.notes if note.startswith("[drive] filled in from the description"))
    assert "wheel_separation_m" in filled
    assert math.isclose(drive.w_max, 2 * 10 * 0.09 / 0.5)  # the wheels' joints turn at 10 rad/s


def test_wheels_whose_axes_point_right_roll_forward_in_playback_and_have_their_joints_sign(tmp_path):
    shape = (
        '<visual><origin rpy="1.57 0 0"/><geometry><cylinder radius="0.1" length="0.05"/></geometry></visual>'
    )
    text = f'<robot name="cart"><link name="base_link">{shape}</link><link name="mast"/>'
    text += '<joint name="m" type="fixed"><parent link="base_link"/><child link="mast"/></joint>'
    for name, x, y in (("fl-1", 0.2, 0.3), ("fr", 0.2, -0.3), ("rl", -0.2, 0.3), ("rr", -0.2, -0.3)):
        text += (
            f'<link name="wheel_{name}">{shape}</link><joint name="{name}" type="continuous"><parent '
            f'link="base_link"/><child link="wheel_{name}"/><origin xyz="{x} {y} 0"/>'
            f'<axis xyz="0 {1 if y > 0 else -1} 0"/></joint>'
        )
    (tmp_path / "cart.urdf").write_text(f"{text}</robot>")
    scene = scene_with_robot(tmp_path / "cart.urdf", "mast:0,0,0.42")
    assert any("axis of 'fr', 'rr' points right" in n for n in read_notes(scene.robot.asset))
    twin = open_twin(author_scene(scene, tmp_path / "mine"))
    run = simulate(twin, duration_s=2.0)
    run.save(tmp_path / "run.usda", twin=twin)
    stage, cache = Usd.Stage.Open(str(tmp_path / "run.usda")), UsdGeom.XformCache()
    for name in ("fl_1", "fr", "rl", "rr"):
        wheel = stage.GetPrimAtPath(f"/World/cart/wheel_{name}")
        turns = []
        for code in (30, 31):
            cache.SetTime(code)
            turns.append(cache.ComputeRelativeTransform(wheel, wheel.GetParent())[0].ExtractRotationQuat())
        assert (turns[1] * turns[0].GetInverse()).GetImaginary()[1] > 1e-3  # about the left: forward
    sender = sender_for(twin, "T")
    fields = JOINTS.write(run, np.zeros(run.rows, np.int64), sender)
    assert fields["name"] == ("fl-1", "fr", "rl", "rr")
    left, right = run["wheel_angle"].T
    np.testing.assert_array_equal(fields["position"], np.column_stack([left, -right, left, -right]))
    assert [wheel.name for wheel in sender.wheels] == ["wheel_fl-1", "wheel_fr", "wheel_rl", "wheel_rr"]
