"""URDF -> USD -> URDF: equal kinematics and inertia, shapes where they were; refusals."""

import json
from xml.etree import ElementTree

import numpy as np
import pytest
from made import BODY, INERTIAL, link_poses
from numpy.testing import assert_allclose
from pxr import Usd

from magtwin.author.from_urdf import write_urdf
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files.file import shipped
from magtwin.urdf.convert import convert_urdf
from magtwin.urdf.description.description import MOVING, origin_of, read_description
from magtwin.urdf.options import Options

EVERY = f"""<robot name="every"><link name="foot"/><link name="base_link">{BODY}</link>
<link name="arm">{INERTIAL}<visual name="tube"><origin xyz="0.1 0 0.2" rpy="0.3 0.4 0.5"/>
  <geometry><cylinder radius="0.03" length="0.4"/></geometry>
  <material name="red"><color rgba="0.8 0.1 0.1 1"/></material></visual>
  <collision><origin xyz="0 0 0.1"/><geometry><box size="0.1 0.2 0.3"/></geometry></collision></link>
<link name="hand"><inertial><origin xyz="0.01 0.02 0.03" rpy="0.1 0.2 0.3"/><mass value="0.7"/>
  <inertia ixx="0.011" iyy="0.013" izz="0.017" ixy="0.001" ixz="-0.002" iyz="0.003"/></inertial></link>
<link name="finger">{INERTIAL}</link><link name="slide">{INERTIAL}</link><link name="wheel">{INERTIAL}</link>
<link name="puck">{INERTIAL}</link><link name="oblique">{INERTIAL}</link><link name="tip"/>
<joint name="f" type="fixed"><parent link="foot"/><child link="base_link"/><origin xyz="0 0 0.04"/></joint>
<joint name="j1" type="revolute"><parent link="base_link"/><child link="arm"/><axis xyz="0 0 1"/>
  <origin xyz="0.1 0.2 0.3" rpy="0 1.5707963267948966 0.7"/>
  <limit lower="-1.5708" upper="2.0944" effort="3.7" velocity="2.4"/>
  <dynamics damping="0.05" friction="0.1"/></joint>
<joint name="j2" type="revolute"><parent link="arm"/><child link="hand"/><axis xyz="0 0 -1"/>
  <origin xyz="0.3 0 0" rpy="0.1 -0.2 0.3"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="j3" type="prismatic"><parent link="hand"/><child link="finger"/><axis xyz="0 1 0"/>
  <origin xyz="0 0.01 0.1"/><limit lower="0" upper="0.05" effort="5" velocity="0.2"/></joint>
<joint name="j4" type="prismatic"><parent link="hand"/><child link="slide"/><axis xyz="0 -1 0"/>
  <limit lower="-0.1" upper="0.1" effort="5" velocity="0.2"/>
  <mimic joint="j3" multiplier="-1.5" offset="0.02"/></joint>
<joint name="j5" type="continuous"><parent link="base_link"/><child link="wheel"/><axis xyz="0 1 0"/>
  <limit effort="2" velocity="12.87"/></joint>
<joint name="j6" type="planar"><parent link="base_link"/><child link="puck"/><axis xyz="0 0 1"/>
  <origin xyz="1 0 0" rpy="0.2 0 0"/></joint>
<joint name="j7" type="revolute"><parent link="hand"/><child link="oblique"/><axis xyz="1 2 -3"/>
  <origin xyz="0.1 0 0" rpy="0.3 0.2 0.1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
<joint name="t" type="fixed"><parent link="hand"/><child link="tip"/><origin xyz="0 0 0.2"/></joint>
</robot>"""


def there_and_back(urdf, folder, **choices):
    """The descriptions of a URDF and of the URDF of its stage, and the latter's file."""
    asset = convert_urdf(urdf, folder / "usd" / "robot.usda", options=Options(**choices))
    write_urdf(asset, folder / "back" / "robot.urdf")
    return (
        read_description(urdf),
        read_description(folder / "back" / "robot.urdf"),
        folder / "back" / "robot.urdf",
    )


def every(tmp_path):
    path = tmp_path / "every.urdf"
    path.write_text(EVERY)
    return path


def assert_same_kinematics(urdf, before, after, back, atol):
    rng = np.random.default_rng(0)
    moving = [j for j in after.joints.values() if j.type in MOVING and j.mimic is None]
    assert moving
    for _ in range(2):
        values = {joint.name: rng.uniform(-1, 1) for joint in moving}
        one, two = link_poses(urdf, values), link_poses(back, values)
        assert one.keys() == two.keys()
        home = np.linalg.inv(one[after.root])
        for link in one:
            assert_allclose(two[link], home @ one[link], rtol=0, atol=atol, err_msg=link)


def tensor(link):
    """Mass, centre and inertia in the link's axes."""
    T = origin_of(link.inertial)
    return link.inertial.mass, T[:3, 3], T[:3, :3] @ link.inertial.inertia @ T[:3, :3].T


def assert_same_inertia(before, after):
    """To single precision, in which UsdPhysics has it; masses, and centres of few digits, to the bit."""
    for name, link in before.links.items():
        if link.inertial is None:
            assert after.links[name].inertial is None
            continue
        (m1, c1, I1), (m2, c2, I2) = tensor(link), tensor(after.links[name])
        assert m1 == m2
        assert_allclose(c2, c1, rtol=0, atol=1e-12)
        assert_allclose(I2, I1, rtol=0, atol=2e-7 * np.abs(I1).max(), err_msg=name)


@pytest.mark.parametrize("name", ["ours", "real"])
def test_a_robot_comes_back_with_equal_kinematics_and_inertia(name, request, tmp_path):
    if name == "ours":
        urdf = shipped("robots", "turtlebot4", "turtlebot4.urdf")
        before, after, back = there_and_back(urdf, tmp_path, profile="diff-drive")
    else:
        urdf, asset, _ = request.getfixturevalue("real_robot")
        back = tmp_path / "back" / "robot.urdf"
        write_urdf(asset, back)
        before, after = read_description(urdf), read_description(back)
        assert len(after.links) == 49
    assert (after.name, after.root) == (before.name, before.root)
    assert_same_kinematics(urdf, before, after, back, 1e-12)
    assert_same_inertia(before, after)


def test_every_kind_of_joint_comes_back_with_its_figures(tmp_path):
    urdf = every(tmp_path)
    before, after, back = there_and_back(urdf, tmp_path)
    assert after.root == "foot"
    joints = {j.name: j for j in before.joints.values()}, {j.name: j for j in after.joints.values()}
    for name in ("j1", "j2", "j3", "j4", "j5", "j6", "j7"):
        one, two = (j[name] for j in joints)
        assert (one.type, one.parent, one.child) == (two.type, two.parent, two.child)
        assert_allclose(two.axis, one.axis / np.linalg.norm(one.axis), rtol=0, atol=1e-12)
        assert (one.limit is None) == (two.limit is None)
        if one.limit is not None:
            assert vars(two.limit) == vars(one.limit)
    assert vars(joints[1]["j1"].dynamics) == {"damping": 0.05, "friction": 0.1}
    assert vars(joints[1]["j4"].mimic) == {"joint": "j3", "multiplier": -1.5, "offset": 0.02}
    assert_same_inertia(before, after)
    assert_same_kinematics(urdf, before, after, back, 1e-12)


FOLLOWERS = {
    "fingers that close beyond 0": ("prismatic", (0.015, 0.03), "prismatic", (-0.03, -0.015), -1, 0),
    "a ratio with an offset": ("revolute", (-1, 0.5), "revolute", (-0.9, 2.1), -2, 0.1),
    "a slide by a turn": ("revolute", (0, 1.57), "prismatic", (-0.08, 0), -0.05, 0),
    "a turn by a slide": ("prismatic", (0, 0.05), "revolute", (-1.2, 0.1), -20.5, 0.02),
}
"""Type and range of a leader, and of its follower with multiplier and offset [rad or m]."""


@pytest.mark.parametrize("case", FOLLOWERS)
def test_limits_and_mimic_of_a_follower_are_authored_as_described_and_come_back(tmp_path, case):
    lead, led, kind, own, multiplier, offset = FOLLOWERS[case]
    text = f'<robot name="pair"><link name="a">{BODY}</link>'
    mimic = f'<mimic joint="lead" multiplier="{multiplier}" offset="{offset}"/>'
    for name, child, type_, range_, more in (("lead", "b", lead, led, ""), ("f", "c", kind, own, mimic)):
        limit = f'<limit lower="{range_[0]}" upper="{range_[1]}" effort="5" velocity="1"/>'
        text += f"""<link name="{child}">{INERTIAL}</link><joint name="{name}" type="{type_}">
        <parent link="a"/><child link="{child}"/><axis xyz="0 1 0"/>{limit}{more}</joint>"""
    path = tmp_path / "pair.urdf"
    path.write_text(f"{text}</robot>")
    before, after, back = there_and_back(path, tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "usd" / "robot.usda"))
    prim = stage.GetPrimAtPath("/pair/joints/f")
    ends = [prim.GetAttribute(f"physics:{end}Limit").Get() for end in ("lower", "upper")]
    assert_allclose(ends, np.array(own) * (1 if kind == "prismatic" else 180 / np.pi), rtol=1e-6)
    for one, two in zip(before.joints.values(), after.joints.values(), strict=True):
        assert vars(two.limit) == vars(one.limit)
    assert vars(after.joints["c"].mimic) == {"joint": "lead", "multiplier": multiplier, "offset": offset}
    assert_same_kinematics(path, before, after, back, 1e-12)


def test_shapes_come_back_where_they_were_in_their_colours(tmp_path):
    _, after, _ = there_and_back(every(tmp_path), tmp_path)
    (tube,), (box,) = after.links["arm"].visuals, after.links["arm"].collisions
    assert (tube.name, tube.geometry.radius, tube.geometry.length) == ("tube", 0.03, 0.4)
    assert_allclose(tube.material.rgba, (0.8, 0.1, 0.1, 1), atol=1e-3)
    assert_allclose(origin_of(tube)[:3, 3], (0.1, 0, 0.2), rtol=0, atol=1e-12)
    assert_allclose(box.geometry.size, (0.1, 0.2, 0.3), rtol=0, atol=1e-7)


def test_the_robot_of_a_scene_is_written_as_it_stands_in_its_own_frame(tmp_path):
    write_urdf(shipped("scenes", "lab", "lab.usda"), tmp_path / "robot.urdf")
    urdf = shipped("robots", "turtlebot4", "turtlebot4.urdf")
    after = read_description(tmp_path / "robot.urdf")
    assert_same_kinematics(urdf, read_description(urdf), after, tmp_path / "robot.urdf", 1e-12)


SMALL = """#usda 1.0
(defaultPrim = "World"; metersPerUnit = 1; upAxis = "Z")
def Xform "World" (prepend apiSchemas = ["PhysicsArticulationRootAPI"]) {
    def Xform "base_link" (
        prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]
        displayName = "NAME"
    ) {
        BODY
    }
    def Xform "wheel" (prepend apiSchemas = ["PhysicsRigidBodyAPI"]) {}
    def PhysicsRevoluteJoint "j" (prepend apiSchemas = ["PhysicsDriveAPI:angular"]) {
        rel physics:body0 = </World/base_link>
        rel physics:body1 = </World/wheel>
        JOINT
    }
    MORE
}
"""

MIMIC = "rel newton:mimicJoint = </World/k>"

LEADER = """def Xform "puck" (prepend apiSchemas = ["PhysicsRigidBodyAPI"]) {}
def PhysicsRevoluteJoint "k" (prepend apiSchemas = ["PhysicsLimitAPI:transX"]) {
    rel physics:body0 = </World/wheel>
    rel physics:body1 = </World/puck>
    HERE
}"""

MARKED = """def Mesh "m" (customData = {dictionary magtwin = {dictionary primitive = {FORM}}}) {
    point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]
    int[] faceVertexCounts = [3]
    int[] faceVertexIndices = [0, 1, 2]
}"""

BALL = """def Sphere "s" {
    color3f[] primvars:displayColor = [(1, 1, 1)]
    float[] primvars:displayOpacity = [OPACITY]
}"""


def small(tmp_path, **parts):
    """The URDF of a stage of two bodies and a joint, with text of a test at the words in capitals."""
    text = SMALL
    for part in ("NAME", "BODY", "JOINT", "MORE"):
        text = text.replace(part, parts.get(part, ""))
    (tmp_path / "small.usda").write_text(text, encoding="utf-8")
    write_urdf(tmp_path / "small.usda", tmp_path / "out" / "small.urdf")
    return ElementTree.parse(tmp_path / "out" / "small.urdf").getroot()


def inertial(figures):
    return {"BODY": f"float physics:mass = 1; {figures}"}


def marked(form):
    return {"BODY": MARKED.replace("FORM", form)}


def mimics(leader, more=""):
    return {"JOINT": MIMIC.replace("k>", f"{leader}>"), "MORE": more}


FREE = LEADER.replace("Revolute", "")


def joined(kind, ends):
    """Joints of a kind between pairs of bodies, which are made if they are no others of the stage."""
    made = {name for pair in ends for name in pair} - {"base_link", "wheel"}
    text = "".join(
        f'def Xform "{n}" (prepend apiSchemas = ["PhysicsRigidBodyAPI"]) {{}}\n' for n in sorted(made)
    )
    for i, (above, below) in enumerate(ends):
        text += f'def Physics{kind}Joint "k{i}" {{\nrel physics:body0 = </World/{above}>\n'
        text += f"rel physics:body1 = </World/{below}>\n}}\n"
    return {"MORE": text}


def scaled(scale):
    return {"BODY": f'float3 xformOp:scale = {scale}; uniform token[] xformOpOrder = ["xformOp:scale"]'}


REFUSED = [
    # no tree of links
    (joined("Spherical", [("wheel", "a")]), "URDF has no PhysicsSphericalJoint"),
    (joined("Fixed", [("base_link", "wheel")]), "'wheel' is held by two joints, in a circle"),
    (joined("Fixed", [("a", "b"), ("b", "a")]), "hold links in a circle: (a -> b -> a|b -> a -> b)"),
    (joined("Prismatic", [("wheel", "a")]), "k0>: slides without an end"),
    (scaled("(2, 2, 2)"), "is scaled, which a URDF cannot do to links"),
    (scaled("(1, 1, -1)"), "is scaled, .* or mirrored"),
    ({"JOINT": "point3f physics:localPos1 = (0.1, 0, 0)"}, "turns about a point of 'wheel' that is not its"),
    # of another type
    ({"JOINT": f'string newton:mimicCoef0 = "x"; {MIMIC}', "MORE": LEADER}, "newton:mimicCoef0 must be"),
    ({"JOINT": 'string newton:velocityLimit = "x"'}, "j>: newton:velocityLimit must be a number"),
    ({"JOINT": 'string newton:damping = "x"'}, "j>: newton:damping must be a number"),
    ({"JOINT": 'string drive:angular:physics:maxForce = "x"'}, "j>.* drive:angular:physics:maxForce"),
    ({"JOINT": 'string physics:lowerLimit = "x"'}, "j>.* physics:lowerLimit"),
    ({"BODY": 'string physics:mass = "x"'}, "base_link>.* physics:mass"),
    (inertial('string physics:diagonalInertia = "x"'), "base_link>.*diagonalInertia"),
    ({"MORE": FREE.replace("HERE", 'string limit:transX:physics:low = "x"')}, "low"),
    (marked('string kind = "a b"'), "m>: its customData magtwin:primitive is damaged"),
    (marked('string kind = "box"; double2 size = (1, 2)'), "is damaged"),
    (marked("string name = ''"), "is damaged"),
    # not finite
    ({"JOINT": "float newton:damping = nan"}, "j>: newton:damping is nan"),
    ({"JOINT": "float newton:friction = inf"}, 'j>: becomes <dynamics friction="inf">'),
    ({"JOINT": "float physics:lowerLimit = nan"}, "j>: physics:lowerLimit is nan"),
    ({"JOINT": "point3f physics:localPos0 = (0, inf, 0)"}, "j>: .*localPos0 is .0, inf, 0. .* not a frame"),
    ({"JOINT": "quatf physics:localRot1 = (0, 0, 0, 0)"}, "j>: .*localRot1 .0, 0, 0, 0., not a frame"),
    ({"BODY": "float physics:mass = nan"}, "base_link>: physics:mass is nan"),
    ({"BODY": "float physics:mass = inf"}, 'base_link>: becomes <mass value="inf">'),
    ({"BODY": "double physics:mass = 1e300"}, 'base_link>: becomes <mass value="inf">'),
    (inertial("point3f physics:centerOfMass = (nan, 0, 0)"), "base_link>: physics:centerOfMass is .nan"),
    (inertial("float3 physics:diagonalInertia = (1, 1, inf)"), "base_link>: becomes <inertia"),
    (
        {"BODY": 'double3 xformOp:translate = (nan, 0, 0); token[] xformOpOrder = ["xformOp:translate"]'},
        "finite",
    ),
    ({"BODY": BALL.replace("OPACITY", "nan")}, "s>: becomes <color rgba="),
    (marked('string kind = "sphere"; double radius = nan'), "m>: becomes <sphere radius"),
    # a mimic needs another joint to follow
    (mimics("k"), "j>: newton:mimicJoint must point to one prim of the stage, found /World/k"),
    (mimics("wheel"), "j>: mimics </World/wheel>, not a joint of the robot"),
    (mimics("k", LEADER.replace("Revolute", "Fixed")), "j>: mimics </World/k>, not a joint of the robot"),
    (mimics("j"), "joints mimic in a circle: j -> j"),
    (mimics("k", LEADER.replace("HERE", "rel newton:mimicJoint = </World/j>")), "circle: j -> k -> j"),
]


@pytest.mark.parametrize(("parts", "words"), REFUSED)
def test_a_stage_of_impossible_values_is_refused_by_prim_and_name_and_nothing_is_written(
    tmp_path, parts, words
):
    with pytest.raises(InputError, match=words):
        small(tmp_path, **{part: text.replace("HERE", "") for part, text in parts.items()})
    assert not (tmp_path / "out").exists()


def test_a_stage_without_a_robot_is_refused(tmp_path):
    with pytest.raises(InputError, match="a URDF has one articulation, found none"):
        write_urdf(shipped("maps", "lab", "lab.usdc"), tmp_path / "out" / "a.urdf")


def test_a_mimic_names_its_leader_as_the_urdf_does_even_if_prims_share_a_name(tmp_path):
    more = LEADER.replace("HERE", "").replace('"k" (', '"k" (displayName = "j"; ')
    xml = small(tmp_path, JOINT=f"{MIMIC}; float newton:mimicCoef1 = 2", MORE=more)
    assert [joint.get("name") for joint in xml.iter("joint")] == ["j", "j_2"]
    assert xml.find("joint/mimic").attrib == {"joint": "j_2", "multiplier": "2", "offset": "0"}


@pytest.mark.parametrize("name", ["a\\x01b", "a\\x1b[31m", "a\ufffe", "\u202eknil", "a\\nb", ""])
def test_a_display_name_that_cannot_be_printed_gives_way_to_the_name_of_the_prim(tmp_path, name):
    assert small(tmp_path, NAME=name).find("link").get("name") == "base_link"


@pytest.mark.parametrize("limit", ["", "-inf", "None"])
def test_a_joint_without_a_limit_turns_on_and_on(tmp_path, limit):
    xml = small(tmp_path, JOINT=limit and f"float physics:lowerLimit = {limit}; float physics:upperLimit = 3")
    assert xml.find("joint").get("type") == "continuous"
    assert xml.find("joint/limit") is None


def test_the_command_converts_both_ways_and_lists_what_is_left_out(tmp_path, capfd):
    out = tmp_path / "back.urdf"
    words = ["robot", str(shipped("robots", "turtlebot4", "turtlebot4.usda")), "--out", str(out)]
    main([*words, "--json"])
    said = json.loads(capfd.readouterr().out)
    assert said["figures"]["links"] == len(read_description(out).links)
    assert "MagtwinMagnetometerAPI" in said["metadata"]["notes"][0]
    with pytest.raises(SystemExit):
        main(
            [
                "robot",
                str(shipped("robots", "turtlebot4", "turtlebot4.usda")),
                "--out",
                str(out),
                "--fix-base",
            ]
        )
    assert "without other options than --force" in capfd.readouterr().err
