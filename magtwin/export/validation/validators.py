"""External validators: NVIDIA's usd-validation-nvidia and SimReady.

Each is a separate program. If it is not installed, its check is not run, with a text how to get it, and never
counts as passed.
"""

import ast
import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from magtwin.export.validation.findings import Check, Finding, Severity
from magtwin.files.children import LATE, run

PATIENCE_S = 600.0
"""Time limit of a validator [s]."""

SIMREADY = "MAGTWIN_SIMREADY"
"""Environment variable with the path of `simready-validate`; `make simready` installs it separately."""

PROFILES = (("Robot-Body", "3.0.0"), ("Sensor-IMU", "1.0.0"), ("Sensor-LiDAR", "1.0.0"))
"""SimReady's profiles for a robot, with their versions."""

GET_NVIDIA = "usd-validation-nvidia is not installed; pip install 'magtwin[validate]'"
GET_SIMREADY = (
    f"simready-validate is not installed; `make simready` installs it, {SIMREADY} is the path of its command"
)

_SEVERITIES: Mapping[str, Severity] = {"WARNING": "warning", "INFO": "note"}
"""Our severities by NVIDIA's; others are errors."""


def nvidia(file: Path) -> Check:
    """Check a file with usd-validation-nvidia."""
    command = shutil.which("nvidia_usd_validate", path=_programs())
    if command is None:
        return Check("nvidia", not_run=GET_NVIDIA)
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        result = _run([command, str(file), "--json-output", str(report)])
        if not report.is_file():
            return Check("nvidia", (_unfinished("nvidia_usd_validate", result),))
        rules = json.loads(report.read_text(encoding="utf-8"))["rules"]
    findings = []
    for issue in (issue for rule in rules for issue in rule["issues"]):
        where, advice = (issue.get("at") or {}).get("path"), (issue.get("suggestion") or {}).get("message")
        text, severity = " ".join(issue["message"].split()), _SEVERITIES.get(issue["severity"], "error")
        findings.append(Finding(issue["rule"]["name"], text, where or "", advice or "", severity))
    findings.sort(key=lambda finding: (finding.rule, finding.where, finding.text))
    return Check("nvidia", tuple(findings), scope=_version("usd-validation-nvidia"))


def simready(robots: Mapping[str, Path | None], *, packed: bool = False) -> list[Check]:
    """Check the robots of a stage, each in its own asset, with SimReady's profiles.

    Args:
        robots: Asset of each robot by its prim; None if the robot has no separate asset.
        packed: Whether the stage is a package. A profile needs an asset's folder with its thumbnail, which a
            package may not hold.
    """
    command = os.environ.get(SIMREADY) or shutil.which("simready-validate")
    if not command or not Path(command).is_file():
        why = GET_SIMREADY
    elif not robots:
        why = "the stage has no robot"
    elif packed:
        why = "the profile needs the folder of an asset, not a package"
    elif any(asset is None for asset in robots.values()):
        why = "the profile needs a robot in a separate asset"
    else:
        return [_profile(command, profile, version, robots) for profile, version in PROFILES]
    return [Check(f"simready {profile} {version}", not_run=why) for profile, version in PROFILES]


def _profile(command: str, profile: str, version: str, robots: Mapping[str, Path | None]) -> Check:
    """Check the assets of robots with one profile, each asset once."""
    findings: list[Finding] = []
    scope, assets = "", {asset: prim for prim, asset in reversed(list(robots.items()))}
    for asset, prim in assets.items():
        with tempfile.TemporaryDirectory() as folder:
            report = Path(folder, "report.json")
            options = ["--profile", profile, "--version", version, "--output", str(report)]
            result = _run([command, *options, str(asset)])
            metadata = _metadata(report)
        if metadata is None and "is not registered" in result.stdout + result.stderr:  # no tier installed
            get = f"{command} lacks the profile; `make simready` installs it"
            return Check(f"simready {profile} {version}", not_run=get)
        if metadata is None:
            findings.append(_unfinished("simready-validate", result))
            continue
        scope = f"simready-validate {metadata.get('simready_validate_version', '')}".strip()
        features = metadata["features_summary"]
        if not features:
            findings.append(Finding(profile, "no feature was checked", prim, "install the profile's tier"))
        for name, feature in features.items():
            if feature["blocking_failure"]:
                findings += _unmet(name, feature, prim)
        optional = [n for n, f in features.items() if not f["passed"] and not f["blocking_failure"]]
        if optional:
            findings.append(Finding("optional", f"missing features: {', '.join(optional)}", prim, "", "note"))
    return Check(f"simready {profile} {version}", tuple(findings), scope=scope)


def _metadata(report: Path) -> dict[str, Any] | None:
    """The entry of a report for its only asset; None if there is none."""
    try:
        (metadata,) = json.loads(report.read_text(encoding="utf-8")).values()
    except (OSError, ValueError, AttributeError):
        return None
    return metadata if isinstance(metadata, dict) and "features_summary" in metadata else None


def _unmet(name: str, feature: Mapping[str, Any], prim: str) -> list[Finding]:
    """The requirements that a feature fails, with their messages."""
    codes = _literal(feature.get("failing requirements"), [])
    messages = _literal(feature.get("requirement_messages"), {})
    findings = [
        Finding(f"{name} {code.rpartition('simready.')[2]}", " ".join(text.split()), prim)
        for code in codes
        for text in (messages.get(code) or ["is not met"])[:3]
    ]
    return findings or [Finding(name, "is not met", prim)]


def _literal(text: Any, default: Any) -> Any:
    """A list or a table that a report has as text."""
    try:
        value = ast.literal_eval(text) if isinstance(text, str) else text
    except (ValueError, SyntaxError):
        value = None
    return value if isinstance(value, type(default)) else default


def _programs() -> str:
    """Search path of programs: the folder of this Python first."""
    return os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a program without PYTHONPATH, and capture its output."""
    return run(command, limit_s=PATIENCE_S, changes={"PYTHONPATH": None})


def _unfinished(program: str, result: subprocess.CompletedProcess[str]) -> Finding:
    """The finding for a program that ended without a report."""
    lines = (result.stderr.strip() or result.stdout.strip() or "no output").splitlines()
    ended = f"ended with status {result.returncode} and without a report: "
    text = f"{program} {'' if result.returncode == LATE else ended}{lines[-1][:200]}"
    return Finding("unfinished", text, "", "the stage or the program may be damaged")


def _version(package: str) -> str:
    try:
        return f"{package} {importlib.metadata.version(package)}"
    except importlib.metadata.PackageNotFoundError:
        return package
