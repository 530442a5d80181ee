"""The robot zoo (`make zoo`) on robots of our own: its rows, its faults, and what it keeps."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ZOO = ROOT / "benchmarks" / "zoo"
COMMIT = "0123456789abcdef0123456789abcdef01234567"

ROBOT = """<robot name="{name}"><link name="base_link">
<inertial><mass value="2"/><inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><box size="0.3 0.2 0.1"/></geometry></visual>
<collision><geometry><box size="0.3 0.2 0.1"/></geometry></collision></link></robot>"""

LIST = f"""[commits]
"us/robots" = "{COMMIT}"
{{}}"""

ENTRY = """
[[robot]]
name = "{name}"
kind = "mobile"
source = "us/robots"
path = "urdf/{name}.urdf"
"""


@pytest.fixture
def zoo(tmp_path):
    """Runs a zoo of two robots, one of them hostile, from a folder with their checkout."""
    place = tmp_path / "from" / "us+robots" / "urdf"
    place.mkdir(parents=True)
    (place.parent / ".commit").write_text(COMMIT + "\n")
    (place / "crate.urdf").write_text(ROBOT.format(name="crate"))
    bomb = '<!DOCTYPE robot [<!ENTITY a "aaaa">]>' + ROBOT.format(name="bomb")
    (place / "bomb.urdf").write_text(bomb)
    entries = "".join(ENTRY.format(name=name) for name in ("crate", "bomb"))
    (tmp_path / "list.toml").write_text(LIST.format(entries))

    def run(*more):
        paths = ["--from", tmp_path / "from", "--list", tmp_path / "list.toml", "--build", tmp_path / "build"]
        command = [sys.executable, ZOO / "zoo.py", *paths, "--engine", *more]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    return run


def test_a_zoo_has_a_row_for_each_robot_and_keeps_it(zoo, tmp_path):
    done = zoo()
    assert done.returncode == 1  # the hostile one
    assert "2 robots: 1 converted, 1 without a fault" in done.stdout
    crate, bomb = json.loads((tmp_path / "build" / "zoo.json").read_text())
    assert crate["errors"]["core"] == crate["errors"]["nvidia"] == []
    assert crate["mass_kg"] == crate["urdf_mass_kg"] == 2
    assert (crate["link_error_m"], crate["box_error"]) == (0, pytest.approx(0, abs=1e-7))
    assert "DOCTYPE" in bomb["steps_failed"]["convert"]
    kept = tmp_path / "build" / "rows" / "crate.json"
    before = kept.stat().st_mtime_ns
    assert zoo("--only", "crate").returncode == 0
    assert kept.stat().st_mtime_ns == before


def test_a_checkout_at_another_commit_is_refused(zoo, tmp_path):
    (tmp_path / "from" / "us+robots" / ".commit").write_text("f" * 40)
    done = zoo("--only", "crate")
    assert f"is at {'f' * 40}; wanted commit {COMMIT}" in done.stdout


GOOD = {
    "kind": "mobile",
    "convert_cpu_s": 1.0,
    "mass_kg": 2.0,
    "urdf_mass_kg": 2.0,
    "link_error_m": 0.0,
    "box_error": 0.0,
    "errors": {"core": [], "nvidia": [], "isaac": []},
    "newton": {
        "mass_kg": 2.0,
        "finite": True,
        "top_speed_m_s": 1.0,
        "creep_m": 0.001,
        "creeps": "/r/a",
        "motion": {"what": "j", "share": 0.9},
    },
}
LAZY = {"motion": {"what": "j", "share": 0.04}}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({}, None),
        ({"errors": {"isaac": ["RigidBodyHasMassAPI: no"]}}, "isaac: 1 errors, such as RigidBodyHasMassAPI"),
        ({"link_error_m": 1e-4}, "links differ from yourdfpy's by 0.0001 m"),
        ({"box_error": 0.002}, "box differs from yourdfpy's by 0.2 %"),
        ({"urdf_mass_kg": 2.03}, "newton: weighs 2 kg, the URDF 2.03 kg"),
        ({"newton": {"finite": False}}, "newton: explodes"),
        ({"newton": {"top_speed_m_s": 1115.0}}, "newton: is thrown at 1115 m/s"),
        ({"newton": {"creep_m": 0.0051}}, "newton: creeps 5 mm/s (a)"),
        ({"newton": LAZY}, "newton: j: 4 % of the commanded motion"),
        ({"newton": {"floats": True, "tilt_deg": 8.6, "base_sank_m": 0.0}}, "newton: leans 8.6 deg"),
        ({"newton": {"floats": True, "tilt_deg": 80.0, "base_sank_m": 0.0}}, "newton: falls over (80 deg)"),
        ({"newton": {"floats": True, "tilt_deg": 0.1, "base_sank_m": 0.0051}}, "newton: sinks 5 mm"),
        ({"newton": {"base_creep_m": 0.006, "tilt_creep_deg": 0.1}}, "newton: does not come to rest: 6 mm/s"),
        ({"newton": LAZY | {"on_floor": ["_r_wheel"]}, "boxes": ["base"]}, "newton: j: 4 % of the"),
        ({"newton": LAZY | {"on_floor": ["_r_base"]}, "boxes": ["base"]}, None),
    ],
)
def test_a_fault_of_a_row_is_named(monkeypatch, change, fault):
    monkeypatch.syspath_prepend(str(ZOO))
    import table

    row = GOOD | {key: value for key, value in change.items() if key != "newton"}
    row["newton"] = GOOD["newton"] | change.get("newton", {})
    found = table.faults(row)
    assert found == [] if fault is None else [f.startswith(fault) for f in found] == [True]
