"""Findings of validators about a file, each with the prim and advice."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """One thing that a validator found."""

    rule: str
    """Name of the rule that found it."""

    text: str
    """What is wrong."""

    where: str = ""
    """Path of the prim, or name of the file; "" for the whole stage."""

    advice: str = ""
    """What to do; "" if the text has it."""

    severity: Severity = "error"
    """An error must be fixed before others get the file; a warning may stay; a note is information."""


@dataclass(frozen=True)
class Check:
    """The result of one validator."""

    validator: str
    """Its name, with version or profile if it has one."""

    findings: tuple[Finding, ...] = ()

    not_run: str = ""
    """Why it was not run; "" if it was."""

    scope: str = ""
    """What it checked, such as "30 validators"."""

    def count(self, severity: Severity) -> int:
        """Number of findings of that severity."""
        return sum(finding.severity == severity for finding in self.findings)

    @property
    def result(self) -> str:
        """Verdict: 'not run', 'failed' if there is an error, else 'passed'."""
        if self.not_run:
            return "not run"
        return "failed" if self.count("error") else "passed"


@dataclass(frozen=True)
class Findings:
    """The results of all validators for a file."""

    file: Path

    checks: tuple[Check, ...]

    def count(self, severity: Severity) -> int:
        """Number of findings of that severity."""
        return sum(check.count(severity) for check in self.checks)

    @property
    def clean(self) -> bool:
        """Whether no validator found an error."""
        return not self.count("error")

    def table(self) -> dict[str, Any]:
        """All results as plain data."""
        return {
            "file": str(self.file),
            "clean": self.clean,
            "errors": self.count("error"),
            "warnings": self.count("warning"),
            "checks": [{"result": check.result, **asdict(check)} for check in self.checks],
        }

    def to_json(self) -> str:
        """All results as one JSON object."""
        return json.dumps(self.table(), indent=2, ensure_ascii=False)


def check_from(table: Mapping[str, Any]) -> Check:
    """A check from its plain data."""
    given = {key: value for key, value in table.items() if key not in ("findings", "result")}
    return Check(findings=tuple(Finding(**finding) for finding in table["findings"]), **given)
