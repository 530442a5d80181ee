"""Isaac Sim's rules: what they find is reported, what cannot run is named, and only known files are run."""

from pathlib import Path

import pytest
from places import DATA

import magtwin.export.validation.isaac_sim as isaac_sim
from magtwin.cli import main
from magtwin.export.validation.isaac_sim import isaac
from magtwin.fetch import default_folder
from magtwin.urdf.convert import convert_urdf

INNER = "isaacsim/asset/validation"

ROBOT = (DATA / "faulty_robot.usda").read_text()
"""A robot with a fault for each rule."""

FOUND = {
    "CheckRobotRelationships": "/bot",
    "DriveJointValueReasonable": "/bot/turned",
    "JointHasCorrectTransformAndState": "/bot/turned",
    "JointHasJointStateAPI": "/bot/bare",
    "MaterialsOnTopLevelOnly": "/bot/stray",
    "MimicAPICheck": "/bot/follower",
    "PhysicsJointHasDriveOrMimicAPI": "/bot/bare",
    "PhysicsJointMaxVelocity": "/bot/turned",
    "RigidBodyHasCollider": "/bot/b",
    "RigidBodyHasMassAPI": "/bot/a",
    "RobotNaming": "/bot",
    "RobotSchema": "/bot",
}
"""A prim of `ROBOT` at which each rule finds an error."""


@pytest.fixture
def robot(tmp_path):
    file = tmp_path / "stage" / "bot.usda"
    file.parent.mkdir()
    file.write_text(ROBOT)
    return file


@pytest.fixture
def own_rules(monkeypatch):
    """Rules of the tests in the place of NVIDIA's; called with their text."""

    def write(text):
        files = {f"{INNER}/__init__.py": text.encode(), "usd/schema/isaac/robot_schema/__init__.py": b""}
        monkeypatch.setattr(isaac_sim, "rule_files", lambda: files)

    return write


def errors(check):
    return [(f.rule, f.where, f.text) for f in check.findings if f.severity == "error"]


def test_isaac_sims_rules_find_each_fault_of_a_robot_with_many(isaac_rules, robot):
    check = isaac(robot, {"/bot": robot})
    found = {(rule, where) for rule, where, _ in errors(check)}
    assert {rule for rule, _ in found} == set(FOUND)
    assert found >= set(FOUND.items())
    assert not [text for _, _, text in errors(check) if "the rule failed" in text]
    warned = {f.rule for f in check.findings if f.severity == "warning"}
    assert warned == {
        *("InvisibleCollisionMeshHasPurposeGuide", "JointsExist", "LinksExist", "NoNestedMaterials"),
        "ThumbnailExists",
    }


def test_rules_that_cannot_run_are_named_with_the_reason_and_are_not_counted(isaac_rules, lab_scene):
    asset = lab_scene.parent / "robots" / "turtlebot4" / "turtlebot4.usda"
    check = isaac(lab_scene, {"/World/turtlebot4": asset})
    assert errors(check) == []
    not_run = {f.text.split(": ")[0]: f.text for f in check.findings if f.rule == "not-run"}
    assert "needs Isaac Sim itself (usdrt" in not_run["NonAdjacentCollisionMeshesDoNotClash"]
    layers = "NoOverrides, VerifyRobotPhysicsAttributesSourceLayer, VerifyRobotPhysicsSchemaSourceLayer"
    assert "asset structure" in not_run[layers]
    assert check.scope == "20 of 24 rules of isaacsim.asset.validation 1.3.6"
    (note,) = [f for f in isaac(lab_scene, {}).findings if f.rule == "not-run" and "RobotSchema" in f.text]
    assert note.text.endswith("the stage has no robot in a separate asset")


GRIPPER = """<robot name="grip"><link name="palm">{0}</link><link name="left">{0}</link>
<link name="right">{0}</link><joint name="lead" type="prismatic"><parent link="palm"/><child link="left"/>
<axis xyz="0 1 0"/><limit lower="0" upper="0.015" effort="5" velocity="1"/></joint>
<joint name="follow" type="prismatic"><parent link="palm"/><child link="right"/><axis xyz="0 1 0"/>
<limit lower="-0.015" upper="0" effort="5" velocity="1"/><mimic joint="lead" multiplier="-1"/></joint></robot>
""".format('<inertial><mass value="1"/></inertial>')


def test_limits_of_a_follower_that_isaac_sims_rule_compares_with_the_wrong_sign_are_no_error(
    isaac_rules, tmp_path
):
    (tmp_path / "grip.urdf").write_text(GRIPPER)
    asset = convert_urdf(tmp_path / "grip.urdf", tmp_path / "grip" / "grip.usda")
    check = isaac(asset, {"/grip": asset})
    assert errors(check) == []
    (note,) = [f.text for f in check.findings if f.rule == "not-run" and "MimicAPICheck" in f.text]
    assert "its comparison of limits does not apply: its sign is wrong" in note
    assert check.scope.startswith("23 of 24 rules")  # what else the rule checks, it checks


def test_the_makers_description_of_the_turtlebot_4_converts_without_an_error(
    isaac_rules, real_data, tmp_path
):
    asset = convert_urdf(
        real_data / "turtlebot4" / "turtlebot4.urdf", tmp_path / "turtlebot4" / "turtlebot4.usda"
    )
    check = isaac(asset, {"/turtlebot4": asset})
    assert errors(check) == []
    assert check.scope.startswith("23 of 24 rules")


def test_a_finding_in_a_variant_that_is_not_chosen_names_its_prim(own_rules, tmp_path):
    own_rules("""
from omni.asset_validator.core import BaseRuleChecker, registerRule

@registerRule("IsaacSim.RobotRules")
class Spots(BaseRuleChecker):
    def CheckPrim(self, prim):
        if prim.GetName().startswith("odd"):
            self._AddError(message="is odd", at=prim)
""")
    asset = tmp_path / "bot.usda"
    variant = '"{0}" {{\ndef Xform "odd_{0}"\n{{\n}}\n}}\n'
    asset.write_text(f"""#usda 1.0
(
    defaultPrim = "bot"
)
def Xform "bot" (
    variants = {{
        string kind = "a"
    }}
    prepend variantSets = "kind"
)
{{
    variantSet "kind" = {{
{variant.format("a")}{variant.format("b")}{variant.format("c")}}}
}}
""")
    check = isaac(asset, {"/bot": asset})
    assert [(f.rule, f.where, f.text) for f in check.findings] == [
        ("Spots", f"/bot/odd_{name}", "is odd") for name in "abc"
    ]


@pytest.mark.parametrize(
    ("text", "said", "patience_s"),
    [("while True: pass", "took longer than 1 s", 1.0), ("import nothing_known", "nothing_known", 60.0)],
)
def test_rules_that_hang_or_do_not_load_are_an_error_and_never_passed(
    own_rules, robot, monkeypatch, text, said, patience_s
):
    own_rules(text)
    monkeypatch.setattr(isaac_sim, "PATIENCE_S", patience_s)
    check = isaac(robot, {"/bot": robot})
    assert (check.result, check.findings[0].rule) == ("failed", "unfinished")
    assert said in check.findings[0].text


# --- where the rules come from --------------------------------------------------------------------


@pytest.mark.parametrize("change", ["altered", "removed"])
def test_a_copy_that_is_not_as_it_was_published_is_not_run(isaac_rules, robot, change):
    rules = isaac_rules / INNER
    (rules / "more_rules.py").write_text("raise SystemExit")  # not one of the published: not run
    assert not isaac(robot, {}).not_run
    if change == "altered":
        (rules / "util.py").write_text("raise SystemExit")
    else:
        (rules / "util.py").unlink()
    check = isaac(robot, {})
    assert check.result == "not run"
    assert "is not as it was published; `magtwin fetch isaac-rules --force`" in check.not_run


def test_without_rules_one_line_says_how_to_get_them(robot, tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_folder("magslam") == Path("magslam")
    assert default_folder("isaac-rules") == isaac_sim.copy_folder()
    with pytest.raises(SystemExit) as e:
        main(["validate", str(robot), "--against", "isaac"])
    assert e.value.code == 1
    (line,) = [line for line in capfd.readouterr().err.splitlines() if line.startswith("magtwin:")]
    assert "asked for and not run: isaac: the rule files of Isaac Sim are not here" in line
    assert "`magtwin fetch isaac-rules`" in line
