"""Report: numbers with unit, spread and provenance, for people and for scripts."""

import json
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Figure:
    """One number (or word) of a report."""

    name: str
    value: float | int | str | bool
    unit: str = ""
    spread: float | None = None
    """Standard deviation, in the same unit, where there is one."""
    note: str = ""
    """Where it comes from, or what it means."""


@dataclass(frozen=True)
class Report:
    """A titled list of figures, with the facts that they rest on."""

    title: str
    figures: tuple[Figure, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)
    verdict: str = ""
    """Whether what it is of is any good, in one line; see `magtwin.verdict`."""

    def to_json(self) -> str:
        """The report as one JSON object; a figure becomes {value, unit, spread, note}."""
        figures = {
            f.name: {k: v for k, v in vars(f).items() if k != "name" and v not in ("", None)}
            for f in self.figures
        }
        told = {"title": self.title, "figures": figures, "facts": self.facts}
        return json.dumps(told | ({"verdict": self.verdict} if self.verdict else {}), indent=2)
