import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from made import BALL, INERTIAL, arm, converted, drive_of, joint, link, masses, prim, urdf
from numpy.testing import assert_allclose
from pxr import Usd, UsdGeom, UsdPhysics, UsdShade
from validators import assert_valid

from magtwin.errors import InputError
from magtwin.frames import matrix_from_quat, quat_from_rpy
from magtwin.urdf.description.description import read_description
from magtwin.urdf.options import DriveRule
from magtwin.urdf.physics import inertia as solids
from magtwin.urdf.physics.inertia import MassProperties, combined
from magtwin.urdf.write import write_urdf

LIMIT = '<limit effort="3" velocity="2" lower="-1" upper="0.5"/>'


def mass_of(body):
    """Mass, centre and tensor of a body in its own axes, as an engine reads them."""
    mass = UsdPhysics.MassAPI(body)
    q = mass.GetPrincipalAxesAttr().Get()
    R = matrix_from_quat(np.array([*q.imaginary, q.real]) / q.GetLength())
    tensor = R @ np.diag(mass.GetDiagonalInertiaAttr().Get()) @ R.T
    return mass.GetMassAttr().Get(), np.array(mass.GetCenterOfMassAttr().Get()), tensor


# --- solids and inertia ---------------------------------------------------------------------------

SHAPES = {
    "box": (solids.box([0.2, 0.3, 0.5]), trimesh.creation.box([0.2, 0.3, 0.5]), 1e-9),
    "ball": (solids.sphere(0.3), trimesh.creation.icosphere(5, 0.3), 2e-3),
    "cylinder": (solids.cylinder(0.3, 0.8), trimesh.creation.cylinder(0.3, 0.8, sections=400), 2e-4),
    "capsule": (
        solids.capsule(0.3, 0.8),
        trimesh.creation.capsule(height=0.8, radius=0.3, count=[200, 200]),
        1e-3,
    ),
}


@pytest.mark.parametrize("name", SHAPES)
def test_closed_forms_of_solids_are_what_their_fine_meshes_enclose(name):
    form, mesh, tolerance = SHAPES[name]  # a polygon has less than its circle, by 1 part in sections^2
    mesh.apply_translation(-mesh.center_mass)
    enclosed = solids.polyhedron(mesh.vertices, mesh.faces)
    assert_allclose(form.mass, enclosed.mass, rtol=tolerance)
    assert_allclose(form.inertia, enclosed.inertia, rtol=2 * tolerance, atol=1e-4 * form.inertia.max())
    assert_allclose(enclosed.inertia, mesh.moment_inertia, rtol=1e-6, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(
    cut=st.floats(0.1, 0.9),
    rpy=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    t=st.lists(st.floats(-2, 2), min_size=3, max_size=3),
)
def test_two_parts_of_a_box_together_weigh_and_turn_as_the_box(cut, rpy, t):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = matrix_from_quat(quat_from_rpy(rpy)), t

    def part(start, end):
        at = np.eye(4)
        at[0, 3] = (start + end) / 2
        return solids.box([end - start, 0.5, 0.3]).moved(T @ at)

    whole, both = part(0, 1), combined([part(0, cut), part(cut, 1)])
    assert_allclose(both.mass, whole.mass, rtol=1e-12)
    assert_allclose(both.centre, whole.centre, atol=1e-12)
    assert_allclose(both.inertia, whole.inertia, atol=1e-9)


# --- masses of links ------------------------------------------------------------------------------


def test_a_massless_base_takes_the_mass_of_the_inertial_link_welded_to_it(tmp_path):
    parts = (
        f'<link name="base"><collision>{BALL}</collision></link>'
        '<link name="mass"><inertial><origin xyz="0 0 0.1"/><mass value="46"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        f'<link name="lid"><collision>{BALL}</collision>{INERTIAL}</link>'
    )
    for name, z in (("mass", 0.2), ("lid", 0.5)):
        parts += (
            f'<joint name="{name}_joint" type="fixed"><parent link="base"/><child link="{name}"/>'
            f'<origin xyz="0 0 {z}"/></joint>'
        )
    stage, robot, report = converted(urdf(tmp_path, parts))
    mass, centre, _ = mass_of(robot.GetPrimAtPath("base"))
    assert_allclose([mass, *centre], [46, 0, 0, 0.3], rtol=1e-6, atol=1e-7)
    assert masses(stage) == {"base": 46, "lid": 1}  # the lid stays a body
    assert "link 'base' has no <inertial>: it takes that of 'mass'" in report.notes


@pytest.mark.parametrize(
    ("shape", "mass", "told"),
    [
        ("collision", 4000 / 3 * np.pi * 0.1**3, "4.19 kg, its colliders at 1000 kg/m3"),
        ("visual", 0.001, "0.001 kg, so that engines add none"),
    ],
)
def test_a_link_without_inertial_is_part_of_a_body_or_has_the_mass_that_engines_compute(
    tmp_path, shape, mass, told
):
    shapes = f"<{shape}>{BALL}</{shape}>"
    stage, robot, report = converted(arm(tmp_path, "fixed|", shapes))
    assert "link 'hand' has no <inertial>: it is part of the body of 'base_link'" in report.notes
    assert not robot.GetPrimAtPath("base_link/hand").HasAPI(UsdPhysics.RigidBodyAPI)
    fixed = sum(masses(stage).values())
    stage, robot, report = converted(arm(tmp_path, "continuous|", shapes))
    assert f"link 'hand' has no <inertial>: {told}" in report.notes
    assert_allclose(sum(masses(stage).values()), fixed + mass, rtol=1e-6)
    assert_allclose(mass_of(robot.GetPrimAtPath("hand"))[0], mass, rtol=1e-6)


# --- merging --------------------------------------------------------------------------------------

BOXES = """<link name="base">{box_a}</link><link name="lid">{box_b}</link><link name="eye"/>
<joint name="screw" type="fixed"><parent link="base"/><child link="lid"/>
  <origin xyz="0.3 -0.2 0.4" rpy="0.3 0.5 -0.7"/></joint>
<joint name="glue" type="fixed"><parent link="lid"/><child link="eye"/><origin xyz="0 0 0.1"/></joint>"""


def box_link(size, mass, origin):
    """A link that is an even box, described by its own inertial."""
    x, y, z = np.square(size) * mass / 12
    words = " ".join(map(str, size))
    return (
        f'<inertial>{origin}<mass value="{mass}"/><inertia ixx="{y + z}" iyy="{x + z}" izz="{x + y}" '
        'ixy="0" ixz="0" iyz="0"/></inertial>'
        f'<visual>{origin}<geometry><box size="{words}"/></geometry></visual>'
        f'<collision>{origin}<geometry><box size="{words}"/></geometry></collision>'
    )


def boxes(tmp_path):
    a = box_link((0.2, 0.4, 0.6), 3.0, '<origin xyz="0.1 0 0" rpy="0.2 0 0"/>')
    b = box_link((0.5, 0.1, 0.3), 2.0, '<origin xyz="0 0.05 0" rpy="0 0 0.4"/>')
    return urdf(tmp_path, BOXES.replace("{box_a}", a).replace("{box_b}", b), "boxes")


def test_a_merged_body_weighs_and_turns_as_its_shapes_together_and_keeps_every_frame(tmp_path):
    path = boxes(tmp_path)
    _stage, robot, _ = converted(path)
    apart = {p.GetName(): UsdGeom.XformCache().GetLocalToWorldTransform(p) for p in Usd.PrimRange(robot)}
    stage, robot, _ = converted(path, merge_fixed=True)
    bodies = [p.GetName() for p in stage.Traverse() if p.HasAPI(UsdPhysics.RigidBodyAPI)]
    assert bodies == ["base"]
    assert not [p for p in stage.Traverse() if p.IsA(UsdPhysics.Joint)]
    for name in ("lid", "eye"):
        site = robot.GetPrimAtPath(f"base/{name}")
        assert "IsaacSiteAPI" in site.GetPrimTypeInfo().GetAppliedAPISchemas()
        placed = UsdGeom.XformCache().GetLocalToWorldTransform(site)
        assert_allclose(np.array(placed), np.array(apart[name]), atol=1e-9)
    body = robot.GetPrimAtPath("base")
    colliders = list(robot.GetPrimAtPath("base/collisions").GetChildren())
    assert [c.GetName() for c in colliders] == ["box", "lid"]
    parts = [solids.read_solid([c], body) for c in colliders]
    densities = [3.0 / 0.048, 2.0 / 0.015]  # mass over volume
    whole = combined(
        [MassProperties(d * p.mass, p.centre, d * p.inertia) for p, d in zip(parts, densities, strict=True)]
    )
    mass, centre, tensor = mass_of(body)
    assert_allclose(mass, 5, rtol=1e-6)
    assert_allclose(centre, whole.centre, atol=1e-6)
    assert_allclose(tensor, whole.inertia, atol=1e-6)
    assert_valid(path.with_suffix(".usda"), tmp_path)


# --- bases and joints -----------------------------------------------------------------------------


def test_a_fixed_base_is_bolted_to_the_robots_prim_where_it_stands(tmp_path):
    body = """<link name="base_footprint"/><link name="base">{BODY}</link>
    <joint name="up" type="fixed"><parent link="base_footprint"/><child link="base"/>
      <origin xyz="0 0 0.1" rpy="0 0 1"/></joint>"""
    path = urdf(tmp_path, body, "post")
    stage, robot, _ = converted(path, fix_base=True)
    joint = UsdPhysics.Joint(prim(robot, "root_joint"))
    assert joint.GetBody0Rel().GetTargets() == [robot.GetPath()]
    assert joint.GetBody1Rel().GetTargets() == [robot.GetPath().AppendChild("base")]
    assert robot.GetAttribute("isaac:robotType").Get() == "Manipulator"
    assert_allclose(joint.GetLocalPos0Attr().Get(), [0, 0, 0.1], atol=1e-7)
    assert_valid(path.with_suffix(".usda"), tmp_path)
    stage, robot, _ = converted(path)
    assert not [p for p in stage.Traverse() if p.IsA(UsdPhysics.Joint)]
    assert robot.GetAttribute("isaac:robotType").Get() == "Default"


def test_what_slides_on_a_root_without_mass_slides_on_the_world(tmp_path):
    body = """<link name="rail"/><link name="cart">{BODY}</link>
    <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/><origin xyz="0 0 1"/>
      <axis xyz="1 0 0"/><limit lower="-2" upper="2" effort="9" velocity="3"/></joint>"""
    _stage, robot, _ = converted(urdf(tmp_path, body, "cartpole"))
    joint = UsdPhysics.Joint(prim(robot, "slide"))
    assert joint.GetBody0Rel().GetTargets() == [robot.GetPath()]
    assert not robot.HasAPI(UsdPhysics.RigidBodyAPI)
    assert "IsaacSiteAPI" in robot.GetPrimAtPath("rail").GetPrimTypeInfo().GetAppliedAPISchemas()


def test_speed_damping_and_friction_reach_newton_and_physx_in_their_units(tmp_path):
    path = arm(tmp_path, f'revolute|<axis xyz="0 0 1"/>{LIMIT}<dynamics damping="0.2" friction="0.1"/>')
    _stage, robot, _ = converted(path)
    joint = prim(robot, "j")
    applied = joint.GetPrimTypeInfo().GetAppliedAPISchemas()
    assert {"NewtonJointAPI", "PhysxJointAPI", "PhysxJointAxisAPI:angular"} <= set(applied)
    figures = {
        "newton:velocityLimit": np.degrees(2),
        "newton:damping": np.radians(0.2),  # N m s per degree
        "newton:friction": 0.1,
        "physxJoint:maxJointVelocity": np.degrees(2),
        "physxJointAxis:angular:maxJointVelocity": np.degrees(2),
        "physxJointAxis:angular:viscousFrictionCoefficient": np.radians(0.2),
        "physxJointAxis:angular:staticFrictionEffort": 0.1,
        "physxJointAxis:angular:dynamicFrictionEffort": 0.1,
    }
    for name, value in figures.items():
        assert_allclose(joint.GetAttribute(name).Get(), value, rtol=1e-6, err_msg=name)


def test_equal_limits_weld_a_joint_at_their_value(tmp_path):
    limit = '<limit lower="0.3" upper="0.3" effort="1" velocity="1"/>'
    _stage, robot, report = converted(arm(tmp_path, f'prismatic|<axis xyz="0 1 0"/>{limit}'))
    joint = prim(robot, "j")
    assert joint.IsA(UsdPhysics.FixedJoint)
    assert_allclose(UsdPhysics.Joint(joint).GetLocalPos0Attr().Get(), [0, 0.3, 0], atol=1e-7)
    hand = UsdGeom.XformCache().GetLocalToWorldTransform(robot.GetPrimAtPath("hand"))
    assert_allclose(hand.ExtractTranslation(), [0, 0.3, 0], atol=1e-9)
    assert "joint 'j' (prismatic) cannot move by its own limits: welded" in report.notes


def test_a_joint_whose_limits_exclude_0_is_held_at_the_nearest_limit(tmp_path):
    limit = '<limit lower="0.2" upper="0.9" effort="1" velocity="1"/>'
    _stage, robot, report = converted(arm(tmp_path, f'revolute|<axis xyz="0 1 0"/>{limit}'))
    drive, *_ = drive_of(robot, "j")
    assert_allclose(drive.GetTargetPositionAttr().Get(), np.degrees(0.2), rtol=1e-6)
    assert any("stands at 0, outside its limits 0.2 to 0.9" in note for note in report.notes)


# --- mimics ---------------------------------------------------------------------------------------


def follower(tmp_path, mimic, kind="revolute", lead=LIMIT):
    turns = joint("lead", "a", "b", "revolute", f'<axis xyz="0 0 1"/>{lead}')
    follows = joint("f", "a", "c", kind, f'<axis xyz="0 1 0"/>{LIMIT}{mimic}')
    return urdf(tmp_path, "\n".join([*map(link, "abc"), turns, follows]), "pair")


def test_a_mimic_is_authored_for_newton_and_for_physx_and_its_own_drive_has_no_gains(tmp_path):
    path = follower(tmp_path, '<mimic joint="lead" multiplier="-2" offset="0.1"/>')
    _stage, robot, _ = converted(path)
    joint, lead = prim(robot, "f"), prim(robot, "lead").GetPath()
    assert joint.GetRelationship("newton:mimicJoint").GetTargets() == [lead]
    assert_allclose(joint.GetAttribute("newton:mimicCoef0").Get(), np.degrees(0.1), rtol=1e-6)
    assert joint.GetAttribute("newton:mimicCoef1").Get() == -2
    space = "physxMimicJoint:rotY"  # q + gearing q_leader + offset = 0
    assert joint.GetRelationship(f"{space}:referenceJoint").GetTargets() == [lead]
    assert joint.GetAttribute(f"{space}:referenceJointAxis").Get() == "rotZ"
    assert joint.GetAttribute(f"{space}:gearing").Get() == 2
    assert_allclose(joint.GetAttribute(f"{space}:offset").Get(), -np.degrees(0.1), rtol=1e-6)
    applied = set(joint.GetPrimTypeInfo().GetAppliedAPISchemas())
    assert {"NewtonMimicAPI", "PhysxMimicJointAPI:rotY"} <= applied
    assert drive_of(robot, "f")[1:] == (0, 0)
    assert_allclose(joint.GetAttribute("state:angular:physics:position").Get(), np.degrees(0.1), rtol=1e-6)
    hand = UsdGeom.XformCache().GetLocalToWorldTransform(robot.GetPrimAtPath("c"))
    assert_allclose(hand.ExtractRotation().GetAngle(), np.degrees(0.1), atol=1e-6)  # where it rests


# --- drives ---------------------------------------------------------------------------------------


def test_the_first_rule_that_fits_a_joint_drives_it(tmp_path):
    path = follower(tmp_path, "")
    rules = (
        DriveRule(joints="le*", type="velocity", damping=0.7),
        DriveRule(joints="*", type="position", stiffness=40.0, damping=3.0, max_force=9.0),
    )
    _stage, robot, _ = converted(path, drives=rules)
    drive, stiffness, damping = drive_of(robot, "lead")
    assert_allclose([stiffness, damping, drive.GetMaxForceAttr().Get()], [0, 0.7, 3], rtol=1e-6)
    assert drive.GetTargetVelocityAttr().HasAuthoredValue()
    drive, stiffness, damping = drive_of(robot, "f")
    assert_allclose([stiffness, damping, drive.GetMaxForceAttr().Get()], [40, 3, 9], rtol=1e-6)
    assert drive.GetTargetPositionAttr().HasAuthoredValue()
    _stage, robot, _ = converted(path, drives=(DriveRule(joints="f", type="none"),))
    assert drive_of(robot, "f")[1:] == (0, 0)


CRANE = """<link name="a">{{BODY}}</link>
<link name="b"><inertial><origin xyz="0.5 0 0"/><mass value="{mass}"/>
  <inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="c"><inertial><origin xyz="0 0 0.1"/><mass value="3"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="lift" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
  <limit lower="0" upper="1" effort="0" velocity="1"/></joint>
<joint name="elbow" type="revolute"><parent link="b"/><child link="c"/><origin xyz="1 0 0" rpy="0 0 1"/>
  <axis xyz="0 2 0"/><limit lower="-1" upper="1" effort="40" velocity="1"/></joint>{extra}"""


@pytest.mark.parametrize("mass", [2, 200])
def test_a_joint_with_limits_holds_what_it_carries_at_10_hz(tmp_path, mass):
    """Torsos sank and arms fell: 100 N/m held the lift of HSR, 100 N m/rad the shoulder of Baxter."""
    path = urdf(tmp_path, CRANE.format(mass=mass, extra=""), "crane")
    _stage, robot, _ = converted(path)
    square = (2 * np.pi * 10) ** 2
    drive, stiffness, damping = drive_of(robot, "lift", "linear")
    assert_allclose([stiffness, damping], [square * (mass + 3), square * (mass + 3) / 10], rtol=5e-3)
    assert_allclose(drive.GetMaxForceAttr().Get(), 2 * 9.80665 * (mass + 3), rtol=5e-3)  # the URDF gives 0
    drive, stiffness, _ = drive_of(robot, "elbow")
    assert_allclose(stiffness, square * (0.1 + 3 * 0.1**2), rtol=5e-3)
    assert drive.GetMaxForceAttr().Get() == 40


def test_a_rule_that_fits_no_joint_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"drive rule 'laed' fits no joint .* did you mean 'lead'"):
        converted(follower(tmp_path, ""), drives=(DriveRule(joints="laed", damping=1.0),))


@pytest.mark.parametrize(
    ("rule", "words"),
    [
        ({"type": "velocity"}, "without damping .*; give damping="),
        ({"type": "position", "damping": 1.0}, "without stiffness"),
        ({"type": "velocity", "damping": 1.0, "stiffness": 2.0}, "type velocity has no stiffness, got 2"),
        ({"type": "none", "damping": 1.0}, "type none has no damping, got 1"),
        ({"damping": float("nan")}, "damping must .* from 0 up, got nan"),
        ({"damping": 1.0, "max_force": 0.0}, "max_force must be above 0, got 0"),
    ],
)
def test_a_rule_without_effect_is_refused(rule, words):
    with pytest.raises(InputError, match=rf"drive 'x': {words}"):
        DriveRule(joints="x", **rule)
    with pytest.raises(InputError, match="drive 'x': without damping"):
        DriveRule.parse("x:velocity")


def test_a_base_that_is_fixed_to_a_root_called_world_is_fixed_at_its_place(tmp_path):
    body = """<link name="world"/><link name="base">{BODY}</link>
    <joint name="j" type="TYPE"><parent link="world"/><child link="base"/><origin xyz="0 0 0.5"/></joint>"""
    path = urdf(tmp_path, body.replace("TYPE", "fixed"), "desk")
    stage, robot, report = converted(path)
    (fixed,) = [UsdPhysics.FixedJoint(p) for p in stage.Traverse() if p.IsA(UsdPhysics.FixedJoint)]
    assert fixed.GetBody0Rel().GetTargets() == [robot.GetPath()]
    assert fixed.GetBody1Rel().GetTargets() == [robot.GetPrimAtPath("base").GetPath()]
    assert_allclose(fixed.GetLocalPos0Attr().Get(), [0, 0, 0.5])
    assert "link 'world' is the world: the base 'base' is fixed to it" in report.notes
    write_urdf(tmp_path / "desk.usda", tmp_path / "back.urdf")
    back = read_description(tmp_path / "back.urdf")
    (joint,) = back.joints.values()
    assert (joint.type, joint.parent, joint.child) == ("fixed", "world", "base")
    assert_allclose(joint.origin[:3, 3], [0, 0, 0.5], atol=1e-12)
    stage, _, report = converted(urdf(tmp_path, body.replace("TYPE", "floating"), "desk"))
    assert not [p for p in stage.Traverse() if p.IsA(UsdPhysics.FixedJoint)]
    assert any("the base 'base' floats" in note for note in report.notes)


# --- the profile of bases with two driven wheels --------------------------------------------------


def rover(tmp_path, wheel="", swivel="continuous"):
    """A base on two wheels, a ball and a swivel caster; one wheel hangs on a dead suspension."""
    mass = INERTIAL
    disc = '<collision><geometry><cylinder radius="0.1" length="0.03"/></geometry></collision>'
    ball = '<collision><geometry><sphere radius="0.05"/></geometry></collision>'
    chest = '<collision><geometry><box size="0.4 0.2 0.1"/></geometry></collision>'
    turn = 'rpy="-1.57079632679 0 0"'
    return urdf(
        tmp_path,
        f"""<link name="base_link">{mass}{chest}</link><link name="strut">{mass}</link>
        <link name="left_wheel">{mass}{disc}</link><link name="right_wheel">{mass}{disc}</link>
        <link name="skid">{mass}{ball}</link>
        <link name="fork">{mass}</link><link name="roller">{mass}{disc}</link>
        <joint name="spring" type="prismatic"><parent link="base_link"/><child link="strut"/>
          <origin xyz="0 0.2 0"/><axis xyz="0 0 1"/>
          <limit lower="0" upper="0.02" effort="0" velocity="1"/></joint>
        <joint name="left" type="continuous"><parent link="strut"/><child link="left_wheel"/>
          <origin xyz="0 0 0" {turn}/><axis xyz="0 0 1"/>{wheel}</joint>
        <joint name="right" type="continuous"><parent link="base_link"/><child link="right_wheel"/>
          <origin xyz="0 -0.2 0" {turn}/><axis xyz="0 0 1"/>{wheel}</joint>
        <joint name="under" type="fixed"><parent link="base_link"/><child link="skid"/>
          <origin xyz="0.3 0 -0.05"/></joint>
        <joint name="swivel" type="{swivel}"><parent link="base_link"/><child link="fork"/>
          <origin xyz="-0.3 0 0"/><axis xyz="0 0 1"/></joint>
        <joint name="roll" type="continuous"><parent link="fork"/><child link="roller"/>
          <origin xyz="-0.02 0 0" {turn}/><axis xyz="0 0 1"/></joint>""",
        "rover",
    )


def friction(robot, link):
    collider = robot.GetPrimAtPath(f"{link}/collisions").GetChildren()[0]
    grip = UsdShade.MaterialBindingAPI(collider).ComputeBoundMaterial("physics")[0]
    return UsdPhysics.MaterialAPI(grip).GetDynamicFrictionAttr().Get()


def test_diff_drive_drives_the_wheels_frees_the_casters_and_welds_the_dead_suspension(tmp_path):
    _stage, robot, report = converted(rover(tmp_path), profile="diff-drive")
    kg, n, radius = 7.0, 2, 0.1
    for name in ("left", "right"):
        drive, stiffness, damping = drive_of(robot, name)
        assert stiffness == 0
        assert_allclose(damping, 5 * kg * radius**2 / n / 0.007, rtol=5e-3)  # three figures
        assert_allclose(drive.GetMaxForceAttr().Get(), kg * 9.81 * radius / n, rtol=5e-3)
        limit = prim(robot, name).GetAttribute("newton:velocityLimit").Get()
        assert_allclose(limit, np.degrees(30), rtol=1e-6)
    for name in ("swivel", "roll"):
        drive, stiffness, damping = drive_of(robot, name)
        assert (stiffness, damping) == (0, 0)
        assert np.isfinite(drive.GetMaxForceAttr().Get())
        assert f"joint {name!r} is not a driven wheel: it turns freely" in report.notes
    assert prim(robot, "spring").IsA(UsdPhysics.FixedJoint)
    assert "joint 'spring' (prismatic) is a suspension without effort or speed: welded" in report.notes
    found = [friction(robot, link) for link in ("left_wheel", "right_wheel", "skid", "base_link")]
    assert_allclose(found, [1, 1, 0.05, 0.5], rtol=1e-6)
    assert "link 'skid' is a caster and gives no friction: 0.05" in report.notes


def test_a_robot_without_two_wheels_is_no_diff_drive(tmp_path):
    with pytest.raises(InputError, match=r"profile diff-drive needs two wheels, .* found none"):
        converted(arm(tmp_path, f'revolute|<axis xyz="0 1 0"/>{LIMIT}'), profile="diff-drive")
