"""Isaac Sim's own rules for assets, the extension `isaacsim.asset.validation`, run on usd-core.

magtwin does not ship them: `magtwin fetch isaac-rules` makes a copy. They are code of another project, so
each file is compared with its SHA-256 before it is run, in a separate process with a time limit, from a
temporary folder that holds nothing else.
"""

import hashlib
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from magtwin.errors import InputError
from magtwin.export.validation.findings import Check, Finding
from magtwin.export.validation.inspection import as_named
from magtwin.files.children import LATE, answer_of, caches

FILES = Path(__file__).with_name("isaac_files.txt")
"""The files that `magtwin fetch isaac-rules` fetches: name, SHA-256, and path in Isaac Sim's repository."""

RULES = "isaacsim.asset.validation 1.3.6"
"""Name and version of the rules."""

GET_RULES = "the rule files of Isaac Sim are not here; `magtwin fetch isaac-rules` fetches them"

PATIENCE_S = 120.0
"""Time limit of the rules, plus 1 s per megabyte of the stage [s]."""


def copy_folder() -> Path:
    """Folder of the copy that `magtwin fetch isaac-rules` makes, in the user's cache."""
    return Path(caches(), "magtwin", "isaac-rules")


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
    return Check("isaac", tuple(findings), scope=f"{run} of {whole} rules of {RULES}")


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
        InputError: There are none, or one is not as it was published.
    """
    folder, files = copy_folder(), dict[str, bytes]()
    if not folder.is_dir():
        raise InputError(GET_RULES)
    lines = (line.split() for line in FILES.read_text(encoding="utf-8").splitlines() if line[0] != "#")
    for name, checksum, _ in lines:
        file = folder / name
        files[name] = file.read_bytes() if file.is_file() else b""
        if hashlib.sha256(files[name]).hexdigest() != checksum:
            raise InputError(
                f"{file}: is not as it was published; `magtwin fetch isaac-rules --force` fetches it again"
            )
    return files
