"""Each fault of a description: repaired by default, counted with its line, and refused by strict."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from places import TESTS
from scipy.optimize import nnls

from magtwin.errors import InputError
from magtwin.urdf.convert import convert_with_report
from magtwin.urdf.options import Options
from magtwin.urdf.physics.inertia import SLIMMEST, nearest_possible
from magtwin.urdf.repairs import FAULTS

HEAD = '<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">'
BASE = '<link name="base"><inertial><mass value="2"/>{}</inertial>{}</link>'
TENSOR = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
GOOD = BASE.format(TENSOR, "")
HAND = GOOD.replace("base", "hand")
TIP = GOOD.replace("base", "tip")


def look(content, role="visual"):
    return BASE.format(TENSOR, f"<{role}>{content}</{role}>")


RED = '<material name="m"><color rgba="1 0 0 1"/></material>'
BALL = '<geometry><sphere radius="0.1"/></geometry>'


def joint(kind, content="", name="j", child="hand", parent="base"):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}\n<axis xyz="0 0 1"/>{content}</joint>'


def moving(kind, content=""):
    return f"{GOOD}\n{HAND}\n{joint(kind, content)}"


def follower(mimic, lead='<limit lower="-1" upper="1" effort="1" velocity="1"/>', kind="revolute"):
    range_ = '<limit lower="-1" upper="1" effort="1" velocity="1"/>'
    return "\n".join(
        [GOOD, HAND, TIP, joint(kind, lead), joint("revolute", f"{range_}{mimic}", "f", "tip", "hand")]
    )


def sensor(kind, content):
    start = f'{GOOD}\n<gazebo reference="base">\n<sensor name="s" type="{kind}"><update_rate>5</update_rate>'
    return f"{start}{content}</sensor></gazebo>"


SCAN = """<ray><scan><horizontal><samples>9</samples><min_angle>{}</min_angle><max_angle>{}</max_angle>
</horizontal></scan><range><min>{}</min><max>{}</max></range></ray>"""
EYE = """<camera><horizontal_fov>{}</horizontal_fov><image><width>{}</width><height>48</height></image>
<clip><near>{}</near><far>{}</far></clip></camera>"""


def held(hand):
    return f"{GOOD}\n{hand}\n{joint('fixed')}"


def limited(figures):
    return moving("revolute", f"<limit {figures}/>")


def tagged(content):
    return f'{GOOD}\n<gazebo reference="base">{content}</gazebo>'


def meshed(filename, role="visual"):
    return look(f'<geometry><mesh filename="{filename}"/></geometry>', role)


def included(filename):
    return f'{GOOD}\n<xacro:include filename="{filename}"/>'


def wheels(*, axis="0 0 1", more="", **names):
    """A base with two wheels and a plugin that drives some, in line 9."""
    tags = "".join(f"<{side}_joint>{name}</{side}_joint>" for side, name in names.items())
    plugin = f'<gazebo><plugin name="diff_drive">{tags}{more}</plugin></gazebo>'
    robot = f"{moving('continuous')}\n{TIP}\n{joint('continuous', name='k', child='tip')}\n{plugin}"
    return robot.replace("0 0 1", axis)


NOISE = """<imu><linear_acceleration><x><noise type="gaussian"><stddev>{}</stddev></noise></x>
</linear_acceleration></imu>"""

FAULTY = {
    "inertia-impossible": [
        (BASE.format(TENSOR.replace('izz="1"', 'izz="9"'), ""), 2, "no body has principal moments"),
        (BASE.format(TENSOR.replace('ixx="1"', 'ixx="-1"'), ""), 2, "-1, 1, 1 kg m2: the nearest possible"),
    ],
    "inertia-missing": [
        (BASE.format(TENSOR.replace("1", "0"), ""), 2, "that of a ball of water"),
        (BASE.format("", f"<collision>{BALL}</collision>"), 2, "that of its colliders"),
    ],
    "inertia-unreadable": [(BASE.format(TENSOR.replace('ixx="1"', 'ixx="big"'), ""), 2, "counts as none")],
    "mass-invalid": [
        (held(HAND.replace('"2"', '"-2"')), 3, "a mass of -2"),
        (held(HAND.replace('<mass value="2"/>', "")), 3, "no mass counts as none"),
    ],
    "mimic-leader": [
        (follower('<mimic joint="jj"/>'), 7, "no joint 'jj' (did you mean 'j'?): the mimic is left out"),
        (follower('<mimic joint="f"/>'), 7, "mimics itself: f -> f"),
        (follower('<mimic multiplier="2"/>'), 8, "a <mimic> without joint= is left out"),
        (follower('<mimic joint="j"/>', "", "planar"), 7, "'j', which is planar"),
    ],
    "mimic-fixed": [
        (follower('<mimic joint="j"/>', "", "fixed"), 7, "'j', which is fixed: it is fixed at its offset"),
        (follower('<mimic joint="j" multiplier="0"/>'), 7, "'j', which is taken 0 times"),
    ],
    "limit-missing": [
        (moving("revolute"), 4, "is revolute without limits"),
        (moving("prismatic", '<limit effort="1" velocity="1"/>'), 5, "is prismatic without limits"),
    ],
    "limit-one-end": [(limited('upper="1" effort="1" velocity="1"'), 5, "no lower limit")],
    "limit-zeros": [
        (limited('lower="0" upper="0" effort="0" velocity="0"'), 5, "range, effort and velo"),
        (limited('lower="-180" upper="180" effort="0" velocity="0"'), 5, "of 360 rad"),
        (limited('lower="-1" upper="1" effort="0" velocity="0"'), 5, "it moves within it"),
    ],
    "limit-swapped": [(limited('lower="1" upper="-1" effort="1" velocity="1"'), 5, "above its upper -1")],
    "limit-ignored": [(moving("continuous", '<limit lower="-1" upper="1"/>'), 5, "which has no range")],
    "effort-invalid": [(limited('lower="0" upper="1" effort="-1" velocity="1"'), 5, "effort -1 of <limit>")],
    "sensor-range": [
        (sensor("ray", SCAN.format(-3.1416, 3.1416, 0.1, 9)), 4, "become -3.1416 to 3.141585"),
        (sensor("ray", SCAN.format(1, -1, 0.1, 9)), 4, "from 1 to -1 rad become -1 to 1"),
        (sensor("ray", SCAN.format(-1, 1, 9, 0.1)), 4, "is read in the other order"),
        (sensor("camera", EYE.format(3.2, 64, 0.1, 9)), 4, "horizontal_fov of 3.2 rad is reduced"),
        (sensor("camera", EYE.format(1, "1e9", 0.1, 9)), 4, "pixels becomes 65536 x 48"),
        (sensor("imu", "<pose>1 2 3</pose>"), 4, "its pose is not x y z roll pitch yaw"),
        (sensor("imu", '<pose relative_to="world">0 0 0 0 0 0</pose>'), 4, "is relative to 'world'"),
    ],
    "sensor-missing": [
        (sensor("camera", ""), 4, "has no <camera>: kept as a frame with its type and rate"),
        (sensor("ray", SCAN.format(-1, 1, 1, 1)), 4, "its range from 1 to 1.0 m is empty"),
        (sensor("ray", SCAN.replace(">9<", ">1e300<").format(-1, 1, 0.1, 9)), 4, "rays, over 2000000"),
    ],
    "number-range": [
        (look('<geometry><sphere radius="-0.1"/></geometry>'), 2, "used without its sign"),
        (look(f'<origin quat_xyzw="0 0 1 1"/>{BALL}'), 2, "has length 1.414 in '0 0 1 1': scaled to 1"),
        (moving("revolute", '<limit lower="0" upper="1"/><dynamics damping="-1"/>'), 5, "raised to it"),
        (look(f'{BALL}<material name="m"><color rgba="255 0 0 1"/></material>'), 2, "reduced to it"),
        (tagged("<mu1>-1</mu1>"), 3, "mu1 -1 is below 0: raised to it"),
        (sensor("imu", NOISE.format("-0.3")), 4, "stddev -0.3 is below 0: raised to it"),
        (wheels(left="j", right="k", more="<wheel_radius>0</wheel_radius>"), 9, "wheel_radius 0 is not"),
    ],
    "number-count": [
        (look(f'<origin xyz="1 2 3 0"/>{BALL}'), 2, "has 4 numbers in '1 2 3 0': read as 1 2 3"),
        (look(f'<origin rpy="0"/>{BALL}'), 2, "read as 0 0 0"),
        (look('<geometry><box size="0.1"/></geometry>'), 2, "read as 0.1 0.1 0.1"),
        (look(f'{BALL}<material name="m"><color rgba="1 0 0"/></material>'), 2, "completed by 1"),
    ],
    "number-unreadable": [
        (moving("continuous", '<dynamics damping="soft"/>'), 5, "damping of <dynamics> must be a finite"),
        (look(f'{BALL}<material name="m"><color rgba="red"/></material>'), 2, "rgba of <color> must be"),
        (tagged("<selfCollide>maybe</selfCollide>"), 3, "true or false"),
        (tagged("<mu1>slippery</mu1>"), 3, "mu1 must be a finite number, not 'slippery'"),
    ],
    "element-unknown": [
        (BASE.format(TENSOR, "<colision/>"), 2, "<colision> in <link> is unknown (did you mean 'coll"),
        (look('<geometry><cylindre radius="1"/></geometry>'), 2, "(did you mean 'cylinder'?)"),
        (f"{GOOD}\n<transmision/>", 3, "<transmision> in <robot> is unknown (did you mean 'transmission'?)"),
    ],
    "attribute-unknown": [
        (limited('lower="-1" upper="1" efort="1"'), 5, "efort='1' of <limit> is unknown (d"),
        (look(f'<origin ypr="0 0 1"/>{BALL}'), 2, "link 'base': ypr='0 0 1' of <origin> is unknown: kept"),
        (f'{GOOD}\n<material name="m" colour="red"><color rgba="1 0 0 1"/></material>', 3, "colour='red'"),
    ],
    "turn-twice": [(look(f'<origin rpy="0 0 1" quat_xyzw="0 0 0 1"/>{BALL}'), 2, "quat_xyzw is used")],
    "tag-twice": [(look(BALL.replace("</", '<box size="1 1 1"/></')), 2, "a second <box> in <geometry>")],
    "tag-misplaced": [
        (look(BALL.replace("</", f"{RED}</")), 2, "<material> moved into the <material> of its visual"),
        (look(f'{BALL}<color rgba="1 0 0 1"/>'), 2, "<color> moved"),
    ],
    "tag-empty": [
        (look(f'{BALL}<material name="m"><texture/></material>'), 2, "a <texture> without filename="),
        (look(f'{BALL}<material name="m"><color/></material>'), 2, "a <color> without rgba="),
        (f'<material><color rgba="1 0 0 1"/></material>\n{GOOD}', 0, "of the robot without name="),
    ],
    "shape-missing": [
        (look("<origin/>"), 2, "a <visual> without <geometry>"),
        (look("<geometry/>", "collision"), 2, "a <geometry> without a shape"),
        (look('<geometry><cylindre radius="1"/></geometry>'), 2, "a <geometry> without a shape"),
        (look("<geometry><mesh/></geometry>"), 2, "a <mesh> without filename="),
        (look("<geometry><sphere/></geometry>"), 2, "a <sphere> without radius="),
    ],
    "shape-empty": [(look('<geometry><box size="0 0 0"/></geometry>'), 2, "a visual box of size 0")],
    "material-twice": [
        (f"{RED}\n{RED}\n{GOOD}", 2, "twice, alike"),
        (f"{RED}\n{RED.replace('1 0 0 1', '0 1 0 1')}\n{GOOD}", 2, "twice, with two looks"),
    ],
    "name-twice": [(f"{GOOD}\n{GOOD}", 3, "'base' exists twice, first at arm.urdf:2: the second is equal")],
    "name-unknown": [
        (f'{GOOD}\n<transmission name="t"><joint name="nobody"/></transmission>', 3, "no joint 'nobody'"),
        (f'{GOOD}\n<ros2_control name="c"><joint name="jj"/></ros2_control>', 3, "no joint 'jj'"),
        (f"{held(HAND)}\n{joint('fixed', '', 'k', 'arm')}", 6, "leads to no link 'arm'"),
        (f'{GOOD}\n<gazebo reference="bas"/>', 3, "'bas', which is no link or joint (did you mean 'base'?)"),
        (
            f"{moving('continuous')}\n<gazebo reference='j'>\n<sensor name='s' type='imu'/></gazebo>",
            7,
            "sensor 's' of link 'j', which is no link",
        ),
    ],
    "name-missing": [(f"{GOOD}", 1, "<robot> has no name: 'arm', as its file")],
    "mesh-missing": [
        (meshed("nowhere.stl"), 2, "a box of 0.05 x 0.05 x 0.05 m"),
        (meshed("package://absent/a.stl"), 2, "a box of"),
        (meshed("https://example.com/a.stl"), 2, "a box of"),
    ],
    "mesh-unreadable": [
        (meshed("broken.stl"), 2, "cannot be read (broken.stl: "),
        (meshed("a.step"), 2, "no known format"),
    ],
    "mesh-flat": [(meshed("flat.stl", "collision"), 2, "as a plate 0.0071 m")],
    "file-name": [
        (meshed("parts/box.stl"), 2, "'parts/box.stl' is read as '"),
        (meshed("package:///arms/flat.stl"), 2, "is read as '"),
    ],
    "drive-incomplete": [
        (wheels(left="jj", right="j"), 9, "<left_joint>: no joint 'jj'; did you mean 'j'"),
        (wheels(left="j"), 9, "the drive plugin has no <right_joint>: the drive is kept as text"),
        (wheels(left="j", right="k", axis="0 1 0"), 9, "needs wheels on the left (y > 0) and right"),
    ],
    "package-missing": [
        (
            f"{GOOD}\n<gazebo><plugin><parameters>$(find absent)/c.yaml</parameters></plugin></gazebo>",
            3,
            "$(find absent): no such package",
        )
    ],
    "include-renamed": [(included("eye.xacro"), 3, "'eye.xacro' is missing: eye.urdf.xacro beside it")],
    "include-skipped": [(included("$(find absent)/eye.xacro"), 3, "eye.xacro' is missing: skipped")],
}
"""Descriptions with one fault: the text, its line (0 if it has none), and a part of the report's text."""

CASES = [(kind, number) for kind, cases in FAULTY.items() for number in range(len(cases))]


def write(tmp_path, kind, number):
    text, line, told = FAULTY[kind][number]
    head = HEAD.replace(' name="arm"', "") if kind == "name-missing" else HEAD
    xacro = kind in ("package-missing", "include-renamed", "include-skipped")
    folder = tmp_path / "arms"
    folder.mkdir()
    (folder / "package.xml").write_text("<package><name>arms</name></package>")
    (folder / "parts").mkdir()
    trimesh.creation.box().export(folder / "parts" / "box.stl")
    (folder / "broken.stl").write_bytes(b"no triangles")
    (folder / "a.step").write_bytes(b"")
    (folder / "eye.urdf.xacro").write_text("<robot/>")
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    flat.export(folder / "flat.stl")
    path = folder / ("urdf/arm.urdf" if "parts/" in text else "arm.urdf.xacro" if xacro else "arm.urdf")
    path.parent.mkdir(exist_ok=True)
    path.write_text(f"{head}\n{text}\n</robot>\n")
    return path, line, told


def test_every_fault_has_a_description():
    assert FAULTY.keys() == FAULTS.keys()


def test_the_documentation_names_every_fault():
    text = (TESTS.parent / "docs" / "urdf.md").read_text(encoding="utf-8")
    for kind, (fault, done) in FAULTS.items():
        assert f"| `{kind}` | {fault} | {done} |" in text


@pytest.mark.parametrize(("kind", "number"), CASES)
def test_a_fault_is_repaired_and_counted_and_strict_refuses_it(tmp_path, kind, number):
    path, line, told = write(tmp_path, kind, number)
    report = convert_with_report(
        path, tmp_path / "a" / "arm.usda", options=Options(skip_missing_includes=True)
    )
    (entry,) = [entry for row in report.repairs if row.kind == kind for entry in row.entries]
    assert told in entry.text
    assert (entry.file, entry.line) == ((path.name, line) if line else ("", 0))
    assert [row.count for row in report.repairs if row.kind == kind] == [1]
    assert entry.text in report.notes
    place = f"{path.name}:{line}: " if line else ""
    with pytest.raises(InputError) as refusal:
        convert_with_report(
            path, tmp_path / "b" / "arm.usda", options=Options(strict=True, skip_missing_includes=True)
        )
    assert f"{place}{entry.text}" in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert not list((tmp_path / "b").iterdir())


def test_strict_names_all_faults_and_the_options_that_supply_what_is_missing(tmp_path):
    shapes = "".join(
        f'<visual><geometry><mesh filename="package://{name}/a.stl"/></geometry></visual>' for name in "xy"
    )
    path = tmp_path / "arm.urdf"
    path.write_text(f"{HEAD}\n{BASE.format(TENSOR, '<colision/>' + shapes)}\n</robot>")
    with pytest.raises(InputError) as refusal:
        convert_with_report(path, tmp_path / "arm.usda", options=Options(strict=True))
    for part in ("package://x/a.stl", "package://y/a.stl", "--package x=FOLDER --package y=FOLDER"):
        assert part in str(refusal.value)
    report = convert_with_report(path, tmp_path / "arm.usda")
    assert report.supply == "--package x=FOLDER --package y=FOLDER"
    shown = {figure.name: (figure.value, figure.note) for figure in report.summary().figures}
    fault, done = FAULTS["mesh-missing"]
    assert shown[fault] == (2, f"{done}: arm.urdf:2")


def test_what_a_xacro_lacks_is_listed_in_one_run(tmp_path):
    path = tmp_path / "arm.xacro"
    lines = [
        '<xacro:include filename="$(find lidars)/lidar.xacro"/>',
        '<xacro:include filename="eye.xacro"/>',
        '<xacro:lidar name="$(arg prefix)lidar"/>',
        '<link name="$(env HAND)"/>',
    ]
    path.write_text("\n".join([HEAD, *lines, "</robot>"]))
    wanted = [
        "include 'package://lidars/lidar.xacro' (arm.xacro:2)",
        "include 'eye.xacro' (arm.xacro:3)",
        "macro 'xacro:lidar' (arm.xacro:4)",
        "environment variable 'HAND', which is not read (arm.xacro:5)",
        "give --package lidars=FOLDER --arg HAND=VALUE",
    ]
    for skip in (False, True):
        with pytest.raises(InputError) as refusal:
            convert_with_report(path, tmp_path / "arm.usda", options=Options(skip_missing_includes=skip))
        for text in wanted:
            assert text in str(refusal.value)


def test_packages_of_ros_are_found_by_the_name_in_the_description_and_only_so(tmp_path, monkeypatch):
    box = trimesh.creation.box()
    for folder in ("install/share/hands", "install/share/other"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "package.xml").write_text("<package/>")
        box.export(tmp_path / folder / "a.stl")
    path = tmp_path / "here" / "deep" / "er" / "still" / "arm.urdf"
    path.parent.mkdir(parents=True)
    path.write_text(f"{HEAD}\n{meshed('package://hands/a.stl')}\n</robot>")
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path}/none:{tmp_path}/install")
    assert not convert_with_report(path, tmp_path / "arm.usda").repairs
    outside = tmp_path / "install" / "share" / "other" / "a.stl"
    path.write_text(f"{HEAD}\n{meshed(outside)}\n</robot>")
    with pytest.raises(InputError, match="lies outside"):
        convert_with_report(path, tmp_path / "b.usda")


def test_a_folder_of_meshes_beside_a_folder_urdf_is_read_and_nothing_else_there(tmp_path):
    (tmp_path / "urdf").mkdir()
    for folder in ("meshes", "secret"):
        (tmp_path / folder).mkdir()
        trimesh.creation.box().export(tmp_path / folder / "a.stl")
    path = tmp_path / "urdf" / "arm.urdf"
    path.write_text(f"{HEAD}\n{meshed('../meshes/a.stl')}</robot>")
    assert not convert_with_report(path, tmp_path / "a.usda").repairs
    path.write_text(path.read_text().replace("../meshes", "../secret"))
    with pytest.raises(InputError, match="lies outside"):
        convert_with_report(path, tmp_path / "b.usda")


def test_a_placeholder_has_the_box_of_the_other_shapes_of_its_link(tmp_path):
    lost = '<visual><origin xyz="5 5 5"/><geometry><mesh filename="lost.stl"/></geometry></visual>'
    shown = '<collision><origin xyz="0 0 1"/><geometry><box size="0.2 0.4 0.6"/></geometry></collision>'
    path = tmp_path / "arm.urdf"
    path.write_text(f'{HEAD}\n<link name="base">{shown}{lost}</link>\n</robot>')
    (low, high) = convert_with_report(path, tmp_path / "a" / "arm.usda").box_out
    assert_allclose([low, high], [[-0.1, -0.2, 0.7], [0.1, 0.2, 1.3]], atol=1e-6)


@given(st.lists(st.floats(-1, 1), min_size=6, max_size=6))
def test_the_nearest_possible_tensor_is_possible_and_no_other_is_nearer(values):
    xx, yy, zz, xy, xz, yz = values
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    nearest = nearest_possible(tensor)
    moments = np.linalg.eigvalsh(tensor)
    second, _ = nnls(np.ones((3, 3)) - np.eye(3), moments)  # a peer: SciPy's non-negative least squares
    peer = (np.ones((3, 3)) - np.eye(3)) @ second
    if nearest is None:
        assert peer.max() < 1e-9
        return
    made = np.linalg.eigvalsh(nearest)
    assert_allclose(made, np.maximum(peer, SLIMMEST * peer.max()), atol=1e-7)
    again = nearest_possible(nearest)
    assert again is nearest or np.allclose(again, nearest, rtol=1e-5)
