"""`magtwin validate`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force
from magtwin.cli.terminal import Done, announce, check_output, print_error, printable, stdout_console

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

    check_output(out, (".json",), "a report", force=force)

    def validated(file: Path) -> "Findings":
        def report(validator: str) -> None:
            announce(f"{file.name}: {validator}")

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
    return Done(table=lambda: _print(found), data=tables, status=int(failed))


def _print(found: "list[Findings]") -> None:
    """Print a table per file, a row per validator, and below it the findings, errors first."""
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    console = stdout_console()
    for findings in found:
        console.print(Text(printable(str(findings.file)), style="bold"))
        table = Table(box=None, pad_edge=False)
        for column in ("validator", "result"):
            table.add_column(column, no_wrap=True)
        for severity in SEVERITIES:
            table.add_column(f"{severity}s", justify="right", no_wrap=True)
        table.add_column("looked at", overflow="fold")
        for check in findings.checks:
            counts = ["" if check.not_run else str(check.count(severity)) for severity in SEVERITIES]
            scope = Text(printable(check.not_run or check.scope))
            table.add_row(check.validator, check.result, *counts, scope)
        console.print(table)
        for check in findings.checks:
            for line in _lines(check):
                console.print(Padding(Text(line), (0, 0, 0, 2), expand=False))


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
