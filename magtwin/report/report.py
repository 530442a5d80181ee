"""Report: numbers with unit, spread and provenance, for people and for scripts."""

import json
from dataclasses import dataclass, field
from typing import Any

from magtwin.report.summary import LINES, Summarized, Summary


@dataclass(frozen=True)
class Figure:
    """One number or word of a report."""

    name: str
    value: float | int | str | bool
    unit: str = ""
    spread: float | None = None
    """Standard deviation in the same unit, or None."""

    note: str = ""
    """Its source or meaning."""


@dataclass(frozen=True, repr=False)
class Report(Summarized):
    """A titled list of figures, with metadata of what it describes."""

    title: str
    figures: tuple[Figure, ...] = ()
    metadata: dict[str, Any] = field(default_factory=dict)
    verdict: str = ""
    """A judgement in one line; see `magtwin.report.verdict`."""

    def to_json(self) -> str:
        """The report as one JSON object; a figure becomes {value, unit, spread, note}."""
        figures = {
            f.name: {k: v for k, v in vars(f).items() if k != "name" and v not in ("", None)}
            for f in self.figures
        }
        content = {"title": self.title, "figures": figures, "metadata": self.metadata}
        return json.dumps(content | ({"verdict": self.verdict} if self.verdict else {}), indent=2)

    def _summary(self) -> Summary:
        """The figures; a notebook also shows the metadata."""
        metadata = [(str(name), str(value)) for name, value in self.metadata.items()]
        count = f" ({len(self.figures)} figures)" if len(self.figures) >= LINES else ""
        return Summary(
            f"{self.title}{count}",
            (("verdict", self.verdict), *((f.name, _text(f)) for f in self.figures)),
            ("fact", "value"),
            metadata,
        )


def _text(figure: Figure) -> str:
    value = figure.value
    number = f"{value:,.6g}" if isinstance(value, int | float) and not isinstance(value, bool) else str(value)
    spread = "" if figure.spread is None else f" +- {figure.spread:,.4g}"
    return f"{number}{spread} {figure.unit}".rstrip() + (f"  ({figure.note})" if figure.note else "")
