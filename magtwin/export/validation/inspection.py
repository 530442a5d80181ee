"""Check a stage in a separate process, since a damaged layer can crash its reader.

    python -m magtwin.export.validation.inspection JOB.json

`inspect` starts it. The job has the arguments, and the name of the file for the answer.
"""

import importlib
import json
import sys
from collections.abc import Collection
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from magtwin.errors import InputError
from magtwin.export.validation.findings import Check, Finding, check_from
from magtwin.files.children import LATE, answer_of

PATIENCE_S = 120.0
"""Time limit for a stage, plus 1 s per megabyte [s]."""


@dataclass(frozen=True)
class Inspection:
    """The result of an inspection."""

    checks: tuple[Check, ...]

    robots: dict[str, Path | None] = field(default_factory=dict)
    """Asset of each robot by its prim; None if the robot has no separate asset."""


def inspect(
    file: Path,
    against: Collection[str],
    *,
    root: Path | None = None,
    home: Path | None = None,
    inputs: Collection[str] | None = None,
) -> Inspection:
    """Check a stage in another process.

    Args:
        file: The file that the user named.
        against: Those of "core" and "magtwin" are used.
        root: Root layer of an unpacked .usdz. Default: the file itself.
        home: Folder of the unpacked .usdz.
        inputs: Names of the inputs that a network may have.

    Raises:
        InputError: The file crashes its reader, is no stage, or names files outside its folder.
    """
    from magtwin.export.validation.rule import added_modules
    from magtwin.usd.layers import check_stage

    check_stage(root or file)
    job = {
        "file": str(file),
        "root": str(root or file),
        "home": None if home is None else str(home),
        "against": sorted(against),
        "inputs": None if inputs is None else sorted(inputs),
        "rules": added_modules(),
        "path": sys.path,
    }
    patience = PATIENCE_S + file.stat().st_size / 1e6
    result, done = answer_of("magtwin.export.validation.inspection", job, patience)
    if done.returncode == LATE:
        raise InputError(f"{file}: USD does not finish reading it in {patience:.0f} s; copy it again")
    if result is None:
        if done.returncode < 0:
            raise InputError(f"{file}: damaged: USD crashes on it; copy it, or write it again")
        last = (done.stderr.strip().splitlines() or ["no output"])[-1]
        raise RuntimeError(f"the inspection of {file} ended with {done.returncode}: {last}")
    if result.get("refused"):
        raise InputError(as_named(result["refused"], home, file))
    for check in result["checks"]:
        for finding in check["findings"]:
            finding |= {name: as_named(finding[name], home, file) for name in ("text", "where")}
    return Inspection(
        tuple(check_from(check) for check in result["checks"]),
        {prim: None if asset is None else Path(asset) for prim, asset in result["robots"].items()},
    )


def as_named(text: str, home: Path | None, file: Path) -> str:
    """A text with the folder of an unpacked package replaced by the package."""
    for folder in () if home is None else (home.resolve(), home):
        text = text.replace(folder.as_posix(), file.as_posix())
    return text


def _look(job: dict[str, Any]) -> dict[str, Any]:
    """Do a job, and return the answer."""
    importlib.import_module("magtwin.usd")  # registers the schemas before USD is first used
    from pxr import Tf, Usd, UsdUtils

    from magtwin.export.validation.rule import RULES, Subject
    from magtwin.export.validation.rules import robot_assets
    from magtwin.usd.schema.versions import version_of

    sys.path += [place for place in job["path"] if place not in sys.path]
    for module in job["rules"]:
        importlib.import_module(module)
    file, root = Path(job["file"]), Path(job["root"])
    packed = None if job["home"] is None else Path(job["home"])
    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()  # keeps USD's messages off the terminal
    checks: list[Check] = []
    try:
        stage = Usd.Stage.Open(str(root))
        if stage is None:
            raise InputError(f"{file}: cannot be opened as USD; it is damaged, cut short, or not USD")
        for layer in stage.GetUsedLayers():
            _read_all(layer)
            version_of(layer)  # refuses a later one
        if "core" in job["against"]:
            checks.append(_core(stage if packed is None else Usd.Stage.Open(str(file))))
        inputs = None if job["inputs"] is None else frozenset(job["inputs"])
        subject = Subject(stage, root, inputs, packed)
        if "magtwin" in job["against"]:
            rules = RULES["magtwin"].values()
            found = [finding for rule in rules for finding in rule.findings(subject)]
            checks.append(Check("magtwin", tuple(found), scope=f"{len(rules)} rules"))
        assets = robot_assets(subject)
    except (Tf.ErrorException, UnicodeError, MemoryError) as error:
        raise InputError(f"{file}: cannot be opened as USD; it is damaged, cut short, or not USD") from error
    finally:
        diagnostics.TakeUncoalescedDiagnostics()
    return {
        "checks": [asdict(check) for check in checks],
        "robots": {prim: None if asset is None else str(asset) for prim, asset in assets.items()},
    }


def _read_all(layer: Any) -> None:
    """Read every value of a layer, so that a damaged one crashes this process and no other."""

    def visit(path: Any) -> None:
        if path.IsPropertyPath():
            layer.GetObjectAtPath(path).GetInfo("default")
            for time in layer.ListTimeSamplesForPath(path):
                layer.QueryTimeSample(path, time)

    layer.Traverse("/", visit)


def _core(stage: Any) -> Check:
    """Check a stage with OpenUSD's own validators."""
    from pxr import Usd, UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    findings = []
    for error in UsdValidation.ValidationContext(validators).Validate(stage):
        kind = error.GetType()
        types = UsdValidation.ValidationErrorType
        severity: Any = {types.Error: "error", types.Warn: "warning"}.get(kind, "note")
        places = [site.GetPrim().GetPath() for site in error.GetSites() if site.GetPrim()]
        text = " ".join(error.GetMessage().split())
        findings.append(Finding(error.GetName(), text, str(places[0]) if places else "", "", severity))
    findings.sort(key=lambda finding: (finding.rule, finding.where, finding.text))
    version = ".".join(map(str, Usd.GetVersion()[1:]))
    return Check("core", tuple(findings), scope=f"{len(validators)} validators of OpenUSD {version}")


def main(job_file: str) -> None:
    """Do the job of a file, and write its answer."""
    job = json.loads(Path(job_file).read_text(encoding="utf-8"))
    try:
        answer = _look(job)
    except InputError as error:
        answer = {"refused": str(error)}
    Path(job["answer"]).write_text(json.dumps(answer), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1])
