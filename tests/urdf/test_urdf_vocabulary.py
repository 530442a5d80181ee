"""Each element and attribute of a URDF is used, moved, kept as text or reported as unknown."""

from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made import BALL, INERTIAL, converted
from numpy.testing import assert_allclose
from pxr import UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.urdf.description.description import read_description
from magtwin.urdf.description.tag import KEPT
from magtwin.urdf.description.vocabulary import GRAMMAR, unused
from magtwin.urdf.write import write_urdf

SOLID = """<inertial><origin xyz="1 2 3" rpy="0 0 0"/><mass value="2"/><inertia ixx="1" iyy="1" izz="1"
ixy="0.1" ixz="0.1" iyz="0.1"/></inertial>"""
SHAPES = "".join(
    f'<{role} name="n">\n<origin quat_xyzw="0 0 0 1"/><geometry><{shape}/></geometry>{look}</{role}>'
    for role, look in (("visual", '<material name="m"/>'), ("collision", ""))
    for shape in (
        'box size="1 1 1"',
        'capsule radius="1" length="1"',
        'cylinder radius="1" length="1"',
        'sphere radius="1"',
        'mesh filename="a.stl" scale="1 1 1"',
    )
)
FULL = f"""<robot name="full" version="1.1">
<material name="m"><color rgba="1 0 0 1"/><texture filename="a.png"/></material>
<link name="a">{SOLID}{SHAPES}</link><link name="b"/><link name="c">{INERTIAL}</link>
<link name="d">{INERTIAL}</link>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><origin xyz="1 1 1" rpy="1 1 1"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
<dynamics damping="1" friction="1"/></joint>
<joint name="k" type="prismatic"><parent link="a"/><child link="c"/><limit lower="-1" upper="1"/>
<mimic joint="j" multiplier="1" offset="1"/></joint>
<joint name="fix" type="fixed" dont_collapse="false"><parent link="a"/><child link="d"/></joint></robot>"""
"""Every element and attribute that the grammar uses."""

OTHER = {"type": "continuous", "dont_collapse": "true", "version": "7", "parent": "c", "child": "e"}
"""Another value of attributes that are no names and no numbers, or whose names must exist."""


def read(tmp_path, text):
    """Everything that a description holds, or the text of its refusal."""
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    try:
        d = read_description(path)
    except InputError as error:
        return str(error)
    return repr([d.name, d.links, d.joints, d.materials, d.repairs.notes])


def test_a_description_that_uses_the_whole_grammar_leaves_nothing_over():
    robot = ElementTree.fromstring(FULL)
    assert not list(unused(robot))
    used = {(e.tag, f"@{name}") for e in robot.iter() for name in e.attrib}
    used |= {(e.tag, child.tag) for e in robot.iter() for child in e}
    table = {
        (tag, name) for tag, entry in GRAMMAR.items() for name, fate in entry.fates.items() if fate == "used"
    }
    assert used == table


@pytest.mark.parametrize(
    ("tag", "name"),
    [
        (tag, name[1:])
        for tag, e in GRAMMAR.items()
        for name, f in e.fates.items()
        if f == "used" and name[0] == "@"
    ],
)
def test_every_attribute_that_the_grammar_uses_changes_what_is_read(tmp_path, tag, name):
    robot = ElementTree.fromstring(FULL)
    before = read(tmp_path, ElementTree.tostring(robot, encoding="unicode"))
    element = next(e for e in robot.iter(tag) if name in e.attrib)
    value = element.attrib[name]
    numbers = GRAMMAR[tag].numbers
    changed = " ".join(repr(float(w) * 0.5 + 0.25) for w in value.split()) if name in numbers else f"{value}x"
    element.set(name, OTHER.get(name, changed))
    assert read(tmp_path, ElementTree.tostring(robot, encoding="unicode")) != before


def convert(tmp_path, text, **options):
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    stage, _, report = converted(path, **options)
    return stage, report


def arm(joint, links="", origin="", head='name="arm"'):
    return f"""<robot {head}>
<link name="base">{INERTIAL}{links}</link>
<link name="tip">{INERTIAL}</link>
<joint name="j" {joint}><parent link="base"/><child link="tip"/>{origin}</joint></robot>"""


LIMIT = '<limit lower="-1" upper="1" effort="1" velocity="1" {}/>'


def test_known_attributes_without_a_counterpart_are_kept_as_text_and_are_no_fault(tmp_path):
    limit = LIMIT.format('acceleration="3" jerk="4" drake:x="5"')
    collision = f'<collision group="g">{BALL}<material name="m"/></collision>'
    text = arm('type="revolute"', collision, limit, 'name="arm" version="1.2" xmlns:drake="d"')
    stage, report = convert(tmp_path, text, strict=True)
    kept = stage.GetPrimAtPath("/arm/joints/j").GetCustomDataByKey(KEPT)
    assert list(kept) == ["limit: acceleration='3'", "limit: jerk='4'", "limit: drake:x='5'"]
    kept = stage.GetPrimAtPath("/arm/base").GetCustomDataByKey(KEPT)
    assert list(kept) == ["collision: group='g'", 'collision: <material name="m"></material>']
    limits = (f"limit/@{n}" for n in ("acceleration", "drake:x", "jerk"))
    assert report.unknown_tags == dict.fromkeys(("collision/@group", "collision/material", *limits), 1)


QUARTER = 'quat_xyzw="0 0 0.70710678 0.70710678"'


def test_a_quaternion_turns_a_link_and_comes_back_as_the_same_turn(tmp_path):
    stage, _ = convert(tmp_path, arm('type="fixed"', origin=f'<origin xyz="0 0 1" {QUARTER}/>'), strict=True)
    T = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/arm/tip"))).T
    assert_allclose(T[:3], [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 1]], atol=1e-12)
    write_urdf(tmp_path / "robot.usda", tmp_path / "back.urdf")
    back = read_description(tmp_path / "back.urdf").joints["tip"].origin
    assert_allclose(back, T, atol=1e-12)
    with pytest.raises(InputError, match=r"robot.urdf:4: joint 'j': quat_xyzw of <origin> has length 0"):
        convert(tmp_path, arm('type="fixed"', origin='<origin quat_xyzw="0 0 0 0"/>'))


@pytest.mark.parametrize(("word", "bodies"), [("true", {"base", "tip"}), ("false", {"base"})])
def test_dont_collapse_keeps_a_body_when_fixed_joints_are_merged(tmp_path, word, bodies):
    stage, report = convert(
        tmp_path, arm(f'type="fixed" dont_collapse="{word}"'), merge_fixed=True, strict=True
    )
    assert {p.GetName() for p in stage.Traverse() if p.HasAPI(UsdPhysics.RigidBodyAPI)} == bodies
    assert report.mass_out_kg == report.mass_in_kg


PLACES = [e for e in ElementTree.fromstring(FULL).iter() if e.tag != "texture"]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, len(PLACES) - 1), st.from_regex(r"[a-z]{3,9}_x", fullmatch=True), st.floats(-9, 9))
def test_an_unknown_attribute_anywhere_is_always_reported(tmp_path_factory, at, name, value):
    robot = ElementTree.fromstring(FULL)
    [e for e in robot.iter() if e.tag != "texture"][at].set(name, f"{value:g}")
    path = tmp_path_factory.mktemp("unknown") / "robot.urdf"
    path.write_text(ElementTree.tostring(robot, encoding="unicode"))
    repairs = read_description(path).repairs.by_kind()["attribute-unknown"]
    assert [r.text for r in repairs if f"{name}='{value:g}'" in r.text]
    assert all(r.line for r in repairs)


def test_the_proof_has_a_line_for_each_element_and_attribute(tmp_path):
    shapes = f"<visual>{BALL}</visual><collision>{BALL}</collision>"
    text = arm('type="revolute"', shapes, LIMIT.format('acceleration="3"') + '<axis xyz="0 0 1"/>').replace(
        "</robot>", '<material name="spare"><color rgba="1 0 0 1"/></material></robot>'
    )
    stage, report = convert(tmp_path, text, proof=True)
    xml = ElementTree.fromstring(text)
    assert len(report.proof) == sum(1 + len(e.attrib) for e in xml.iter())
    lines = {line.item.split("/", 1)[-1]: line for line in report.proof}
    joint = "/arm/joints/j"
    for item, fate, prim, carried in (
        ("link(base)/inertial/mass/@value", "used", "/arm/base", "physics:mass = 1.0"),
        ("link(base)/collision/geometry/sphere/@radius", "used", "/arm/base/collisions/sphere", "radius ="),
        ("joint(j)/axis/@xyz", "used", joint, "physics:axis = Z"),
        ("joint(j)/limit/@lower", "used", joint, "physics:lowerLimit = -57.29578"),
        ("joint(j)/limit/@acceleration", "text", joint, KEPT),
        ("material(spare)/color/@rgba", "lost", "", "no visual wears it"),
    ):
        assert (lines[item].fate, lines[item].prim, lines[item].carried[: len(carried)]) == (
            fate,
            prim,
            carried,
        )
    for line in report.proof:
        assert line.fate != "used" or stage.GetPrimAtPath(line.prim)


@pytest.mark.parametrize(("density", "kg"), [(1000.0, 4.0), (250.0, 1.0)])
def test_a_robot_without_inertials_weighs_what_its_shapes_do(tmp_path, density, kg):
    box = '<geometry><box size=".2 .2 .1"/></geometry>'
    joint = '<joint name="j" type="continuous"><parent link="base"/><child link="tip"/></joint>'
    text = (
        f'<robot name="bare"><link name="base"><collision>{box}</collision></link>'
        f'<link name="tip"><visual>{box}</visual></link>{joint}</robot>'
    )
    _, report = convert(tmp_path, text, density=density)
    assert [line.mass_out_kg for line in report.links] == [pytest.approx(kg), pytest.approx(kg)]
    assert sum("has no <inertial>" in note for note in report.notes) == 2
    with pytest.raises(InputError, match="density must be above 0"):
        convert(tmp_path, text, density=0.0)
