"""Page: titled sections of pictures and tables, written as HTML or JSON.

An HTML page is one file with its pictures inside. It loads nothing and runs no script, and text from files,
such as metadata and names, is escaped.
"""

import base64
import html
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from magtwin.errors import InputError
from magtwin.figures.canvas import Picture
from magtwin.figures.player import Player
from magtwin.figures.style import CSS, inline_svg
from magtwin.files.outputs import output
from magtwin.report.summary import printable, printable_lines
from magtwin.version import __version__

LONGEST_TEXT = 500
"""Characters of a cell that a page shows. JSON holds all of them."""

PICTURES = "figures"
"""Folder of the pictures beside a page."""

LONG_CELL = 24
"""Characters above which a table gives a cell's column more width."""


class Cell(NamedTuple):
    """A cell of an HTML table."""

    label: str
    """Head of its column, which phones show beside the text."""

    text: str
    kind: str
    """CSS class: "number", "long" or ""."""


@dataclass(frozen=True)
class Table:
    """Rows of text and numbers under a head; the first column names the row."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    note: str = ""
    exact: bool = False
    """Whether numbers are shown as they are: a seed of 1234 not as "1,234". Such a table is folded."""

    folded: bool = False
    """Whether only its title is shown until it is opened."""

    def columns(self) -> Iterator[tuple[str, bool]]:
        """Head of each column, and whether the column is aligned as numbers."""
        for name, values in zip(self.head, zip(*self.rows, strict=True), strict=True):
            yield name, not self.exact and any(map(_is_number, values))

    def cells(self) -> list[list[Cell]]:
        """Rows of cells as text."""
        return [[self._cell(*pair) for pair in zip(self.head, row, strict=True)] for row in self.rows]

    def _cell(self, head: str, value: Any) -> Cell:
        if self.exact:
            return Cell(head, text_of(str(value)), "")
        kind = "number" if _is_number(value) else "long" if len(str(value)) > LONG_CELL else ""
        return Cell(head, text_of(value), kind)


@dataclass(frozen=True)
class Section:
    """A part of a page."""

    title: str
    lead: str = ""
    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()


@dataclass(frozen=True)
class Still:
    """A small picture that leads to a run."""

    picture: Picture
    link: str
    name: str


@dataclass(frozen=True)
class Page:
    """The content of a page, independent of its format."""

    title: str
    lead: str
    sections: tuple[Section, ...]
    overview: Table | None = None
    """One row per section, if there are several."""

    data: Mapping[str, Any] = field(default_factory=dict)
    """Content of the JSON form."""

    player: Player | None = None
    """What plays the run in its lab, above the sections; only HTML has it."""

    stills: tuple[Still, ...] = ()
    """Small pictures of the runs, above the overview; only HTML has them."""

    verdict: str = ""
    """What the page says, in one or a few lines; shown first."""

    figures: Sequence[tuple[str, str]] = ()
    """What is in it in about five figures, each with its name."""


@dataclass(frozen=True, repr=False)
class Embedded:
    """A page for a notebook, in a frame of its own that can reach nothing outside of it."""

    page: str
    height: int
    """Height of the frame [pixels]."""

    def __repr__(self) -> str:
        return f"Page of {len(self.page) / 1000:,.0f} kB; a notebook shows it"

    def _repr_html_(self) -> str:
        look = f"width: 100%; height: {self.height}px; border: 0"
        frame = f'<iframe sandbox="allow-scripts" loading="lazy" title="A run" style="{look}"'
        return f'{frame} srcdoc="{html.escape(self.page)}"></iframe>'


def write_page(page: Page, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a page as .html or .json, whichever its file name ends in.

    Raises:
        InputError: The name has another ending, or the file exists and `force` was not given.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise InputError(f"{path}: a report ends in {', '.join(WRITERS)}")
    text = WRITERS[suffix](page)
    with output(path, force=force) as aside:
        aside.write_text(text, encoding="utf-8")


def write_pages(page: Page, folder: str | os.PathLike[str], name: str, *, force: bool = False) -> None:
    """Write a page as a folder: NAME.html and .json, and its pictures in figures/.

    Raises:
        InputError: The folder exists and `force` was not given.
    """
    with output(folder, force=force) as aside:
        (aside / PICTURES).mkdir(parents=True)
        for section in page.sections:
            for k, picture in enumerate(section.pictures):
                file = aside / PICTURES / f"{picture.file or f'picture_{k}'}.{picture.kind}"
                file.write_bytes(picture.data)
        for suffix, writer in WRITERS.items():
            (aside / f"{name}{suffix}").write_text(writer(page), encoding="utf-8")


def to_html(page: Page, links: Sequence[str] = ()) -> str:
    """A page as one HTML file; its overview leads to `links`, by default to its sections."""
    links = links or [f"#run-{k}" for k in range(len(page.sections))]
    return _TEMPLATES.get_template("page.html").render(page=page, links=links, css=CSS, version=__version__)


def to_json(page: Page) -> str:
    """The data of a page as JSON; numbers that are not finite become null."""
    head = {"magtwin": __version__, "title": page.title}
    head |= {"verdict": page.verdict} if page.verdict else {}
    return json.dumps(_finite({**head, **page.data}), indent=2) + "\n"


WRITERS: Mapping[str, Callable[[Page], str]] = {".html": to_html, ".json": to_json}
"""Formats of a page by file name ending."""


def text_of(value: Any) -> str:
    """A value as text: numbers to four digits, text without control characters and of limited length."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{value:,}"
    if isinstance(value, float | np.floating):
        number = float(value)
        if abs(number) >= 1000 and math.isfinite(number):
            return f"{number:,.0f}"
        return "0" if number == 0 else f"{number:.4g}"
    text = printable(value)
    return text if len(text) <= LONGEST_TEXT else text[:LONGEST_TEXT] + "…"


def _is_number(value: Any) -> bool:
    """Whether a cell is aligned as a number: a number, or text such as "212.9 (0.493)"."""
    if isinstance(value, str):
        return re.fullmatch(r"[+-]?\d{1,3}(,?\d{3})*(\.\d+)?( ?%| \(.*\))?", value) is not None
    return isinstance(value, int | float) and not isinstance(value, bool)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _drawn(picture: Picture, prefix: str) -> str:
    """A picture as HTML: an SVG as a part of the page, whose colours follow it; a PNG as an image."""
    alt = escape(printable(picture.alt))
    if picture.kind == "svg":
        return inline_svg(picture.data, prefix).replace("<svg", f'<svg role="img" aria-label="{alt}"', 1)
    return f'<img alt="{alt}" src="data:image/{picture.kind};base64,{_base64(picture.data)}">'


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def _shown(value: Any) -> Any:
    """A value for a page; a text without control characters. Jinja escapes it for HTML."""
    return printable_lines(value) if type(value) is str else value


_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent),
    autoescape=True,
    trim_blocks=True,
    lstrip_blocks=True,
    undefined=StrictUndefined,
    finalize=_shown,
)
_TEMPLATES.filters |= {"text": text_of, "base64": _base64, "drawn": _drawn}
