"""Pages: a run, a set of runs, or two laid over each other, told in HTML, Markdown or JSON.

An HTML page is one file: its pictures lie inside, it asks nothing of any other place and runs no script. What
comes from a run's file, its metadata and its name above all, is text in it and nothing else.
"""

import base64
import html
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.figures.charts import Picture, pictures_of_comparison, pictures_of_run, short_names
from magtwin.files import output
from magtwin.run.compare import ERRORS, Agreement, Comparison, errors_of
from magtwin.run.run import COLUMNS, Run
from magtwin.version import __version__

LONGEST_TEXT = 500
"""Characters of a fact that a page shows; JSON holds all of it."""

MOST_SPANS = 12
"""Times at which a flag was raised that a page lists; more are counted."""

AGREEMENT_HEAD = ("mean", "RMS", "mean absolute", "maximum", "readings")


@dataclass(frozen=True)
class Table:
    """Rows of words and numbers under a head; the first column names the row."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Section:
    """A part of a page."""

    title: str
    lead: str = ""
    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()


@dataclass(frozen=True)
class Page:
    """What is to be told, whatever it is written in."""

    title: str
    lead: str
    sections: tuple[Section, ...]
    overview: Table | None = None
    """A row a section, where there are several."""
    data: Mapping[str, Any] = field(default_factory=dict)
    """The same for scripts, without pictures."""


@dataclass(frozen=True)
class Told:
    """A run to be told of."""

    name: str
    """What to call it; the name of its file."""
    run: Run
    field: AnomalyMap | None = None
    """The map below its path, where it is at hand."""
    planned: ArrayLike | None = None
    """The path that was to be driven [m], shape (M, 2), where it is known."""
    note: str = ""
    """What the reader should know of it, such as why its map is not shown."""


def page_of_runs(
    told: Sequence[Told], *, pictures: bool = True, advance: Callable[[int], None] = lambda done: None
) -> Page:
    """A page of one run or of a set.

    Args:
        told: The runs.
        pictures: Whether to draw pictures, which only HTML shows.
        advance: Called with the number of runs that have been drawn.

    Raises:
        InputError: There is no run, or one has no rows.
    """
    if not told:
        raise InputError("no run to report on; name one or more")
    for one in told:
        if not one.run.rows or "t" not in one.run:
            raise InputError(f"{one.name}: has no readings to report on")
    sections, data = [], []
    for k, one in enumerate(told):
        sections.append(_section(one, pictures))
        data.append(_data(one))
        advance(k + 1)
    if len(told) == 1:
        return Page(_title(told[0]), _sentence(told[0].run), (sections[0],), data=data[0])
    rows = tuple(_overview(one) for one in told)
    head = (
        "run",
        "path",
        "seed",
        "readings",
        "duration [s]",
        "distance [m]",
        "MAE [nT]",
        "RMS [nT]",
        "events",
    )
    note = "MAE and RMS: error of b_measured_nt against the exact field, where that is known."
    total = sum(one.run.rows for one in told)
    return Page(
        f"{len(told)} runs",
        f"{total:,} readings in all.",
        tuple(sections),
        Table("Overview", head, rows, note),
        {"runs": data},
    )


def page_of_comparison(a: Told, b: Told, found: Comparison) -> Page:
    """A page of two runs laid over each other."""
    how = {
        "time": f"{b.name} is shifted by {found.shift:+.4f} s, which brings the positions closest.",
        "path": f"Aligned by distance driven; {b.name} is shifted by {found.shift:+.4f} m.",
        "none": "Aligned by the clocks of the runs, unchanged.",
    }[found.align]
    rows = tuple(
        (one.name, one.unit, *_agreement(one), "" if one.correlation is None else f"{one.correlation:.4f}")
        for one in found.agreements()
    )
    table = Table(
        f"{b.name} minus {a.name}",
        ("quantity", "unit", *AGREEMENT_HEAD, "correlation"),
        rows,
        "Along-track: ahead of the first run; cross-track: to its left.",
    )
    pictures = tuple(pictures_of_comparison(a.run, b.run, found, (a.name, b.name)))
    metadata = sorted({*a.run.metadata, *b.run.metadata}, key=lambda name: (name not in a.run.metadata, name))
    differ = tuple(
        (name, a.run.metadata.get(name, ""), b.run.metadata.get(name, ""))
        for name in metadata
        if a.run.metadata.get(name) != b.run.metadata.get(name)
    )
    tables = [table]
    if differ:
        tables.append(Table("Metadata that differ", ("metadata", a.name, b.name), differ))
    return Page(
        " and ".join(short_names((a.name, b.name))),
        f"{a.name} and {b.name}: {len(found.at):,} readings compared. {how}",
        (Section("Comparison", "", pictures, tuple(tables)),),
        data={"a": a.name, "b": b.name, **found.summary(), "metadata": [_metadata(a.run), _metadata(b.run)]},
    )


def write_page(page: Page, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write a page as its name ends: .html, .md or .json.

    Args:
        page: What is to be told.
        path: The file to make.
        force: Whether one that exists is replaced.

    Raises:
        InputError: The name ends otherwise, or the file exists and `force` was not given.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise InputError(f"{path}: a report ends in {', '.join(WRITERS)}")
    text = WRITERS[suffix](page)
    with output(path, force=force) as aside:
        aside.write_text(text, encoding="utf-8")


def _title(one: Told) -> str:
    metadata = one.run.metadata
    path, scene = metadata.get("path"), metadata.get("scene")
    return " ".join([f"Run: {path}" if path else f"Run {one.name}", *([f"in {scene}"] if scene else [])])


def _sentence(run: Run) -> str:
    """What was run, in a line."""
    metadata, words = run.metadata, [f"{run.rows:,} readings in {run.duration_s:,.1f} s"]
    distance = _distance_m(run)
    if distance is not None:
        words.append(f"{distance:,.1f} m driven")
    for fact, text in (
        ("controller", "controller {}"),
        ("engine", "engine {}"),
        ("magnetometer", "{} magnetometer"),
        ("network", "network {}"),
        ("map", "map {}"),
        ("seed", "seed {}"),
    ):
        if fact in metadata:
            words.append(text.format(metadata[fact]))
    return ", ".join(words) + "."


def _section(one: Told, pictures: bool) -> Section:
    run = one.run
    report = run.report()
    figures = tuple(
        (f.name, f.value, "" if f.spread is None else f.spread, f.unit, f.note) for f in report.figures
    )
    tables = [Table("Figures", ("quantity", "value", "standard deviation", "unit", "note"), figures)]
    errors = errors_of(run)
    if errors:
        rows = tuple((name, ERRORS[name][2], *_agreement(errors[name])) for name in errors)
        note = "Each error is the difference of columns: " + "; ".join(
            f"{name} = {' - '.join((ERRORS[name][0], *ERRORS[name][1]))}" for name in errors
        )
        coverage = _coverage(run)
        if coverage is not None:
            note += f". {100 * coverage:.1f} % of the total errors lie within 2 predicted standard deviations"
        head = ("source", "meaning", *(f"{name} [nT]" for name in AGREEMENT_HEAD[:-1]), "readings")
        tables.append(Table("Errors by source", head, rows, note + "."))
    events = tuple((name, doc, count, times) for name, doc, count, times in _events(run))
    tables.append(
        Table("Events", ("flag", "meaning", "readings", "times [s]"), events, "" if events else "None.")
    )
    tables.append(
        Table(
            "Provenance",
            ("metadata", ""),
            tuple(run.metadata.items()),
            "" if run.metadata else "No metadata.",
        )
    )
    drawn = pictures_of_run(run, one.field, one.planned) if pictures else []
    lead = f"{one.name}. {one.note}".strip()
    return Section(_title(one), lead, tuple(drawn), tuple(tables))


def _overview(one: Told) -> tuple[Any, ...]:
    run, metadata = one.run, one.run.metadata
    distance, total = _distance_m(run), errors_of(run).get("total")
    events = sum(int(run[name].any()) for name in run if name.startswith("flag_"))
    return (
        one.name,
        metadata.get("path", ""),
        metadata.get("seed", ""),
        run.rows,
        round(run.duration_s, 1),
        "" if distance is None else round(distance, 1),
        "" if total is None else total.mae,
        "" if total is None else total.rms,
        f"{events} flag{'s' * (events > 1)} raised" if events else "none",
    )


def _data(one: Told) -> dict[str, Any]:
    run = one.run
    figures = json.loads(run.report(one.name).to_json())["figures"]
    return {
        "name": one.name,
        "figures": figures,
        "errors": {
            name: {k: v for k, v in vars(e).items() if k not in ("name", "correlation")}
            for name, e in errors_of(run).items()
        },
        "events": [
            {"flag": name, "readings": count, "spans_s": [list(span) for span in _spans(run, name)]}
            for name, _, count, _ in _events(run)
        ],
        "metadata": _metadata(run),
    }


def _metadata(run: Run) -> dict[str, Any]:
    return dict(run.metadata)


def _agreement(one: Agreement) -> tuple[float, float, float, float, int]:
    return one.mean, one.rms, one.mae, one.greatest, one.count


def _distance_m(run: Run) -> float | None:
    figure = next((f for f in run.report().figures if f.name == "distance driven"), None)
    return None if figure is None else float(figure.value)


def _coverage(run: Run) -> float | None:
    """Share of the predictions whose error lies within twice its predicted standard deviation."""
    if not {"b_sd_nt", "b_total_nt", "b_truth_nt"} <= set(run):
        return None
    error, sd = run["b_total_nt"] - run["b_truth_nt"], run["b_sd_nt"]
    known = np.isfinite(error) & np.isfinite(sd)
    return float(np.mean(np.abs(error[known]) <= 2 * sd[known])) if known.any() else None


def _events(run: Run) -> Iterator[tuple[str, str, int, str]]:
    """Flags that were raised: name, meaning, readings, and the times."""
    for name in run:
        if name.startswith("flag_") and run[name].dtype == bool and run[name].any():
            spans = _spans(run, name)
            times = ", ".join(f"{a:.2f}–{b:.2f}" if b > a else f"{a:.2f}" for a, b in spans[:MOST_SPANS])
            if len(spans) > MOST_SPANS:
                times += f" and {len(spans) - MOST_SPANS:,} more"
            doc = COLUMNS[name].doc if name in COLUMNS else ""
            yield name, doc, int(run[name].sum()), times


def _spans(run: Run, name: str) -> list[tuple[float, float]]:
    """First and last time of each stretch in which a flag is raised [s]."""
    on: NDArray[np.bool_] = run[name]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]).astype(int))).reshape(-1, 2)
    t = run["t"]
    return [(float(t[first]), float(t[after - 1])) for first, after in edges]


def _words(value: Any) -> str:
    """A cell in words: numbers to four digits, text without control characters and not too long."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{value:,}"
    if isinstance(value, float | np.floating):
        number = float(value)
        if not math.isfinite(number):
            return str(number)
        if abs(number) >= 1000:
            return f"{number:,.0f}"
        return "0" if number == 0 else f"{number:.4g}"
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in str(value))
    return text if len(text) <= LONGEST_TEXT else text[:LONGEST_TEXT] + "…"


def _fact(value: Any) -> str:
    """A fact as it is: a seed of 1234 is not "1,234", a speed not rounded."""
    return _words(str(value)) if isinstance(value, int | float) else _words(value)


def to_html(page: Page) -> str:
    """A page as one HTML file."""
    parts = []
    if page.overview:
        links = {f"#run-{k}": section for k, section in enumerate(page.sections)}
        parts.append(f"<section>{_html_table(page.overview, list(links))}</section>")
    for k, section in enumerate(page.sections):
        parts.append(_html_section(section, k, titled=len(page.sections) > 1))
    template = Template(Path(__file__).with_name("page.html").read_text(encoding="utf-8"))
    return template.substitute(
        title=_escaped(page.title),
        lead=_escaped(page.lead),
        body="\n".join(parts),
        version=_escaped(__version__),
    )


def _html_section(section: Section, k: int, *, titled: bool) -> str:
    parts = [f'<section id="run-{k}">']
    if titled:
        parts.append(f"<h2>{_escaped(section.title)}</h2>")
    if section.lead:
        parts.append(f'<p class="lead">{_escaped(section.lead)}</p>')
    if section.pictures:
        count = {1: " one", 2: " two"}.get(len(section.pictures), "")
        parts.append(f'<div class="pictures{count}">')
    for picture in section.pictures:
        data = base64.b64encode(picture.data).decode("ascii")
        parts.append(
            f'<figure style="--aspect: {picture.aspect():.3f}"><img alt="{_escaped(picture.alt)}" '
            f'src="data:image/{picture.kind};base64,{data}">'
            f"<figcaption>{_escaped(picture.title)}</figcaption></figure>"
        )
    if section.pictures:
        parts.append("</div>")
    parts += [_html_table(table) for table in section.tables]
    return "\n".join([*parts, "</section>"])


def _html_table(table: Table, links: Sequence[str] = ()) -> str:
    fact = table.title in _EXACT
    parts = [f"<h3>{_escaped(table.title)}</h3>"]
    if table.rows:
        parts.append(f'<div class="wide"><table{" class=facts" if fact else ""}>')
        if any(table.head):
            columns: Any = zip(table.head, zip(*table.rows, strict=True), strict=True)
            head = "".join(
                f'<th scope="col"{_NUMBER if not fact and any(map(_is_number, cells)) else ""}>'
                f"{_escaped(name)}</th>"
                for name, cells in columns
            )
            parts.append(f"<thead><tr>{head}</tr></thead>")
        parts.append("<tbody>")
        for k, (name, *cells) in enumerate(table.rows):
            first = _escaped(_words(name))
            if links:
                first = f'<a href="{links[k]}">{first}</a>'
            row = [f'<th scope="row">{first}</th>']
            for label, value in zip(table.head[1:], cells, strict=True):
                number = _NUMBER if _is_number(value) and not fact else ""
                number = number or _LONG * (not fact and len(str(value)) > 24)
                text = _escaped(_fact(value) if fact else _words(value))
                if text and label:  # shown where a row is narrow, and the head is not
                    text = f'<span class="label">{_escaped(label)}</span><span>{text}</span>'
                row.append(f"<td{number}>{text}</td>")
            parts.append(f"<tr>{''.join(row)}</tr>")
        parts.append("</tbody></table></div>")
    if table.note:
        parts.append(f'<p class="note">{_escaped(table.note)}</p>')
    return "\n".join(parts)


_EXACT = ("Provenance", "Metadata that differ")
"""Tables whose numbers are shown as they are."""


_NUMBER, _LONG = ' class="number"', ' class="long"'


def _is_number(value: Any) -> bool:
    """Whether a cell is aligned as numbers are: a number, or one in words such as "212.9 (0.493)"."""
    if isinstance(value, str):
        return _NUMERIC.fullmatch(value) is not None
    return isinstance(value, int | float) and not isinstance(value, bool)


_NUMERIC = re.compile(r"[+-]?\d{1,3}(,?\d{3})*(\.\d+)?( ?%| \(.*\))?")


def _escaped(text: str) -> str:
    return html.escape(_words(text), quote=True)


def to_markdown(page: Page) -> str:
    """A page as Markdown, with those of its pictures that lie beside it."""
    parts = [f"# {_marked(page.title)}", _marked(page.lead)]
    if page.overview:
        parts += _markdown_table(page.overview, 2)
    for section in page.sections:
        several = len(page.sections) > 1
        if several:
            parts.append(f"## {_marked(section.title)}")
        if section.lead:
            parts.append(_marked(section.lead))
        for picture in section.pictures:
            if picture.file:
                parts.append(f"![{_marked(picture.alt)}]({picture.file})\n\n{_marked(picture.title)}")
        for table in section.tables:
            parts += _markdown_table(table, 3 if several else 2)
    parts.append(f"Written by magtwin {_marked(__version__)}.")
    return "\n\n".join(parts) + "\n"


def _markdown_table(table: Table, level: int) -> list[str]:
    parts = [f"{'#' * level} {_marked(table.title)}"]
    if table.rows:
        lines = [_row(table.head), _row(["---"] * len(table.head), raw=True)]
        lines += [_row(row, exact=table.title in _EXACT) for row in table.rows]
        parts.append("\n".join(lines))
    if table.note:
        parts.append(_marked(table.note))
    return parts


def _row(cells: Sequence[Any], *, exact: bool = False, raw: bool = False) -> str:
    words = cells if raw else [_marked(_fact(cell) if exact else _words(cell)) for cell in cells]
    return f"| {' | '.join(words)} |"


def _marked(text: str) -> str:
    """Text that Markdown takes as text."""
    return re.sub(r"([\\`*\[\]<>|!#~$]|(?<!\w)_|_(?!\w))", r"\\\1", _words(text))


def to_json(page: Page) -> str:
    """A page as JSON: what is not finite is null, as JSON has no word for it."""
    return json.dumps(_finite({"magtwin": __version__, "title": page.title, **page.data}), indent=2) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


WRITERS: Mapping[str, Callable[[Page], str]] = {".html": to_html, ".md": to_markdown, ".json": to_json}
"""What a page can be written in, by the end of its file's name."""
