"""Findings: what validators say of a file, each with the prim and what to do."""

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
    """What to do; "" where the text says it."""

    severity: Severity = "error"
    """An error is mended before others get the file, a warning may stay, a note is nothing to mend."""


@dataclass(frozen=True)
class Check:
    """What one validator said."""

    validator: str
    """Its name, with its version or its profile where it has one."""

    findings: tuple[Finding, ...] = ()

    not_run: str = ""
    """Why it was not run; "" where it was."""

    scope: str = ""
    """What it looked at, such as "30 validators"."""

    def count(self, severity: Severity) -> int:
        """Number of findings of that severity."""
        return sum(finding.severity == severity for finding in self.findings)

    @property
    def result(self) -> str:
        """In a word: "not run", "failed" where there is an error, else "passed"."""
        if self.not_run:
            return "not run"
        return "failed" if self.count("error") else "passed"


@dataclass(frozen=True)
class Findings:
    """What all validators said of a file."""

    file: Path

    checks: tuple[Check, ...]

    mended: tuple[str, ...] = ()
    """What was mended before they looked, one line each."""

    def count(self, severity: Severity) -> int:
        """Number of findings of that severity."""
        return sum(check.count(severity) for check in self.checks)

    @property
    def clean(self) -> bool:
        """Whether no validator that was run found an error."""
        return not self.count("error")

    def table(self) -> dict[str, Any]:
        """All of it as plain data, as the JSON has it."""
        return {
            "file": str(self.file),
            "clean": self.clean,
            "errors": self.count("error"),
            "warnings": self.count("warning"),
            "mended": list(self.mended),
            "checks": [{"result": check.result, **asdict(check)} for check in self.checks],
        }

    def to_json(self) -> str:
        """All of it as one JSON object."""
        return json.dumps(self.table(), indent=2, ensure_ascii=False)


def check_from(table: Mapping[str, Any]) -> Check:
    """A check from its plain data."""
    given = {key: value for key, value in table.items() if key not in ("findings", "result")}
    return Check(findings=tuple(Finding(**finding) for finding in table["findings"]), **given)
