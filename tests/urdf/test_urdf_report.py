"""The report of a conversion: what it says is what stands on the stage, and strict ones refuse losses."""

import json

import numpy as np
import pytest
import trimesh
from made import INERTIAL, converted, urdf
from numpy.testing import assert_allclose
from pxr import Usd, UsdGeom, UsdPhysics

from magtwin.errors import InputError
from magtwin.files.file import sha256
from magtwin.frames import matrix_from_quat, quat_from_rpy
from magtwin.urdf.convert import convert_with_report
from magtwin.urdf.options import Options

ARM = """<link name="base_link">{BODY}</link><link name="hand">{BODY}</link><link name="tip"/>
<joint name="j" type="revolute"><parent link="base_link"/><child link="hand"/><origin xyz="0.3 0 0"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="3" velocity="2"/></joint>
<joint name="t" type="fixed"><parent link="hand"/><child link="tip"/><origin xyz="0 0 0.2"/></joint>"""


def convert(path, **choices):
    return converted(path, **choices)[2]


def one_shape(tmp_path, shape, origin=""):
    """The line of the only visual of a robot."""
    path = urdf(
        tmp_path,
        f'<link name="base_link">{INERTIAL}<visual>{origin}<geometry>{shape}</geometry></visual></link>',
    )
    report = convert(path)
    (line,) = report.geometries
    assert not report.losses
    return line


def test_every_link_joint_and_shape_has_its_line_and_its_prim(tmp_path):
    path = urdf(tmp_path, ARM)
    report = convert(path)
    assert [(line.name, line.became, line.mass_in_kg, line.mass_out_kg) for line in report.links] == [
        ("base_link", "body", 1, 1),
        ("hand", "body", 1, 1),
        ("tip", "frame", None, None),
    ]
    assert (report.mass_in_kg, report.mass_out_kg) == (2, 2)
    assert [(j.name, j.type_in, j.type_out) for j in report.joints] == [
        ("j", "revolute", "PhysicsRevoluteJoint"),
        ("t", "fixed", ""),
    ]
    assert [(g.link, g.role, g.index, g.shape) for g in report.geometries] == [
        (link, role, 0, "sphere") for link in ("base_link", "hand") for role in ("visual", "collision")
    ]
    stage = Usd.Stage.Open(str(path.with_suffix(".usda")))
    named = [line.prim for line in report.links] + [report.joints[0].prim]
    named += [prim for line in report.geometries for prim in line.prims]
    assert all(stage.GetPrimAtPath(prim) for prim in named)
    assert not report.losses
    assert report.source_sha256 == sha256(path)


def test_a_density_adds_mass_and_that_is_no_loss(tmp_path):
    bare = '<link name="base_link"><collision><geometry><box size="1 1 1"/></geometry></collision></link>'
    report = convert(urdf(tmp_path, bare), density=10.0)
    assert report.mass_in_kg == 0
    assert not report.losses


@pytest.mark.parametrize(
    ("shape", "half"),
    [
        ('<box size="0.2 0.4 0.6"/>', (0.1, 0.2, 0.3)),
        ('<sphere radius="0.3"/>', (0.3, 0.3, 0.3)),
        ('<cylinder radius="0.1" length="0.8"/>', (0.1, 0.1, 0.4)),
        ('<capsule radius="0.1" length="0.8"/>', (0.1, 0.1, 0.5)),
    ],
)
def test_boxes_of_primitives_are_their_closed_forms_in_and_out(tmp_path, shape, half):
    line = one_shape(tmp_path, shape, '<origin xyz="1 2 3"/>')
    want = np.array([1, 2, 3]) + np.outer([-1, 1], half)
    assert_allclose(line.box_in, want, atol=1e-9)
    assert_allclose(line.box_out, want, atol=1e-6)
    assert line.kept


@pytest.mark.parametrize("shape", ["box", "cylinder", "capsule"])
def test_boxes_of_turned_primitives_bound_their_surface_as_densely_sampled(tmp_path, shape):
    words = {"box": 'size="0.2 0.4 0.6"', "cylinder": 'radius="0.1" length="0.8"'}
    line = one_shape(
        tmp_path,
        f"<{shape} {words.get(shape, words['cylinder'])}/>",
        '<origin xyz="1 0 0" rpy="0.4 0.7 1.1"/>',
    )
    made = {
        "box": trimesh.creation.box((0.2, 0.4, 0.6)),
        "cylinder": trimesh.creation.cylinder(0.1, 0.8, sections=2000),
        "capsule": trimesh.creation.capsule(0.8, 0.1, count=(200, 200)),
    }[shape]
    points = made.vertices - made.bounds.mean(0)
    placed = points @ matrix_from_quat(quat_from_rpy([0.4, 0.7, 1.1])).T + [1, 0, 0]
    assert_allclose(line.box_in, [placed.min(0), placed.max(0)], atol=2e-5)  # of the sampling
    assert line.kept  # a polygon of 32 sides stands for the circle


def test_the_box_of_a_mesh_is_that_of_its_file_as_trimesh_reads_it(tmp_path):
    mesh = trimesh.creation.icosphere(radius=0.2)
    mesh.apply_translation([0.5, 0, 0])
    mesh.export(tmp_path / "ball.stl")
    line = one_shape(tmp_path, '<mesh filename="ball.stl" scale="2 1 -1"/>', '<origin rpy="0 0 1.5707963"/>')
    scaled = mesh.vertices * [2, 1, -1]
    placed = scaled @ matrix_from_quat(quat_from_rpy([0, 0, 1.5707963])).T
    assert_allclose(line.box_in, [placed.min(0), placed.max(0)], atol=1e-6)
    assert line.kept
    assert line.shape == "ball.stl"


def test_what_rides_on_another_body_keeps_its_place_and_its_line(tmp_path):
    report = convert(urdf(tmp_path, ARM.replace('type="revolute"', 'type="fixed"')), merge_fixed=True)
    became = {line.name: line.became for line in report.links}
    assert became == {"base_link": "body", "hand": "merged", "tip": "frame"}
    (hand,) = (g for g in report.geometries if (g.link, g.role) == ("hand", "visual"))
    assert_allclose(hand.box_out, [[0.2, -0.1, -0.1], [0.4, 0.1, 0.1]], atol=1e-6)
    assert not report.losses
    assert (report.mass_in_kg, report.mass_out_kg) == (2, 2)


def spoil(what):
    """A `finish` that changes the stage behind the converter's back."""

    def finish(robot):
        stage, hand = robot.GetStage(), robot.GetPrimAtPath("hand")
        if what == "moved":
            UsdGeom.XformCommonAPI(hand.GetPrimAtPath("visuals")).SetTranslate((0, 0, 0.5))
        elif what == "gone":
            stage.RemovePrim(hand.GetPath().AppendPath("visuals"))
        else:
            UsdPhysics.MassAPI(hand).GetMassAttr().Set(0.5)
        return ()

    return finish


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("moved", r"visual 0 of link 'hand' \(sphere\) changed its box by 0\.5 m"),
        ("gone", r"visual 0 of link 'hand' \(sphere\) did not arrive"),
        ("light", r"mass 2 kg became 1\.5 kg"),
    ],
)
def test_a_changed_stage_is_detected(tmp_path, what, message):
    path = urdf(tmp_path, ARM)
    with pytest.raises(InputError, match=message):
        convert_with_report(path, path.with_suffix(".usda"), options=Options(strict=True), finish=spoil(what))
    assert not path.with_suffix(".usda").exists()


def test_a_follower_that_rests_beside_0_is_where_it_belongs(tmp_path):
    text = ARM.replace('<link name="tip"/>', '<link name="tip">{BODY}</link>').replace(
        'name="t" type="fixed">',
        'name="t" type="prismatic"><mimic joint="j" offset="0.05"/>'
        '<limit lower="0" upper="0.1" effort="1" velocity="1"/>',
    )
    report = convert(urdf(tmp_path, text), strict=True)
    tip = next(line for line in report.geometries if line.link == "tip")
    assert tip.box_in is not None
    assert_allclose(tip.box_in[0], [0.25, -0.1, 0.1], atol=1e-9)  # the slide along x is 0.05 m out


def test_the_json_of_a_report_holds_all_of_it(tmp_path):
    report = convert(urdf(tmp_path, f'{ARM}<gazebo reference="hand"><maxVel>1</maxVel></gazebo>'))
    metadata = json.loads(report.to_json())
    assert metadata["unknown_tags"] == {"gazebo/maxVel": 1}
    assert metadata["links"][1] == {
        "name": "hand",
        "became": "body",
        "prim": "/arm/hand",
        "mass_in_kg": 1.0,
        "mass_out_kg": 1.0,
    }
    assert metadata["geometries"][0]["box_out"] == [list(corner) for corner in report.geometries[0].box_out]
    assert set(metadata) == set(vars(report))


def test_the_summary_has_the_main_numbers(tmp_path):
    summary = convert(urdf(tmp_path, ARM)).summary()
    figures = {figure.name: figure.value for figure in summary.figures}
    assert (figures["links"], figures["joints"], figures["shapes"], figures["mass"]) == (3, 2, 4, 2)
    assert figures["size"] == "0.500 x 0.200 x 0.200"
    assert summary.title == "arm: arm.urdf -> arm.usda"


def test_every_shape_of_the_real_robot_arrives_in_its_box(real_robot, tagged_robot):
    for (path, _, report), lost in ((real_robot, 0), (tagged_robot, 2)):
        missing = [line for line in report.geometries if not line.kept]
        assert all(line.box_in is None and line.shape in ("shell.dae", "oakd_pro.dae") for line in missing)
        assert len(missing) == lost
        (lidar,) = (g for g in report.geometries if g.shape == "rplidar.dae")
        assert lidar.kept  # the mesh that a malformed colour made others drop
        assert_allclose(report.mass_out_kg, 5.39, atol=1e-6)
        assert max(line.error_m for line in report.geometries if line.kept) < 1e-3
        assert path.name == report.source


def test_the_mesh_boxes_of_the_real_robot_are_those_that_trimesh_reads(real_robot):
    path, _, report = real_robot
    looked = 0
    for line in report.geometries:
        file = path.parent / "meshes" / line.shape
        if line.role == "visual" and file.suffix == ".dae" and line.shape != "rplidar.dae":
            looked += 1
            seen = trimesh.load(file, force="scene").to_geometry()  # nodes composed as trimesh composes them
            size = np.sort(seen.bounds[1] - seen.bounds[0])
            assert_allclose(np.sort(np.subtract(*line.box_in[::-1])), size, atol=2e-5)
    assert looked >= 5
