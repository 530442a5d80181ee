"""Run Isaac Sim's rule files on stages, in a separate process: they are code of another project.

    python -m magtwin.export.validation.isaac_run JOB.json

`isaac_sim` starts it. The job names a folder with the rule files, the stage, and the assets of its robots.
"""

import importlib
import json
import re
import sys
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pxr import Sdf, Usd, UsdUtils

from magtwin.export.validation import kit_stand_ins
from magtwin.export.validation.findings import Finding
from magtwin.export.validation.kit_stand_ins import BaseRuleChecker, NeedsKitError

PACKAGE = "isaacsim.asset.validation"

ROBOT_RULES = "IsaacSim.RobotRules"
"""Category of the rules for the asset of a robot; the others are for any stage."""

STRUCTURE_RULES = (
    "NoOverrides",
    "VerifyRobotPhysicsAttributesSourceLayer",
    "VerifyRobotPhysicsSchemaSourceLayer",
)
"""Rules for the layers of Isaac Sim's asset structure. In an asset of one layer they find every prim."""

FOLDER_RULES = ("CleanFolder", "RobotNaming", "ThumbnailExists")
"""Rules for the folder of an asset."""

MISTAKEN = {
    "MimicAPICheck": (
        re.compile(r"'s (lower|upper) limit \("),
        "its comparison of limits does not apply: its sign is wrong, since PhysX holds q + gearing q_leader "
        "+ offset = 0, so a follower moves by -gearing times its leader",
    )
}
"""Findings of rules that contradict PhysX: a pattern of their texts, and the reason to leave them out."""

NO_ROBOT = "the stage has no robot in a separate asset"
ONE_LAYER = (
    "the robot is in one layer; `magtwin robot` without --single-file, or `magtwin export --target isaac`, "
    "makes the layers of Isaac Sim's asset structure, which these rules check"
)
PACKED = "a package has no folder"


def main(job_file: str) -> None:
    """Do the job of a file, and write its answer."""
    job = json.loads(Path(job_file).read_text(encoding="utf-8"))
    kit_stand_ins.install()
    sys.path.insert(0, job["rules"])
    importlib.import_module(PACKAGE)
    diagnostics = UsdUtils.CoalescingDiagnosticDelegate()  # keeps USD's messages off the terminal
    stage, robots = Path(job["stage"]), {Path(asset): prim for asset, prim in job["robots"]}
    held = [Usd.Stage.Open(str(file)) for file in (stage, *robots)]  # keeps their layers in memory
    findings: dict[tuple[str, str], list[Finding]] = {}
    skipped: dict[str, str] = {}
    for category, rule in kit_stand_ins.REGISTERED:
        name = rule.__name__
        subjects = list(robots) if category == ROBOT_RULES else [stage, *(r for r in robots if r != stage)]
        if not subjects:
            skipped[name] = NO_ROBOT
        elif name in FOLDER_RULES and job["packed"]:
            skipped[name] = PACKED
            continue
        for file in subjects:
            if name in STRUCTURE_RULES and not _structured(file):
                skipped[name] = ONE_LAYER
                continue
            try:
                found = _findings(rule(), file, robots.get(file, ""))
            except NeedsKitError as error:
                skipped[name] = f"needs Isaac Sim itself ({error})"
                break
            new = {key: group for key, group in found.items() if key not in findings}
            findings |= new  # a robot's prim is in its asset and, by reference, on the stage
    del held
    diagnostics.TakeUncoalescedDiagnostics()
    answer = {
        "findings": [asdict(finding) for group in findings.values() for finding in group],
        "rules": len(kit_stand_ins.REGISTERED),
        "skipped": skipped,
    }
    Path(job["answer"]).write_text(json.dumps(answer), encoding="utf-8")


def _structured(asset: Path) -> bool:
    """Whether the root layer of an asset only composes others."""
    stage = Usd.Stage.Open(str(asset))
    robot = stage.GetDefaultPrim()
    return bool(robot) and robot.HasAuthoredReferences() and robot.HasAuthoredPayloads()


def _findings(rule: BaseRuleChecker, file: Path, robot: str) -> dict[tuple[str, str], list[Finding]]:
    """What a rule finds in a stage, by rule and prim.

    The stage is opened for the rule alone, since a rule may write to its session layer.

    Args:
        rule: A new instance.
        file: The stage, or the asset of a robot.
        robot: Prim of the robot on the stage, if the file is its asset. Its variants are checked too.

    Raises:
        NeedsKitError: The rule needs what has no stand-in.
    """
    stage, name = Usd.Stage.Open(str(file)), type(rule).__name__
    views = list(_variants(stage)) if robot else [stage]  # kept in a variable: the issues name their prims
    try:
        if type(rule).CheckStage is not BaseRuleChecker.CheckStage:
            rule.CheckStage(stage)
        if type(rule).CheckPrim is not BaseRuleChecker.CheckPrim:
            for view in views:
                for prim in Usd.PrimRange.Stage(view, Usd.TraverseInstanceProxies()):
                    rule.CheckPrim(prim)
    except NeedsKitError:
        raise
    except Exception as error:  # code of another project may fail in any way
        text = f"the rule failed: {type(error).__name__}: {' '.join(str(error).split())[:200]}"
        return {(name, robot): [Finding(name, text, robot)]}
    own = stage.GetDefaultPrim().GetPath() if robot and stage.GetDefaultPrim() else None
    found: dict[tuple[str, str], list[Finding]] = {}
    for issue in rule.issues:
        path = _place(issue.at)
        where = robot if path is None else str(path if own is None else path.ReplacePrefix(own, robot))
        text = " ".join(issue.text.split())
        pattern, why = MISTAKEN.get(name, (None, ""))
        if pattern is not None and pattern.search(text):
            found["not-run", name] = [Finding("not-run", f"{name}: {why}", severity="note")]
            continue
        found.setdefault((name, where), []).append(Finding(name, text, where, issue.advice, issue.severity))
    return found


def _variants(stage: Usd.Stage) -> Iterable[Usd.Stage]:
    """The stage as it is, then in each variant of its default prim."""
    yield stage
    robot = stage.GetDefaultPrim()
    for name in robot.GetVariantSets().GetNames() if robot else ():
        chosen = robot.GetVariantSet(name).GetVariantSelection()
        for other in robot.GetVariantSet(name).GetVariantNames():
            if other != chosen:
                session = Usd.Stage.Open(stage.GetRootLayer())
                with Usd.EditContext(session, session.GetSessionLayer()):
                    session.GetDefaultPrim().GetVariantSet(name).SetVariantSelection(other)
                yield session


def _place(at: Any) -> Sdf.Path | None:
    """Path of the prim of an issue; None for the whole stage."""
    return None if at is None or hasattr(at, "GetRootLayer") else at.GetPath().GetPrimPath()


if __name__ == "__main__":
    main(sys.argv[1])
