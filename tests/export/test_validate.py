"""Validators in one answer: a few lines break each rule, damaged files end nothing, mends mend."""

import importlib
import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from places import DOCS
from pxr import Usd, UsdUtils

import magtwin.export.validation.validators as others
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.export.validation.findings import Check, Finding, Findings, check_from
from magtwin.export.validation.rule import RULES, Subject
from magtwin.export.validation.rules import robot_assets
from magtwin.export.validation.validate import validate
from magtwin.learn.data.features import FEATURES

EVERY = RULES["magtwin"]

HEAD = """#usda 1.0
(
    defaultPrim = "World"
    kilogramsPerUnit = 1
    metersPerUnit = 1
    subLayers = [@./lab.usda@]
    upAxis = "Z"
)
"""

ORDER, MOVE = "uniform token[] xformOpOrder", '"xformOp:translate"'
TRANSLATE = "double3 xformOp:translate"
ROBOT, MAP, MAP_, SENSOR_ = "turtlebot4", "AnomalyMap", "magtwin:anomalyMap:", "magtwin:magnetometer:"
MAGNETOMETER = "turtlebot4/magnetometer_link/magnetometer"
IMU = "turtlebot4/imu_link/imu/imu_sensor"

TOWN = """def Xform "Town" (prepend apiSchemas = ["MagtwinEarthFieldAPI"])
{
    double3 magtwin:earth:bWorldNt = (0, 20000, -40000)
    double magtwin:earth:latitudeDeg = 29.65
    double magtwin:earth:longitudeDeg = -82.35
    double magtwin:earth:heightM = 50
    string magtwin:earth:date = "2026-11-21"
    bool magtwin:earth:measured = true
}
"""


@pytest.fixture(scope="module")
def lab(lab_scene, tmp_path_factory):
    """The default lab in a folder of this module's own, where broken stages are put beside it."""
    folder = tmp_path_factory.mktemp("validate") / "lab"
    shutil.copytree(lab_scene.parent, folder)
    return folder / lab_scene.name


def over(path, text="", head=""):
    """Text that says something at a prim below /World."""
    names = ["World", *filter(None, path.split("/"))]
    opened = "".join(f'over "{name}"\n{{\n' for name in names[:-1])
    return f'{opened}over "{names[-1]}" {head}\n{{\n{text}\n}}\n' + "}\n" * (len(names) - 1)


def beside(lab, name, text):
    """A stage beside the lab; `text` follows the head, or takes its place where it begins as a layer does."""
    file = lab.with_name(f"{name}.usda")
    file.write_text(text if text.startswith("#usda") else HEAD + text)
    return file


def subject(file, **known):
    heard = UsdUtils.CoalescingDiagnosticDelegate()
    stage = Usd.Stage.Open(str(file))
    heard.TakeUncoalescedDiagnostics()
    return Subject(stage, Path(file), inputs=frozenset(FEATURES), **known)


def broken(file, *names, **known):
    """Those of the named rules, or of all, that a stage breaks, with what they found."""
    heard = UsdUtils.CoalescingDiagnosticDelegate()
    held = subject(file, **known)
    found = {name: EVERY[name].findings(held) for name in names or EVERY}
    heard.TakeUncoalescedDiagnostics()
    return {name: findings for name, findings in found.items() if findings}


def test_a_lab_that_magtwin_authored_breaks_no_rule(lab):
    assert not broken(lab)


BROKEN = [
    ("absolute-paths", over("", "asset a = @/somewhere/else.png@"), "names /somewhere/else.png", "error"),
    ("units", HEAD.replace("metersPerUnit = 1", "metersPerUnit = 0.01"), "in units of 0.01 m", "error"),
    ("schema-names", over(ROBOT, "double magtwin:drive:vMx = 1"), "magtwin:drive:vMx, which", "error"),
    ("targets", over(ROBOT, "rel magtwin:drive:leftWheelJoint = </World/x>"), "</World/x>", "error"),
    ("scene", over(MAP, f"double[] {MAP_}headingsDeg = None"), "headings", "error"),
    ("scene", over(MAP, f'string {MAP_}checksum = "{"0" * 64}"'), "do not match its checksum", "error"),
    ("scene", over(MAP, f"double3 xformOp:translate = (1, 0, 0)\n{ORDER} = [{MOVE}]"), "is moved", "error"),
    ("scene", over(MAGNETOMETER, f'string {SENSOR_}mapSha256 = "{"0" * 64}"'), "has SHA-256", "error"),
    ("scene", over(MAGNETOMETER, f"rel {SENSOR_}map = </World/Lab>"), "is no anomalyMap", "error"),
    ("scene", over(ROBOT, "double magtwin:drive:wheelRadiusM = -1"), "wheel_radius_m", "error"),
    ("scene", over("Furniture/desk_0", f"{TRANSLATE} = (-1.8, 2.3, 0)"), "made: desk_0 is moved", "warning"),
    ("scene", HEAD + TOWN, "Earth's field differs by", "warning"),
    ("scene", over(ROBOT, f"{TRANSLATE} = (0, 0, 0.5)"), "0.5 m above the floor", "warning"),
    ("network-file", over(MAGNETOMETER, f'string {SENSOR_}networkSha256 = "0"'), "has SHA-256", "error"),
    ("network-file", over(MAGNETOMETER, f"asset {SENSOR_}network = @@"), "keeps the checksum", "note"),
    ("network-inputs", over(MAGNETOMETER, f'string[] {SENSOR_}inputs = ["warp"]'), "warp", "error"),
    ("map-inside", over("Lab", "double2 magtwin:lab:floorM = (4, 3.5)"), "1 m beyond", "error"),
    ("robot-inside", over(ROBOT, f"{TRANSLATE} = (9, 0, 0)"), "it is off the floor", "error"),
    ("robot-clear", over(ROBOT, f"{TRANSLATE} = (2.9, 0, 0)"), "m from /World/Lab/Walls/East", "error"),
    ("sensor-types", over(IMU, "float sensorPeriod = 1"), "has a period of 1.0 s", "error"),
    ("shown-meshes", over("Furniture/desk_0/Visuals/top", f"{TRANSLATE} = (0, 0.5, 0.7)"), "m from", "error"),
]


def test_every_rule_is_broken_by_a_test():
    assert {name for name, *_ in BROKEN} == EVERY.keys()


@pytest.mark.parametrize(("name", "text", "said", "severity"), BROKEN)
def test_a_few_lines_break_a_rule_and_it_says_so(lab, name, text, said, severity):
    found = broken(beside(lab, name.replace("-", "_"), text), name)
    told = [finding for finding in found.get(name, ()) if said in finding.text]
    assert told, found
    assert told[0].severity == severity
    assert told[0].advice
    if severity == "error":
        assert told[0].where or name == "units", told[0]


def test_the_docs_list_every_rule_with_its_sentence():
    text = (DOCS / "validate.md").read_text()
    for rule in EVERY.values():
        assert f"| `{rule.name}` | {rule.sentence} | {rule.advice} |" in text


def test_a_robots_asset_is_found_for_the_profiles_that_are_for_it(lab, tmp_path):
    (asset,) = robot_assets(subject(lab)).values()
    assert asset.name == "turtlebot4.usda"
    assert robot_assets(subject(asset)) == {"/turtlebot4": asset}
    flat = tmp_path / "flat.usdc"
    Usd.Stage.Open(str(lab)).Export(str(flat))
    assert robot_assets(subject(flat)) == {"/World/turtlebot4": None}


# --- the answer -----------------------------------------------------------------------------------


def test_what_was_not_run_is_never_passed():
    missing = Check("nvidia", not_run="is not installed")
    assert missing.result == "not run"
    failed = Check("core", (Finding("a", "b"), Finding("c", "d", severity="note")))
    assert (failed.result, Check("x", (Finding("a", "b", severity="warning"),)).result) == (
        "failed",
        "passed",
    )
    found = Findings(Path("a.usda"), (missing, failed))
    assert not found.clean
    table = json.loads(found.to_json())
    assert [check["result"] for check in table["checks"]] == ["not run", "failed"]
    assert tuple(check_from(check) for check in table["checks"]) == found.checks


def test_the_command_says_clean_by_its_exit_status_and_in_json(lab, tmp_path, capfd, isaac_rules):
    out = tmp_path / "r.json"
    main(["validate", str(lab), "--against", "core", "isaac", "magtwin", "--json", "--out", str(out)])
    printed = json.loads(capfd.readouterr().out)
    assert printed == json.loads(out.read_text())
    assert [c["validator"] for c in printed[0]["checks"]] == ["core", "isaac", "magtwin"]
    assert printed[0]["clean"]
    assert all(c["result"] == "passed" for c in printed[0]["checks"])


def test_the_command_shows_rule_prim_and_what_to_do_and_exits_1(lab, capfd, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    file = beside(lab, "off", over(ROBOT, f"{TRANSLATE} = (9, 0, 0)"))
    with pytest.raises(SystemExit) as e:
        main(["validate", str(file), "--against", "magtwin"])
    assert e.value.code == 1
    printed = capfd.readouterr().out
    assert "error magtwin robot-inside /World/turtlebot4: stands at (9, 0) m" in printed
    assert "start it on the floor" in printed


def test_validators_that_are_not_installed_say_how_to_get_them(lab, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(others, "_programs", lambda: str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv(others.SIMREADY, raising=False)
    checks = [others.nvidia(lab), *others.simready({"/a": lab})]
    assert {check.result for check in checks} == {"not run"}
    for check, get in zip(checks, ["[validate]", *["make simready"] * 3], strict=True):
        assert get in check.not_run
    with pytest.raises(SystemExit) as e:
        main(["validate", str(lab), "--against", "nvidia"])
    assert e.value.code == 1
    assert "asked for and not run: nvidia" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("said", "result"), [("Profile 'Sensor-IMU' is not registered", "not run"), ("it broke", "failed")]
)
def test_an_empty_report_of_simreadys_counts_as_passed_for_no_profile(
    lab, tmp_path, monkeypatch, said, result
):
    program = tmp_path / "simready-validate"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nopen(sys.argv[6], 'w').write('{{}}')\n"
        f"print({said!r})\nsys.exit(1)\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv(others.SIMREADY, str(program))
    checks = others.simready({"/a": lab})
    assert {check.result for check in checks} == {result}
    for check in checks:
        assert "make simready" in check.not_run if check.not_run else said in check.findings[0].text


def test_nvidias_validator_names_rule_and_prim(lab):
    (clean,) = validate(lab, ["nvidia"]).checks
    assert (clean.result, clean.count("warning")) == ("passed", 0)
    file = beside(lab, "nv", 'def Sphere "S" {\nrel material:binding = </World/gone>\n}\n')
    (check,) = validate(file, ["nvidia"]).checks
    assert ("UsdDanglingMaterialBinding", "/S") in {(f.rule, f.where) for f in check.findings}


@pytest.mark.skipif(
    not os.environ.get(others.SIMREADY), reason=f"{others.SIMREADY} names no simready-validate"
)
def test_the_labs_robot_is_simready_and_one_without_emitters_is_told(lab, tmp_path):
    assert all(check.result == "passed" for check in validate(lab, ["simready"]).checks)
    shutil.copytree(lab.parent, tmp_path / "lab")
    asset = tmp_path / "lab" / "robots" / "turtlebot4" / "turtlebot4.usda"
    asset.write_text(asset.read_text().replace("numberOfEmitters", "numberOfNothing"))
    (*others_, lidar) = validate(tmp_path / "lab" / lab.name, ["simready"]).checks
    assert [check.result for check in others_] == ["passed", "passed"]
    assert "LI.002" in lidar.findings[0].rule


# --- files that are damaged or made to harm -------------------------------------------------------


def test_a_damaged_crate_is_refused_in_one_line_and_ends_nothing(lab, tmp_path):
    shutil.copytree(lab.parent, tmp_path / "lab")
    crate = next((tmp_path / "lab").rglob("*.usdc"))
    data = bytearray(crate.read_bytes())
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(2):
        spoilt = bytearray(data)
        for at in rng.integers(len(data) // 2, len(data), 300):
            spoilt[at] = int(rng.integers(256))
        crate.write_bytes(spoilt)
        command = [sys.executable, "-m", "magtwin", "validate", str(crate), "--against", "magtwin"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 1, "it ended otherwise than by refusing"
        assert "Traceback" not in done.stderr
        ended += "damaged" in done.stderr
    assert ended, "none of them was damaged"


@pytest.mark.parametrize("content", [b"PXR-USDC", b"#usda 1.0\n((("])
def test_what_is_no_stage_is_refused(tmp_path, content):
    file = tmp_path / "a.usda"
    file.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.usda: cannot be opened as USD"):
        validate(file, ["magtwin"])


@pytest.mark.parametrize("entry", ["../evil.usda", "/evil.usda", "a/../../evil.usda", "C:\\evil.usda"])
def test_a_package_with_an_entry_that_climbs_out_is_refused_with_nothing_written(tmp_path, entry):
    package = tmp_path / "inner" / "a.usdz"
    package.parent.mkdir()
    with zipfile.ZipFile(package, "w") as archive:
        archive.writestr("root.usda", "#usda 1.0\n")
        archive.writestr(entry, "#usda 1.0\n")
    with pytest.raises(InputError, match="would be written outside"):
        validate(package)
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["a.usdz"]


@pytest.mark.parametrize(
    ("name", "said"),
    [("gone.usda", "no such USD file"), (".", "a folder; give the root layer"), ("a.txt", "no USD file")],
)
def test_what_cannot_be_validated_is_refused(tmp_path, name, said):
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(InputError, match=said):
        validate(tmp_path / name)


def test_a_validator_that_there_is_not_is_refused_by_the_near_one(tmp_path):
    (tmp_path / "a.usda").write_text(HEAD)
    with pytest.raises(InputError, match="no validator 'isac'; did you mean 'isaac'"):
        validate(tmp_path / "a.usda", ["isac"])


def test_a_rule_of_ones_own_is_checked_beside_those_that_ship(lab_scene, tmp_path, monkeypatch):
    (tmp_path / "house_rules.py").write_text(
        "from magtwin.extend import rule\n"
        "from magtwin.export.validation.rule import Wrong\n\n\n"
        "@rule('magtwin', 'take another lab')\n"
        "def not_this_lab(subject):\n"
        '    """No lab is good enough."""\n'
        "    yield Wrong('it is a lab', '/World')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("magtwin.export.validation.rule.RULES", {"magtwin": {}})
    importlib.import_module("house_rules")
    report = validate(lab_scene, against=["magtwin"])
    assert "not-this-lab" in {finding.rule for check in report.checks for finding in check.findings}
