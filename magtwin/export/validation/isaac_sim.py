"""Isaac Sim's own rules for assets, the extension `isaacsim.asset.validation`, run on usd-core.

magtwin does not ship them. They come from an Isaac Sim installation that the user names, or from the copy
that `magtwin fetch isaac-rules` makes. They are code of another project, so they run in a separate process
with a time limit, from a temporary folder that holds only the files needed. Those of the copy are compared
with their SHA-256 first.
"""

import hashlib
import os
import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from magtwin.errors import InputError
from magtwin.export.validation.findings import Check, Finding
from magtwin.export.validation.inspection import as_named
from magtwin.files.children import LATE, answer_of

INSTALLATION = "MAGTWIN_ISAACSIM"
"""Environment variable with the path of an Isaac Sim installation, of a checkout, or of fetched rules."""

FILES = Path(__file__).with_name("isaac_files.txt")
"""The files that `magtwin fetch isaac-rules` fetches: name, SHA-256, and path in Isaac Sim's repository."""

EXTENSIONS = ("", "exts", "extscache", "source/extensions", "isaacsim/exts", "isaacsim/extscache")
"""Folders of extensions in fetched rules, an installation, a checkout, and a Python environment."""

NEEDED = (
    ("isaacsim.asset.validation", "isaacsim/asset/validation", "*.py", "isaacsim/asset/validation"),
    ("isaacsim.asset.validation", "docs", "CHANGELOG.md", "docs"),
    ("isaacsim.robot.schema", "robot_schema", "__init__.py", "usd/schema/isaac/robot_schema"),
    (
        "isaacsim.robot.schema",
        "usd/schema/isaac/robot_schema",
        "__init__.py",
        "usd/schema/isaac/robot_schema",
    ),
)
"""Extension, folder in it, files, and the folder in which Python looks for them."""

RULES, ROBOT_SCHEMA = "isaacsim/asset/validation/__init__.py", "usd/schema/isaac/robot_schema/__init__.py"

GET_RULES = (
    "the rule files of Isaac Sim are not here; `magtwin fetch isaac-rules` fetches them, or "
    f"{INSTALLATION} names an installation"
)

PATIENCE_S = 120.0
"""Time limit of the rules, plus 1 s per megabyte of the stage [s]."""


def copy_folder() -> Path:
    """Folder of the copy that `magtwin fetch isaac-rules` makes, in the user's cache."""
    import pooch

    return Path(pooch.os_cache("magtwin")) / "isaac-rules"


def isaac(
    file: Path, robots: Mapping[str, Path | None], *, home: Path | None = None, package: Path | None = None
) -> Check:
    """Check a stage, and the assets of its robots, with Isaac Sim's rules.

    Args:
        file: The stage.
        robots: Asset of each robot by its prim; None if the robot has no separate asset.
        home: Folder of an unpacked package. Rules about the folder of an asset are not run there.
        package: The package, which the findings name instead.
    """
    try:
        files = rule_files()
    except InputError as error:
        return Check("isaac", not_run=str(error))
    assets = {asset: prim for prim, asset in reversed(list(robots.items())) if asset is not None}
    with tempfile.TemporaryDirectory() as folder:
        rules = Path(folder, "rules")
        for name, content in files.items():
            (rules / name).parent.mkdir(parents=True, exist_ok=True)
            (rules / name).write_bytes(content)
        job = {
            "rules": str(rules),
            "stage": str(file),
            "robots": [[str(asset), prim] for asset, prim in assets.items()],
            "packed": home is not None,
        }
        patience = PATIENCE_S + file.stat().st_size / 1e6
        result, done = answer_of("magtwin.export.validation.isaac_run", job, patience, "-B")
        if result is None:
            last = (done.stderr.strip().splitlines() or ["no output"])[-1]
            ended = last if done.returncode == LATE else f"ended with status {done.returncode}: {last[:200]}"
            return Check("isaac", (Finding("unfinished", f"Isaac Sim's rules {ended}"),))
    findings = []
    for finding in (Finding(**each) for each in result["findings"]):
        text = as_named(finding.text, home, package or file)
        findings.append(replace(finding, text=text, advice=finding.advice or ADVICE.get(finding.rule, "")))
    findings.sort(key=lambda finding: (finding.rule, finding.where, finding.text))
    for why in dict.fromkeys(result["skipped"].values()):
        names = sorted(rule for rule, reason in result["skipped"].items() if reason == why)
        findings.append(Finding("not-run", f"{', '.join(names)}: {why}", severity="note"))
    run, whole = result["rules"] - len(result["skipped"]), result["rules"]
    return Check("isaac", tuple(findings), scope=f"{run} of {whole} rules of {_version(files)}")


ADVICE = {
    "CleanFolder": "Isaac Sim's asset structure puts further files below payloads/",
    "RigidBodyHasCollider": "give it a collider, disabled if it shall touch nothing",
    "RobotNaming": "put the robot into a folder of its own, with the name of its file",
    "ThumbnailExists": "draw it with magtwin robot --thumbnail",
}
"""What to do about a rule that does not suggest it."""


def rule_files() -> dict[str, bytes]:
    """The files that the rules need, by their path below a folder from which Python imports them.

    Raises:
        InputError: There are none, or a file of the fetched copy has changed.
    """
    named = os.environ.get(INSTALLATION)
    folder = Path(named) if named else copy_folder()
    files = dict(_collected(folder))
    if named and RULES not in files:
        raise InputError(f"{INSTALLATION} names {folder}, which has no isaacsim.asset.validation")
    if RULES not in files:
        raise InputError(GET_RULES)
    if ROBOT_SCHEMA not in files:
        raise InputError(f"{folder}: has no isaacsim.robot.schema, which the rules of Isaac Sim need")
    if not named:
        lines = FILES.read_text(encoding="utf-8").splitlines()
        known = {line.split()[1] for line in lines if not line.startswith("#")}
        if {hashlib.sha256(content).hexdigest() for content in files.values()} != known:
            raise InputError(
                f"{folder}: is not as it was published; `magtwin fetch isaac-rules --force` fetches it again"
            )
    return files


def _collected(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Path to import from, and content, of each needed file in the first place that has it."""
    seen: set[str] = set()
    for base in EXTENSIONS:
        for extension, inner, pattern, home in NEEDED:
            # Extensions from a registry have a folder with their version, such as NAME-1.3.6+110.
            for place in sorted((folder / base).glob(f"{extension}*")):
                if re.fullmatch(rf"{re.escape(extension)}(-\d.*)?", place.name) is None:
                    continue
                for file in sorted((place / inner).glob(pattern)):
                    if (name := f"{home}/{file.name}") not in seen:
                        seen.add(name)
                        yield name, file.read_bytes()


def _version(files: Mapping[str, bytes]) -> str:
    """Name and version of the rules, by their change log."""
    log = files.get("docs/CHANGELOG.md", b"").decode(errors="replace")
    version = re.search(r"^## \[([\w.]+)\]", log, re.M)
    return f"isaacsim.asset.validation {version[1]}" if version else "isaacsim.asset.validation"
