"""Report: numbers with unit, spread and provenance, for people and for scripts."""

import json
import math
import re
from dataclasses import dataclass, field
from typing import Any

from magtwin.report.summary import LINES, Summarized, Summary

_NUMBER = r"[+-]?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e[+-]?\d+)?"
_NUMBERS = re.compile(rf"\(?(?:x )?{_NUMBER}(?:(?:, [xyz ]*| x | to | of |\.\.| ){_NUMBER})*\)?")
"""A text of numbers, such as a place or a range."""


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
        """The report as one JSON object: figures by names that end in their unit, and their notes.

        `Figure("distance driven", 14.7, "m")` is `"distance_driven_m": 14.7`. A spread is a figure of its
        own: `"b_total_sd_nt": 2370.0` beside `"b_total_nt"`.
        """
        figures, notes = dict[str, Any](), dict[str, str]()
        for f in self.figures:
            name = key(f.name, f.unit)
            figures[name] = f.value
            if f.spread is not None:
                figures[key(f"{f.name.removesuffix('_nt')} sd", f.unit)] = f.spread
            notes |= {name: f.note} if f.note else {}
        facts = {key(name): value for name, value in self.metadata.items()}
        content: dict[str, Any] = {"title": self.title} | ({"verdict": self.verdict} if self.verdict else {})
        content |= {"figures": figures, "notes": notes, "metadata": facts}
        return json.dumps(jsonable(content), indent=2)

    def _summary(self) -> Summary:
        """The figures; a notebook also shows the metadata."""
        metadata = [(str(name), str(value)) for name, value in self.metadata.items()]
        count = f" ({len(self.figures)} figures)" if len(self.figures) >= LINES else ""
        rows = (("verdict", self.verdict), *((f.name, _text(f)) for f in self.figures))
        return Summary(f"{self.title}{count}", rows, ("fact", "value"), metadata)


def key(name: str, unit: str = "") -> str:
    """A name as a key of JSON: words of small letters and digits, and the unit at the end."""
    words, ending = (
        re.sub(r"[^a-z0-9]+", "_", text.replace("%", " percent ").lower()).strip("_") for text in (name, unit)
    )
    return words if f"_{words}".endswith(f"_{ending}") or not ending else f"{words}_{ending}"


def jsonable(content: Any, name: str = "") -> Any:
    """Content that JSON has: null for numbers that are not finite, and numbers for texts of numbers."""
    if isinstance(content, dict):
        return {str(key): jsonable(value, str(key)) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [jsonable(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    if isinstance(content, str) and _NUMBERS.fullmatch(content):
        found = [float(number.replace(",", "")) for number in re.findall(_NUMBER, content)]
        one = found[0] if re.search("_([msva]|nt|hz|deg|rad|kg)$", name) else content
        return found if len(found) > 1 else one
    if hasattr(content, "tolist"):  # a numpy number or array
        return jsonable(content.tolist())
    return content if content is None or isinstance(content, str | int | float) else str(content)


def _text(figure: Figure) -> str:
    value = figure.value
    number = f"{value:,.6g}" if isinstance(value, int | float) and not isinstance(value, bool) else str(value)
    spread = "" if figure.spread is None else f" +- {figure.spread:,.4g}"
    return f"{number}{spread} {figure.unit}".rstrip() + (f"  ({figure.note})" if figure.note else "")
