"""`magtwin validate`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force
from magtwin.cli.terminal import Done, named, print_error, printable, step
from magtwin.report.summary import aligned

if TYPE_CHECKING:
    from magtwin.export.validation.findings import Check, Findings, Severity

Validator = Literal["core", "nvidia", "simready", "isaac", "magtwin"]

MOST = 12
"""Findings of one validator that are printed; the JSON has all."""

SEVERITIES: tuple["Severity", ...] = ("error", "warning", "note")


@app.command
def validate(
    *files: Annotated[Path, Parameter(required=True)],
    against: Annotated[list[Validator] | None, Parameter(consume_multiple=True)] = None,
    out: Path | None = None,
    force: Force = False,
) -> Done:
    """Validate stages against the rules of OpenUSD, NVIDIA, SimReady, Isaac Sim and magtwin.

    Exit status: 0 if no error was found, else 1. A validator that is not installed is skipped and does not
    count as passed; it is an error if --against names it.

    Parameters
    ----------
    files
        Stages (.usd, .usda, .usdc or .usdz).
    against
        Validators to use, one or several: core nvidia simready isaac magtwin. Default: all.
    out
        Report to write (.json), with all findings.
    """
    from json import dumps

    from magtwin.export.validation.validate import AGAINST
    from magtwin.export.validation.validate import validate as check
    from magtwin.files.kinds import shipped_or
    from magtwin.files.outputs import output
    from magtwin.learn.data.features import FEATURES

    out = out and named(out, (".json",), "a report", force=force)

    def validated(file: Path) -> "Findings":
        def report(validator: str) -> None:
            step(f"Checking {file.name} by {validator}")

        return check(file, against or AGAINST, inputs=FEATURES, progress=report)

    found = [validated(shipped_or(file)) for file in files]
    tables = [findings.table() for findings in found]
    if out is not None:
        with output(out, force=force) as aside:
            aside.write_text(dumps(tables, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    skipped = [check for findings in found for check in findings.checks if against and check.not_run]
    if skipped:
        print_error(f"asked for and not run: {skipped[0].validator}: {skipped[0].not_run}")
    failed = bool(skipped) or not all(findings.clean for findings in found)
    told = [_lines_of(findings) for findings in found]
    lines = [*(verdict for verdict, *_ in told), *(line for _, *lines in told for line in lines)]
    return Done(lines=lines, wrote=out or (), data=tables, rest=str(out or ""), status=int(failed))


def _lines_of(findings: "Findings") -> list[str]:
    """The verdict on a file, a line for each validator, and the findings, errors first."""
    rows = []
    for check in findings.checks:
        counts = [f"{n} {severity}s" for severity in SEVERITIES if (n := check.count(severity))]
        said = check.not_run or ", ".join(counts) or "nothing found"
        rows.append((f"  {check.validator}", check.result, f"{said}; {check.scope}" if check.scope else said))
    ran = [check.validator for check in findings.checks if not check.not_run]
    verdict = f"{findings.file}: {'passed' if findings.clean else 'FAILED'} the rules of {', '.join(ran)}"
    found = [f"  {line}" for check in findings.checks for line in _lines(check)]
    return [verdict, *aligned(rows), *found]


def _lines(check: "Check") -> list[str]:
    """The first findings of a validator, one line each, and how many more there are."""
    found = sorted(check.findings, key=lambda finding: SEVERITIES.index(finding.severity))
    lines = []
    for finding in found[:MOST]:
        where = f" {finding.where}" if finding.where else ""
        advice = f"; {finding.advice}" if finding.advice else ""
        head = f"{finding.severity} {check.validator} {finding.rule}{where}"
        lines.append(printable(f"{head}: {finding.text}{advice}"))
    if len(found) > MOST:
        lines.append(f"and {len(found) - MOST} more of {check.validator}; --json prints all")
    return lines
