"""`magtwin validate`: files held to every validator there is."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force, Json
from magtwin.cli.terminal import announce, check_suffix, printable, say, stdout_console
from magtwin.errors import InputError

if TYPE_CHECKING:
    from magtwin.export.validation.findings import Check, Findings, Severity

Validator = Literal["core", "nvidia", "simready", "isaac", "newton", "magtwin"]
Asked = Literal["map-checksum", "map-file", "network-file"]

MOST = 12
"""Findings of one validator that are shown; the JSON has all."""

SEVERITIES: tuple["Severity", ...] = ("error", "warning", "note")


@app.command
def validate(
    *files: Path,
    against: Annotated[list[Validator] | None, Parameter(consume_multiple=True, negative="")] = None,
    fix: Annotated[bool, Parameter(negative="")] = False,
    fix_also: Annotated[list[Asked] | None, Parameter(consume_multiple=True, negative="")] = None,
    out: Path | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Hold stages to OpenUSD's, NVIDIA's, SimReady's and Isaac Sim's rules, to Newton, and to magtwin's own.

    Exit status 0 where no error was found, 1 otherwise. A validator that is not installed is not run, and
    never counts as passed; one that was asked for by --against and could not be run is an error.

    Parameters
    ----------
    files
        Stages, .usd, .usda, .usdc or .usdz.
    against
        What to hold them to, several after one another: core nvidia simready isaac newton magtwin; all of
        them unless given.
    fix
        Mend first what is safe: the default prim, units that nobody says, absolute paths, extents, bindings.
    fix_also
        Mend checksums too, by name: map-checksum, map-file, network-file. They then accept the
        files as they are.
    out
        Where to write it all, a .json file.
    force
        Replace that file if it exists.
    json
        Print it as JSON.
    """
    from magtwin.export.validation.validate import AGAINST, SAFE, validate
    from magtwin.files import check_free, output
    from magtwin.learn.data.features import FEATURES

    if not files:
        raise InputError("validate needs a file; name a stage")
    if out is not None:
        check_suffix(out, (".json",), "a report")
        check_free(out, force=force)
    fixes = [*(SAFE if fix else ()), *(fix_also or ())]
    wanted = against or AGAINST
    found: list[Findings] = []
    for file in files:
        found.append(validate(file, wanted, inputs=FEATURES, fix=fixes, progress=_announce(file, quiet=json)))
        if not json:
            _print(found[-1])
    if json or out is not None:
        from json import dumps

        text = dumps([findings.table() for findings in found], indent=2, ensure_ascii=False)
        if out is not None:
            with output(out, force=force) as aside:
                aside.write_text(text + "\n", encoding="utf-8")
        if json:
            say(text)
    lacking = [check for f in found for check in f.checks if against and check.not_run]
    if lacking and not json:
        text = f"magtwin: asked for and not run: {lacking[0].validator}: {lacking[0].not_run}"
        print(text, file=sys.stderr)  # noqa: T201
    if lacking or not all(findings.clean for findings in found):
        sys.exit(1)


def _announce(file: Path, *, quiet: bool) -> Any:
    """A function that says which validator looks at a file."""
    steps = announce
    return lambda name: steps(f"{file.name}: {name}")


def _print(findings: "Findings") -> None:
    """A table, a row a validator; below it what each found, errors first."""
    from rich.padding import Padding
    from rich.table import Table
    from rich.text import Text

    console = stdout_console()
    console.print(Text(printable(str(findings.file)), style="bold"))
    for line in findings.mended:
        console.print(Padding(Text(f"mended {printable(line)}"), (0, 0, 0, 2), expand=False))
    table = Table(box=None, pad_edge=False)
    for column in ("validator", "result"):
        table.add_column(column, no_wrap=True)
    for severity in SEVERITIES:
        table.add_column(f"{severity}s", justify="right", no_wrap=True)
    table.add_column("looked at", overflow="fold")
    for check in findings.checks:
        counts = ["" if check.not_run else str(check.count(severity)) for severity in SEVERITIES]
        table.add_row(check.validator, check.result, *counts, Text(printable(check.not_run or check.scope)))
    console.print(table)
    for check in findings.checks:
        for line in _lines(check):
            console.print(Padding(Text(line), (0, 0, 0, 2), expand=False))


def _lines(check: "Check") -> list[str]:
    """Findings of a check, a line each; the last says how many more there are."""
    found = sorted(check.findings, key=lambda finding: SEVERITIES.index(finding.severity))
    lines = []
    for finding in found[:MOST]:
        where = f" {finding.where}" if finding.where else ""
        advice = f"; {finding.advice}" if finding.advice else ""
        what = f"{finding.severity} {check.validator} {finding.rule}{where}: {finding.text}{advice}"
        lines.append(printable(what))
    if len(found) > MOST:
        lines.append(f"and {len(found) - MOST} more of {check.validator}; --json has all")
    return lines
