"""Default drives of joints that bear a load: gains, motors, and what holds a position."""

import numpy as np
import pytest
from made import converted, drive_of, prim, urdf
from numpy.testing import assert_allclose
from pxr import UsdPhysics

from magtwin.urdf.options import DriveRule

SQUARE = (2 * np.pi * 10) ** 2
"""Stiffness over inertia at 10 Hz [1/s2]."""

GRAM = """<inertial><mass value="0.001"/>
<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial>"""


def finger(tmp_path, effort, inertia, kind="revolute"):
    """A joint j about y with the effort and the inertia that are given [N m, kg m2]."""
    limit = f'<limit lower="-1" upper="1" effort="{effort}" velocity="1"/>'
    return urdf(
        tmp_path,
        f"""<link name="a">{{INERTIAL}}</link><link name="b">{GRAM.format(i=inertia)}</link>
        <joint name="j" type="{kind}"><parent link="a"/><child link="b"/>
        <axis xyz="0 1 0"/>{limit}</joint>""",
        "finger",
    )


@pytest.mark.parametrize(("effort", "gain"), [(0.2, 2), (30, 300), (500, 1000), (1e9, 1000)])
def test_a_joint_yields_by_a_tenth_of_a_radian_at_its_effort_and_its_motor_makes_it_10_hz(
    tmp_path, effort, gain
):
    """The fingers of Pepper, with 1e-9 kg m2 and 0.1 N m, were thrown at 290 m/s by 100 N m/rad."""
    _stage, robot, _ = converted(finger(tmp_path, effort, 1e-9))
    _drive, stiffness, damping = drive_of(robot, "j")
    assert_allclose([stiffness, damping], [gain, gain / 10], rtol=1e-6)
    for name in ("newton", "physxJoint", "mjc"):
        rotor = prim(robot, "j").GetAttribute(f"{name}:armature").Get()
        assert_allclose(rotor + 1e-9, gain / SQUARE, rtol=5e-3)  # three figures


def test_a_load_of_10_hz_needs_no_motor_and_a_drive_by_the_user_gets_none(tmp_path):
    _stage, robot, _ = converted(finger(tmp_path, 30, 2.0))
    assert_allclose(drive_of(robot, "j")[1], 2 * SQUARE, rtol=5e-3)
    assert not prim(robot, "j").GetAttribute("newton:armature").HasAuthoredValue()
    rule = DriveRule(joints="j", type="position", stiffness=70.0)
    _stage, robot, _ = converted(finger(tmp_path, 30, 1e-9), drives=(rule,))
    assert_allclose(drive_of(robot, "j")[1], 70, rtol=1e-6)
    assert not prim(robot, "j").GetAttribute("newton:armature").HasAuthoredValue()


LEG = """<link name="base">{INERTIAL}</link><link name="thigh">{INERTIAL}</link>
<link name="shank"><inertial><origin xyz="0 0 -0.2"/><mass value="1"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tread">{INERTIAL}</link><link name="turret">{INERTIAL}</link>
<link name="fork">{INERTIAL}</link><link name="roller">{INERTIAL}</link>
<joint name="hip" type="continuous"><parent link="base"/><child link="thigh"/><axis xyz="0 1 0"/></joint>
<joint name="knee" type="continuous"><parent link="thigh"/><child link="shank"/><axis xyz="0 1 0"/></joint>
<joint name="roll" type="continuous"><parent link="base"/><child link="tread"/><axis xyz="0 1 0"/></joint>
<joint name="yaw" type="continuous"><parent link="base"/><child link="turret"/><axis xyz="0 0 1"/></joint>
<joint name="swivel" type="continuous"><parent link="base"/><child link="fork"/><axis xyz="0 0 1"/></joint>
<joint name="rolls" type="continuous"><parent link="fork"/><child link="roller"/>
  <origin xyz="-0.02 0 0"/><axis xyz="0 1 0"/></joint>"""

LIFT = """<link name="arm">{INERTIAL}</link><joint name="lift" type="revolute"><parent link="turret"/>
<child link="arm"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""

EFFORT = """<transmission name="{0}"><joint name="{0}"><hardwareInterface>
hardware_interface/EffortJointInterface</hardwareInterface></joint></transmission>"""


def test_joints_without_limits_hold_a_position_where_they_bear_a_load(tmp_path):
    """The legs of Mini Cheetah gave way at 28 mm/s, and Poppy swung: their joints are continuous."""
    efforts = "".join(map(EFFORT.format, ("hip", "knee", "roll")))
    _stage, robot, _ = converted(urdf(tmp_path, LEG + efforts, "leg"))
    for name in ("hip", "knee"):
        assert drive_of(robot, name)[1] >= 100
    assert drive_of(robot, "roll")[1:] == (0, 0)  # a wheel that something else drives by its torque
    for name in ("yaw", "swivel", "rolls"):
        assert drive_of(robot, name)[1] == 0
        assert drive_of(robot, name)[2] > 0
    _stage, robot, _ = converted(urdf(tmp_path, LEG + LIFT + EFFORT.format("yaw"), "leg"))
    assert drive_of(robot, "yaw")[1] >= 100  # that of an arm, such as Jaco's


@pytest.mark.parametrize(
    ("interfaces", "held"), [(("velocity", "position"), True), (("effort",), True), (("velocity",), False)]
)
def test_a_joint_with_limits_is_held_unless_it_takes_velocities_only(tmp_path, interfaces, held):
    """xArm and TIAGo take both: their arms sank by 7 and 36 mm/s. Those of Panda and PR2, by effort, fell."""
    path = finger(tmp_path, 30, 0.1)
    tags = "".join(f'<command_interface name="{name}"/>' for name in interfaces)
    control = f'<ros2_control name="c" type="system"><joint name="j">{tags}</joint></ros2_control></robot>'
    path.write_text(path.read_text().replace("</robot>", control))
    _stage, robot, _ = converted(path)
    assert (drive_of(robot, "j")[1] > 0) is held


@pytest.mark.parametrize("case", ["plate", "needle"])
def test_moments_in_single_precision_are_those_of_a_body_too(tmp_path, case):
    """Isaac Sim's RigidBodyHasMassAPI: I1 + I2 = I3, but not after rounding, as in a finger of Allegro.

    A rod, with turned axes, is flat in two directions: lowering its largest moment made the next too large.
    """
    pairs = np.random.default_rng(0).uniform(1e-6, 1e-4, (20, 2)) if case == "plate" else [(1e-15, 1e-7)]
    for small, large in pairs:
        tensor = f'ixx="{small}" iyy="{large}" izz="{small + large}" ixy="0" ixz="0" iyz="0"'
        if case == "needle":
            turned = f'ixy="{-1e-5 * large}" ixz="0" iyz="{1e-5 * large}"'
            tensor = f'ixx="{large}" iyy="{small}" izz="{large}" {turned}'
        link = f'<link name="a"><inertial><mass value="1"/><inertia {tensor}/></inertial></link>'
        _stage, robot, _ = converted(urdf(tmp_path, link, case))
        moments = np.array(UsdPhysics.MassAPI(prim(robot, "a")).GetDiagonalInertiaAttr().Get(), np.float32)
        for i in range(3):
            assert moments[i - 1] + moments[i - 2] >= moments[i]
        assert_allclose(
            np.sort(moments)[1:],
            np.sort([small, large, small + large if case == "plate" else large])[1:],
            rtol=3e-6,
        )
