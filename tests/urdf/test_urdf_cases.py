"""Small descriptions that once failed, read from ../shared/cases/urdf, with the values that are right."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics

from magtwin.author.from_urdf import from_urdf, write_urdf
from magtwin.errors import InputError
from magtwin.files.folders import allow

CASES = Path(__file__).parents[3] / "shared" / "cases" / "urdf"
pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="../shared/cases is not here")


def opened(tmp_path, name, **options):
    made = from_urdf(CASES / name, tmp_path / "robot", **options)
    return Usd.Stage.Open(str(made.asset)), made.report


def size_of(report):
    return np.subtract(report.box_out[1], report.box_out[0])


def test_a_quaternion_turns_a_link(tmp_path):
    stage, _ = opened(tmp_path, "quaternion.urdf")
    T = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetPrimAtPath("/quaternion/tip"))).T
    assert_allclose(T[:3], [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 1]], atol=1e-8)


def test_misspelt_attributes_are_named_with_their_lines(tmp_path):
    _, report = opened(tmp_path, "misspelt_attributes.urdf")
    (line,) = (line for line in report.repairs if line.kind == "attribute-unknown")
    assert [(e.text.split("=")[0].split()[-1], e.line) for e in line.entries] == [
        ("rounding", 3),
        ("ypr", 4),
        ("uper", 5),
    ]
    with pytest.raises(InputError, match=r"rounding.*ypr.*uper"):
        opened(tmp_path, "misspelt_attributes.urdf", strict=True, force=True)


@pytest.mark.parametrize("where", ["beside", "folder", "allowed"])
def test_meshes_beside_and_above_are_found(tmp_path, where, monkeypatch):
    if where == "beside":
        _, report = opened(tmp_path, "beside/beside.urdf")
    elif where == "folder":
        monkeypatch.chdir(CASES / "nested" / "robot")
        report = from_urdf("basic/nested.urdf", tmp_path / "robot").report
    else:
        with allow(CASES / "nested" / "robot"):
            _, report = opened(tmp_path, "nested/robot/basic/nested.urdf")
    assert not [line for line in report.repairs if line.kind == "mesh-missing"]
    assert_allclose(size_of(report), [0.1, 0.2, 0.3], atol=1e-6)


def test_a_mesh_outside_the_trusted_area_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"lies outside .*--package NAME=FOLDER, or --allow it"):
        opened(tmp_path, "nested/robot/basic/nested.urdf")


def test_masses_sets_the_world_and_looks(tmp_path):
    _, report = opened(tmp_path / "a", "no_inertials.urdf")
    assert_allclose([line.mass_out_kg for line in report.links], [4, 4, 2.35619], rtol=1e-5)
    _, report = opened(tmp_path / "b", "set_difference.urdf.xacro")
    assert {line.name for line in report.links} == {"base", "link_a", "link_c"}
    stage, _ = opened(tmp_path / "c", "world_root.urdf")
    (joint,) = (p for p in stage.Traverse() if p.IsA(UsdPhysics.FixedJoint))
    assert UsdPhysics.Joint(joint).GetLocalPos0Attr().Get() == Gf.Vec3f(0, 0, 0.5)
    assert UsdPhysics.Joint(joint).GetBody0Rel().GetTargets() == [Sdf.Path("/world_root")]
    stage, _ = opened(tmp_path / "d", "twin_materials.urdf")
    looks = stage.GetPrimAtPath("/twin_materials/Looks").GetChildren()
    assert {"red_a", "red_b"} <= {prim.GetName() for prim in looks}
    _, report = opened(tmp_path / "e", "dont_collapse.urdf", merge_fixed=True)
    assert [line.became for line in report.links] == ["body", "body"]


@pytest.mark.parametrize("single_file", [True, False])
def test_a_driven_wheel_rolls_on_a_thin_cylinder_or_as_described(tmp_path, single_file):
    out = tmp_path / ("robot.usda" if single_file else "robot")
    made = from_urdf(CASES / "wide_wheels.urdf", out, profile="diff-drive", single_file=single_file)
    write_urdf(made.asset, tmp_path / "back.urdf")
    back = (tmp_path / "back.urdf").read_text()
    assert 'length="0.05"' in back
    assert 'length="0.002"' not in back
    stage = Usd.Stage.Open(str(made.asset))
    robot = stage.GetDefaultPrim()
    assert robot.GetChildren()[0].GetName() == "base_link"
    for variant, guided in (("guide", True), ("described", False)):
        robot.GetVariantSet("wheelContact").SetVariantSelection(variant)
        wheel = stage.GetPrimAtPath("/wide_wheels/left_wheel/collisions")
        enabled = UsdPhysics.CollisionAPI(wheel.GetPrimAtPath("cylinder")).GetCollisionEnabledAttr().Get()
        assert enabled is not guided
        disc = UsdGeom.Cylinder(wheel.GetPrimAtPath("wheelContact"))
        assert bool(disc) is guided
        if guided:
            assert (disc.GetRadiusAttr().Get(), disc.GetHeightAttr().Get()) == (0.05, 0.002)
            T = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(disc.GetPrim())).T
            assert_allclose(T[:3, 2:], [[0, 0], [1, 0.15], [0, 0.05]], atol=1e-12)


def test_a_new_conversion_keeps_the_users_changes_and_names_those_that_lost_their_prim(tmp_path):
    _, report = opened(tmp_path, "wide_wheels.urdf")
    edits = tmp_path / "robot" / "edits.usda"
    layer = Sdf.Layer.FindOrOpen(str(edits))
    for path in ("/wide_wheels/base_link", "/wide_wheels/gone/deep"):
        spec = Sdf.CreatePrimInLayer(layer, path)
        attribute = Sdf.AttributeSpec(spec, "physics:mass", Sdf.ValueTypeNames.Float)
        attribute.default = 7.0
    layer.Save()
    before = edits.read_bytes()
    stage, report = opened(tmp_path, "wide_wheels.urdf", force=True)
    assert edits.read_bytes() == before
    assert UsdPhysics.MassAPI(stage.GetPrimAtPath("/wide_wheels/base_link")).GetMassAttr().Get() == 7.0
    lost = "edits.usda edits </wide_wheels/gone>, which this conversion does not have"
    assert report.losses == (lost,)
