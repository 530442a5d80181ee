"""Summary: the display of an object, in five lines at a prompt and as a table in a notebook."""

import math
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, is_dataclass
from html import escape
from typing import Any

WIDTH = 98
"""Most characters of a line. Five lines then have at most 500."""

LINES = 5
"""Most lines of a repr, with the title."""

MOST_CELLS = 200
"""Most rows of a notebook's table."""

_QUOTED = 40
"""Most characters of a text among other fields."""


@dataclass(frozen=True)
class Summary:
    """A title with labelled lines of text."""

    title: str
    """The class and the name of the object, in one line."""

    rows: tuple[tuple[str, str], ...] = ()
    """Labels and texts. A prompt shows the first four, a notebook all of them."""

    heads: tuple[str, ...] = ()
    """Column heads of a table that a notebook shows folded; () for no table."""

    cells: Sequence[tuple[str, ...]] = ()
    """Rows of that table."""

    def text(self) -> str:
        """The summary in at most five lines of at most 98 characters."""
        rows = [(printable(label), printable(text)) for label, text in self.rows if text]
        rows = rows[: LINES - 1]
        wide = max((len(label) for label, _ in rows), default=0)
        lines = [printable(self.title), *(f"  {label:<{wide}}  {text}" for label, text in rows)]
        return "\n".join(clipped(line.rstrip(), WIDTH) for line in lines)

    def html(self) -> str:
        """The summary as HTML; every text is escaped, as names come from files."""
        parts = [f"<div><strong>{_cell(self.title)}</strong>"]
        if self.rows:
            parts.append(_table((), [row for row in self.rows if row[1]]))
        if self.cells:
            shown, left = self.cells[:MOST_CELLS], len(self.cells) - MOST_CELLS
            more = f"<p>and {left:,} more</p>" if left > 0 else ""
            plural = "s" if len(self.cells) != 1 else ""
            parts.append(
                f"<details><summary>{len(self.cells):,} {_cell(self.heads[0])}{plural}</summary>"
                f"{_table(self.heads, shown)}{more}</details>"
            )
        return "".join([*parts, "</div>"])


class Summarized:
    """Gives a class a repr of at most five lines and an HTML view, both from its `_summary`.

    A dataclass needs `repr=False`. By default, its fields are listed, arrays by their shapes.
    """

    def _summary(self) -> Summary:
        kind = type(self).__name__
        if not is_dataclass(self):
            return Summary(kind)
        texts = [f"{f.name}={_short(getattr(self, f.name, None))}" for f in fields(self) if f.repr]
        lines = [""]
        for text in texts:
            joined = f"{lines[-1]}, {text}" if lines[-1] else text
            if len(joined) > WIDTH - 4 and lines[-1]:
                lines[-1] += ","
                lines.append(text)
            else:
                lines[-1] = joined
        return Summary(kind, tuple(("", line) for line in lines))

    def __repr__(self) -> str:
        return self._summary().text()

    def _repr_html_(self) -> str:
        return self._summary().html()


def printable(text: object) -> str:
    """A text in one line, with control characters escaped."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in str(text))


def printable_lines(text: object) -> str:
    """A text whose lines are `printable`, but for tabs: what goes to a terminal, as names come from files.

    Control characters could move the cursor, change colours or titles, or set the direction of the text, so
    that it reads as another.
    """
    return "".join(c if c.isprintable() or c in "\n\t" else repr(c)[1:-1] for c in str(text))


def in_markdown(text: object) -> str:
    """A text in one line of a Markdown page, with the characters escaped that have a meaning there."""
    return re.sub(r"([\\`*\[\]<>|!#~$]|(?<!\w)_|_(?!\w))", r"\\\1", printable(text))


def aligned(rows: Sequence[Sequence[str]], *, right: Collection[int] = ()) -> list[str]:
    """Rows of texts as lines with columns; the last column has no width, and those of `right` end alike."""
    rows = [[printable(text) for text in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = (
        "  ".join(
            text.rjust(width) if c in right else text.ljust(width)
            for c, (text, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    )
    return [line.rstrip() for line in lines]


def clipped(text: str, most: int) -> str:
    """A text of at most `most` characters; a longer one ends in "..."."""
    return text if len(text) <= most else text[: most - 3] + "..."


def listed(names: Collection[str], most: int = 60) -> str:
    """Names in a line of about `most` characters, and the number of names left out."""
    shown: list[str] = []
    length = 0
    for name in names:
        if shown and length + len(name) > most:
            return f"{', '.join(shown)} and {len(names) - len(shown):,} more"
        shown.append(clipped(name, most))
        length += len(name) + 2
    return ", ".join(shown)


def span(low: float, high: float, unit: str = "", *, form: str = ",.0f") -> str:
    """Two bounds with their unit, as "47,301 to 53,020 nT"; "unknown" if they are not finite."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return "unknown"
    return f"{low:{form}} to {high:{form}} {unit}".rstrip()


def rectangle(x0: float, x1: float, y0: float, y1: float) -> str:
    """An extent along x and y in metres."""
    return f"x {x0:z.2f} to {x1:z.2f} m, y {y0:z.2f} to {y1:z.2f} m"


def _short(value: Any) -> str:
    """The value of a field as a short text."""
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype} {tuple(value.shape)}"
    if isinstance(value, Summarized):
        return value._summary().title
    if isinstance(value, str):
        return clipped(repr(value), _QUOTED)
    if isinstance(value, Collection) and (len(value) > 4 or not isinstance(value, list | tuple)):
        return f"{len(value):,} items"
    if isinstance(value, list | tuple):
        return clipped(f"({', '.join(map(_short, value))})", _QUOTED)
    if value is None or isinstance(value, bool | int | float | complex):
        return repr(value)
    return type(value).__name__


def _cell(text: object) -> str:
    return escape(printable(text))


def _table(heads: Sequence[str], rows: Sequence[tuple[str, ...]]) -> str:
    left = ' style="text-align:left;vertical-align:top;padding-right:1em"'
    text_cell = f'{left[:-1]};overflow-wrap:anywhere"'  # checksums and paths are longer than a narrow page
    lines = ["<table>"]
    if heads:
        lines.append(f"<tr>{''.join(f'<th{left}>{_cell(head)}</th>' for head in heads)}</tr>")
    for label, *rest in rows:
        cells = "".join(f"<td{text_cell}>{_cell(text)}</td>" for text in rest)
        lines.append(f"<tr><th{left}>{_cell(label)}</th>{cells}</tr>")
    return "".join([*lines, "</table>"])
