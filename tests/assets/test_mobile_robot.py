"""A mobile robot from its URDF, in one command: a room, a magnetometer on a link, a map, and a path."""

import math

import numpy as np
import pytest
from places import DATA

from magtwin import load_run
from magtwin.author.robot import RobotSettings, build_robot
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.spec.drive import DriveSpec
from magtwin.spec.sensors import MagnetometerSpec
from magtwin.twin import scene_with_robot
from magtwin.usd.robot import load_robot
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
