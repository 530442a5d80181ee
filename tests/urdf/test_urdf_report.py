"""The report of a conversion: what it says is what stands on the stage."""

import json

import numpy as np
import pytest
import trimesh
from made import INERTIAL, converted, urdf
from numpy.testing import assert_allclose
from pxr import Usd

from magtwin.files.file import sha256

ARM = """<link name="base_link">{BODY}</link><link name="hand">{BODY}</link><link name="tip"/>
<joint name="j" type="revolute"><parent link="base_link"/><child link="hand"/><origin xyz="0.3 0 0"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="3" velocity="2"/></joint>
<joint name="t" type="fixed"><parent link="hand"/><child link="tip"/><origin xyz="0 0 0.2"/></joint>"""


@pytest.mark.parametrize(("merge", "kind"), [(False, "revolute"), (True, "fixed")])
def test_every_link_and_joint_has_its_line_and_its_prim_and_the_json_holds_all(tmp_path, merge, kind):
    text = ARM.replace('type="revolute"', f'type="{kind}"')
    path = urdf(tmp_path, f'{text}<gazebo reference="hand"><maxVel>1</maxVel></gazebo>')
    _, _, report = converted(path, merge_fixed=merge)
    mass = (2, None) if merge else (1, 1)
    assert [(line.name, line.became, line.mass_in_kg, line.mass_out_kg) for line in report.links] == [
        ("base_link", "body", 1, mass[0]),
        ("hand", "merged" if merge else "body", 1, mass[1]),
        ("tip", "frame", None, None),
    ]
    assert (report.mass_in_kg, report.mass_out_kg) == (2, 2)
    out = "" if merge else "PhysicsRevoluteJoint"
    assert [(j.name, j.type_in, j.type_out) for j in report.joints] == [("j", kind, out), ("t", "fixed", "")]
    stage = Usd.Stage.Open(str(path.with_suffix(".usda")))
    assert all(stage.GetPrimAtPath(line.prim) for line in (*report.links, *report.joints) if line.prim)
    assert report.source_sha256 == sha256(path)
    table = json.loads(report.to_json())
    assert set(table) == set(vars(report))
    assert table["unknown_tags"] == {"gazebo/maxVel": 1}
    assert table["links"][0]["prim"] == "/arm/base_link"


def test_the_box_of_a_robot_is_that_of_its_visuals_and_a_huge_one_is_noted(tmp_path):
    mesh = trimesh.creation.box((100, 200, 300))
    mesh.export(tmp_path / "box.stl")
    look = '<visual><origin xyz="1 2 3"/><geometry><mesh filename="box.stl"/></geometry></visual>'
    report = converted(urdf(tmp_path, f'<link name="base_link">{INERTIAL}{look}</link>'))[2]
    assert_allclose(report.box_out, np.add(mesh.bounds, [1, 2, 3]), atol=1e-5)
    assert any("the robot is 100 x 200 x 300 m large; are its meshes in mm?" in n for n in report.notes)
