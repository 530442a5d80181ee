"""Validators of others': NVIDIA's usd-validation-nvidia and SimReady, and a load in Newton.

Each is a program of its own, run where it is installed. Where it is not, its check says so and how to get it;
it never counts as passed.
"""

import ast
import importlib.metadata
import importlib.util
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

PATIENCE_S = 600.0
"""How long a validator may take [s]: Newton's kernels compile for a minute at first."""

SIMREADY = "MAGTWIN_SIMREADY"
"""Variable that names the `simready-validate` of an environment of its own, as `make simready` makes it."""

PROFILES = (("Robot-Body", "3.0.0"), ("Sensor-IMU", "1.0.0"), ("Sensor-LiDAR", "1.0.0"))
"""SimReady's profiles that a robot is held to, each with its version."""

GET_NVIDIA = "usd-validation-nvidia is not installed; pip install 'magtwin[validate]'"
GET_SIMREADY = (
    f"simready-validate is not installed; `make simready` makes an environment of it, {SIMREADY} names its "
    "command"
)
GET_NEWTON = "newton is not installed; pip install 'magtwin[physics]'"

_SEVERITIES: Mapping[str, Severity] = {
    "ERROR": "error",
    "FAILURE": "error",
    "WARNING": "warning",
    "INFO": "note",
}


def nvidia(file: Path) -> Check:
    """What usd-validation-nvidia says of a file."""
    command = shutil.which("nvidia_usd_validate", path=_programs())
    if command is None:
        return Check("nvidia", not_run=GET_NVIDIA)
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        said = _run([command, str(file), "--json-output", str(report)])
        if not report.is_file():
            return Check("nvidia", (_unfinished("nvidia_usd_validate", said),))
        rules = json.loads(report.read_text(encoding="utf-8"))["rules"]
    findings = [
        Finding(
            issue["rule"]["name"],
            " ".join(issue["message"].split()),
            (issue.get("at") or {}).get("path") or "",
            (issue.get("suggestion") or {}).get("message") or "",
            _SEVERITIES.get(issue["severity"], "error"),
        )
        for rule in rules
        for issue in rule["issues"]
    ]
    findings.sort(key=lambda finding: (finding.rule, finding.where, finding.text))
    return Check("nvidia", tuple(findings), scope=_version("usd-validation-nvidia"))


def simready(robots: Mapping[str, Path | None], *, packed: bool = False) -> list[Check]:
    """What SimReady's profiles say of the robots of a stage, each by its own asset.

    Args:
        robots: File of the asset of each robot by its prim; None where it is no asset of its own.
        packed: Whether they lie in a package: a profile is of an asset's folder with its picture, which no
            package may hold.
    """
    command = os.environ.get(SIMREADY) or shutil.which("simready-validate")
    checks = []
    for profile, version in PROFILES:
        name = f"simready {profile} {version}"
        if not command or not Path(command).is_file():
            checks.append(Check(name, not_run=GET_SIMREADY))
        elif not robots:
            checks.append(Check(name, not_run="the stage has no robot"))
        elif packed:
            checks.append(Check(name, not_run="a package is no folder of an asset, which the profile is for"))
        elif any(asset is None for asset in robots.values()):
            checks.append(Check(name, not_run="a robot is no asset of its own, which the profile is for"))
        else:
            checks.append(_profile(command, profile, version, robots))
    return checks


def _profile(command: str, profile: str, version: str, robots: Mapping[str, Path | None]) -> Check:
    """What one profile says of the assets of robots, of each once."""
    findings: list[Finding] = []
    scope, assets = "", {asset: prim for prim, asset in reversed(list(robots.items()))}
    for asset, prim in assets.items():
        with tempfile.TemporaryDirectory() as folder:
            report = Path(folder, "report.json")
            said = _run(
                [command, "--profile", profile, "--version", version, "--output", str(report), str(asset)]
            )
            metadata = _metadata(report)
        if (
            metadata is None and "is not registered" in said.stdout + said.stderr
        ):  # of a tier that is not installed
            get = f"{command} has not the profile; `make simready` makes an environment that has"
            return Check(f"simready {profile} {version}", not_run=get)
        if metadata is None:
            findings.append(_unfinished("simready-validate", said))
            continue
        scope = f"simready-validate {metadata.get('simready_validate_version', '')}".strip()
        features = metadata["features_summary"]
        if not features:
            findings.append(Finding(profile, "no feature was looked at", prim, "install the profile's tier"))
        for name, feature in features.items():
            if feature["blocking_failure"]:
                findings += _unmet(name, feature, prim)
        optional = [n for n, f in features.items() if not f["passed"] and not f["blocking_failure"]]
        if optional:
            findings.append(
                Finding("optional", f"features that it has not: {', '.join(optional)}", prim, "", "note")
            )
    return Check(f"simready {profile} {version}", tuple(findings), scope=scope)


def _metadata(report: Path) -> dict[str, Any] | None:
    """What a report says of its one asset, None where it says nothing."""
    try:
        (metadata,) = json.loads(report.read_text(encoding="utf-8")).values()
    except (OSError, ValueError, AttributeError):
        return None
    return metadata if isinstance(metadata, dict) and "features_summary" in metadata else None


def _unmet(name: str, feature: Mapping[str, Any], prim: str) -> list[Finding]:
    """The requirements that a feature fails, each with what was said of it."""
    codes = _literal(feature.get("failing requirements"), [])
    told = _literal(feature.get("requirement_messages"), {})
    found = [
        Finding(f"{name} {code.rpartition('simready.')[2]}", " ".join(text.split()), prim)
        for code in codes
        for text in (told.get(code) or ["is not met"])[:3]
    ]
    return found or [Finding(name, "is not met", prim)]


def _literal(text: Any, default: Any) -> Any:
    """A list or a table that a report writes as text."""
    try:
        value = ast.literal_eval(text) if isinstance(text, str) else text
    except (ValueError, SyntaxError):
        value = None
    return value if isinstance(value, type(default)) else default


def newton(file: Path, bodies: int) -> Check:
    """Whether Newton loads a stage as it is, every body of it.

    Args:
        file: The stage.
        bodies: Rigid bodies that it has.
    """
    lacking = [name for name in ("newton", "newton_usd_schemas") if importlib.util.find_spec(name) is None]
    if lacking:
        return Check("newton", not_run=GET_NEWTON)
    said = _run([sys.executable, "-P", "-m", "magtwin.export.validation.newton_load", str(file)])
    lines = said.stdout.strip().splitlines()
    try:
        model = json.loads(lines[-1])
    except (ValueError, IndexError):
        return Check("newton", (_unfinished("Newton", said),))
    findings = []
    if model["bodies"] != bodies:
        text = f"Newton made {model['bodies']} bodies of the stage's {bodies}"
        findings.append(Finding("bodies", text, "", "look at its rigid bodies and their transforms"))
    if bodies and not model["mass_kg"] > 0:
        findings.append(Finding("mass", f"the bodies weigh {model['mass_kg']:g} kg", "", "give them mass"))
    scope = f"{model['bodies']} bodies, {model['joints']} joints, {model['mass_kg']:.4g} kg"
    return Check("newton", tuple(findings), scope=f"{_version('newton')}: {scope}")


def _programs() -> str:
    """Where programs are looked for: beside this Python first."""
    return os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])


def _run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a program with no path of ours in it; what it says is kept."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    try:
        return subprocess.run(
            command,
            capture_output=True,
            check=False,
            text=True,
            errors="replace",
            env=clean,
            timeout=PATIENCE_S,
        )
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 1, "", f"did not end within {PATIENCE_S:g} s")


def _unfinished(program: str, said: subprocess.CompletedProcess[str]) -> Finding:
    """A program that ended without an answer."""
    lines = (said.stderr.strip() or said.stdout.strip() or "nothing was said").splitlines()
    text = f"{program} ended with {said.returncode} and without an answer: {lines[-1][:200]}"
    return Finding("unfinished", text, "", "the stage may be damaged, or the program is")


def _version(package: str) -> str:
    try:
        return f"{package} {importlib.metadata.version(package)}"
    except importlib.metadata.PackageNotFoundError:
        return package
