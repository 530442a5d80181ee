"""The gates that every stage of ours passes: USD's own validators and NVIDIA's."""

import json
import subprocess
import sys
from pathlib import Path

from pxr import Usd, UsdValidation


def assert_valid(stage_file: Path | str, scratch: Path) -> None:
    """No finding of UsdValidation, no failure or error of usd-validation-nvidia.

    Args:
        stage_file: Root layer to check, composed.
        scratch: Folder for the report.
    """
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) >= 30, "some of USD's validators were not loaded"
    stage = Usd.Stage.Open(str(stage_file))
    findings = UsdValidation.ValidationContext(validators).Validate(stage)
    assert not findings, "\n".join(f"{e.GetName()}: {e.GetMessage()}" for e in findings)
    report = scratch / "nvidia.json"
    command = Path(sys.executable).with_name("nvidia_usd_validate")
    subprocess.run([command, stage_file, "--json-output", report], capture_output=True, check=False)
    issues = [issue for rule in json.loads(report.read_text())["rules"] for issue in rule["issues"]]
    bad = [i for i in issues if i["severity"] in ("ERROR", "FAILURE")]
    assert not bad, "\n".join(f"{i['rule']['name']}: {i['message']} {i['at']}" for i in bad)
