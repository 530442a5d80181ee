"""Mobile bases: what a plugin, a controller or the joints tell becomes the drive of the simulator."""

import numpy as np
import pytest
from made import converted
from numpy.testing import assert_allclose
from pxr import UsdPhysics

from magtwin.errors import InputError
from magtwin.urdf.convert import convert_with_report
from magtwin.urdf.options import Options
from magtwin.usd.sensors import read_drive

R, TRACK, BASE = 0.1, 0.5, 0.6
"""Radius of the wheels, distance between left and right, and between front and rear [m]."""

MASS = '<inertial><mass value="{}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
WHEEL = f'<collision><geometry><cylinder radius="{R}" length="0.05"/></geometry></collision>{MASS.format(1)}'
ALL = {"fl": (1, 1), "fr": (1, -1), "rl": (-1, 1), "rr": (-1, -1)}


def rover(
    tmp_path,
    tags="",
    *,
    wheels=ALL,
    steered=(),
    joint="continuous",
    limit="",
    axis="0 0 1",
    name="rover",
    **options,
):
    """A robot with wheels fl, fr, rl and rr; those in `steered` turn about hinges fl_steer, ..."""
    parts = [f'<link name="base">{MASS.format(20)}</link>']
    for wheel, (x, y) in wheels.items():
        place, above = f"{x * BASE / 2} {y * TRACK / 2} 0", "base"
        if wheel in steered:
            above = f"{wheel}_hub"
            parts.append(
                f'<link name="{above}">{MASS.format(1)}</link><joint name="{wheel}_steer" type="revolute">'
                f'<parent link="base"/><child link="{above}"/><origin xyz="{place}"/><axis xyz="0 0 1"/>'
                '<limit lower="-0.5" upper="0.5" effort="5" velocity="2"/></joint>'
            )
            place = "0 0 0"
        parts.append(
            f'<link name="{wheel}_tyre">{WHEEL}</link><joint name="{wheel}" type="{joint}"><parent '
            f'link="{above}"/><child link="{wheel}_tyre"/><origin xyz="{place}" rpy="-1.5707963 0 0"/>'
            f'<axis xyz="{axis}"/>{limit}</joint>'
        )
    path = tmp_path / f"{name}.urdf"
    path.write_text(f'<robot name="rover">{"".join(parts)}{tags}</robot>')
    stage, robot, report = converted(path, **{"profile": "diff-drive"} | options)
    return stage, read_drive(robot) if robot.HasAPI("MagtwinDifferentialDriveAPI") else None, report


def plugin(file, text):
    return f'<gazebo><plugin name="base" filename="{file}">{text}</plugin></gazebo>'


CORNERS = "".join(
    f"<{end}_{side}_joint>{wheel}</{end}_{side}_joint>"
    for wheel, (end, side) in zip(
        ALL, [("front", "left"), ("front", "right"), ("back", "left"), ("back", "right")], strict=True
    )
)
OLD_CORNERS = (
    "<leftFrontJoint>fl</leftFrontJoint><rightFrontJoint>fr</rightFrontJoint>"
    "<leftRearJoint>rl</leftRearJoint><rightRearJoint>rr</rightRearJoint>"
)
SIDES = {"fl": 0, "fr": 1, "rl": 0, "rr": 1}


def test_wheels_that_roll_along_y_are_no_drive_since_left_and_right_would_be_front_and_rear(tmp_path):
    text = plugin("libgazebo_ros_skid_steer_drive.so", OLD_CORNERS)
    with pytest.raises(InputError, match=r"the wheels roll along y of 'base', but x is ahead"):
        rover(tmp_path, text, axis="1 0 0")
    _stage, drive, report = rover(tmp_path, text, axis="1 0 0", profile="general")
    assert drive is None
    assert [(row.kind, row.count) for row in report.repairs] == [("drive-incomplete", 1)]


def test_a_skid_steer_plugin_drives_all_wheels_of_each_side(tmp_path):
    text = OLD_CORNERS + "<wheelSeparation>0.8</wheelSeparation><wheelDiameter>0.22</wheelDiameter>"
    stage, drive, report = rover(tmp_path, plugin("libgazebo_ros_skid_steer_drive.so", text))
    assert drive.sides == SIDES
    assert_allclose([drive.wheel_separation_m, drive.wheel_radius_m], [0.8, 0.11])
    assert any("(skid-steer): simulated as a differential drive" in note for note in report.notes)
    driven = [p for p in stage.Traverse() if p.HasAPI(UsdPhysics.DriveAPI, "angular")]
    gains = [UsdPhysics.DriveAPI(p, "angular").GetDampingAttr().Get() for p in driven]
    assert len(gains) == 4
    assert min(gains) > 0


def test_mecanum_wheels_roll_as_the_mecanum_equation_tells_for_no_sideways_motion(tmp_path):
    """w_i = (v -+ (lx + ly) w) / r of the left and the right wheels; lx, ly are half of both distances."""
    text = (
        f"{CORNERS}<wheel_separation>{TRACK}</wheel_separation><wheelbase>{BASE}</wheelbase>"
        f"<wheel_radius>{R}</wheel_radius>"
    )
    _, drive, report = rover(tmp_path, plugin("gz-sim-mecanum-drive-system", text))
    v, w, reach = 0.3, 0.7, (TRACK + BASE) / 2
    expected = np.array([v - reach * w, v + reach * w]) / R
    from magtwin.sim.motion.drive import wheel_rates

    assert_allclose(wheel_rates(v, w, drive), expected)
    assert drive.sides == SIDES
    assert any("it does not move sideways" in note for note in report.notes)


MECANUM = """\
base_controller:
  ros__parameters:
    type: mecanum_drive_controller/MecanumDriveController
    front_left_wheel_name: fl
    front_right_wheel_name: fr
    rear_left_wheel_name: rl
    rear_right_wheel_name: rr
    wheel_separation_x: 0.62
    wheel_separation_y: 0.52
    wheel_separation_y_multiplier: 1.5
    wheel_radius: 0.11
    linear: {x: {has_velocity_limits: true, max_velocity: 1.3}}
"""
CLEARPATH = """\
base_controller:
  ros__parameters:
    front_left_wheel_command_joint_name: fl
    front_right_wheel_command_joint_name: fr
    rear_left_wheel_command_joint_name: rl
    rear_right_wheel_command_joint_name: rr
    kinematics.wheels_radius: 0.11
    kinematics.sum_of_robot_center_projection_on_X_Y_axis: 0.7
    linear.x.max_velocity: 1.3
"""


@pytest.mark.parametrize(
    ("text", "separation", "radius"),
    [(MECANUM, 0.62 + 1.5 * 0.52, 0.11), (CLEARPATH, 1.4, 0.11)],
)
def test_settings_of_mecanum_controllers_old_and_new(tmp_path, text, separation, radius):
    settings = tmp_path / "control.yaml"
    settings.write_text(text)
    _, drive, _ = rover(tmp_path, controllers=settings)
    assert_allclose([drive.wheel_separation_m, drive.wheel_radius_m, drive.v_max], [separation, radius, 1.3])
    assert drive.sides == SIDES


def test_a_multiplier_also_holds_for_the_measured_separation_of_a_skid_steered_robot(tmp_path):
    settings = tmp_path / "control.yaml"
    settings.write_text(
        "husky_velocity_controller:\n  left_wheel: [fl, rl]\n  right_wheel: [fr, rr]\n"
        "  wheel_separation_multiplier: 1.875\n  wheel_radius_multiplier: 0.9\n  wheel_radius: 0.1\n"
    )
    _, drive, report = rover(tmp_path, controllers=settings)
    assert_allclose([drive.wheel_separation_m, drive.wheel_radius_m], [1.875 * TRACK, 0.09], rtol=1e-6)
    assert any("times the multiplier 1.875" in note for note in report.notes)


def test_settings_without_a_mobile_base_are_refused(tmp_path):
    settings = tmp_path / "arm.yaml"
    settings.write_text("arm_controller: {joints: [a, b]}\n")
    with pytest.raises(InputError, match=r"arm.yaml: has no controller of a mobile base"):
        rover(tmp_path, controllers=settings)


@pytest.mark.parametrize("source", ["joints", "plugin", "controller"])
def test_a_car_turns_about_its_fixed_axle_as_tightly_as_its_inner_wheel_steers(tmp_path, source):
    """tan(inner angle) = L / (R - d / 2), by Ackermann's condition."""
    tags, options = "", {}
    if source == "plugin":
        tags = plugin(
            "gz-sim-ackermann-steering-system",
            "<left_joint>rl</left_joint><right_joint>rr</right_joint><left_steering_joint>fl_steer"
            "</left_steering_joint><right_steering_joint>fr_steer</right_steering_joint>",
        )
    if source == "controller":
        options["controllers"] = tmp_path / "car.yaml"
        options["controllers"].write_text(
            "car:\n  traction_joints_names: [rl, rr]\n  steering_joints_names: [fl_steer, fr_steer]\n"
        )
    _, drive, report = rover(tmp_path, tags, steered=("fl", "fr"), **options)
    assert drive.sides == {"rl": 0, "rr": 1}
    assert_allclose(np.tan(0.5), BASE / (drive.turning_radius_m - TRACK / 2), rtol=1e-6)
    assert_allclose(drive.wheel_separation_m, TRACK, rtol=1e-6)
    assert any("simulated as a car" in note for note in report.notes)


def test_wheels_are_found_by_their_joints_and_casters_and_arms_are_none(tmp_path):
    caster = {**{w: ALL[w] for w in ("fl", "fr")}, "caster_l": (-1, 1), "caster_r": (-1, -1)}
    _, drive, report = rover(tmp_path, wheels=caster)
    assert drive.sides == {"fl": 0, "fr": 1}
    assert any(note.startswith("drive from the joints: simulated") for note in report.notes)


def test_a_plugin_that_moves_the_base_without_wheels_takes_those_of_the_joints(tmp_path):
    tags = plugin("libgazebo_ros_planar_move.so", "<odometryRate>25</odometryRate>")
    _, drive, report = rover(tmp_path, tags)
    assert drive.sides == SIDES
    assert drive.odometry_rate_hz == 25
    assert any(
        "(holonomic): simulated as a differential drive; it does not move sideways" in n for n in report.notes
    )


def test_a_plugin_that_moves_a_base_of_unknown_wheels_is_kept_and_strict_refuses_it(tmp_path):
    path = tmp_path / "puck.urdf"
    tags = plugin("libgazebo_ros_planar_move.so", "<odometryRate>25</odometryRate>")
    path.write_text(f'<robot name="puck"><link name="base">{MASS.format(2)}</link>{tags}</robot>')
    report = convert_with_report(path, tmp_path / "puck.usda", options=Options(single_file=True))
    assert any("no wheels are known: kept as text" in loss for loss in report.losses)
    assert report.unknown_tags == {"gazebo/plugin": 1}
    with pytest.raises(InputError, match="no wheels are known"):
        convert_with_report(path, tmp_path / "other.usda", options=Options(strict=True, single_file=True))


def test_a_plugin_with_wheels_on_one_side_only_is_refused_with_its_line(tmp_path):
    text = "<left_joint>fl</left_joint><right_joint>rl</right_joint>"
    with pytest.raises(InputError, match=r"rover.urdf:1: a drive needs wheels on the left .*found fl, rl"):
        rover(tmp_path, plugin("libgazebo_ros_diff_drive.so", text))
