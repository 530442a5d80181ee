"""Reports of runs and comparisons as pages."""

import html.parser
import json
import re

import numpy as np
import pytest

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.figures.page import Page, to_html, to_json, write_page
from magtwin.figures.reports import NamedRun, page_of_comparison, page_of_runs
from magtwin.figures.style import PALETTE
from magtwin.io.tables import write_parquet
from magtwin.run.compare import compare
from magtwin.run.run import Run
from magtwin.twin import open_twin, simulate

EVIL = "<script>alert(1)</script>\"'&|`_*\n\x1b[31m"


@pytest.fixture(scope="module")
def twin(lab_scene):
    return open_twin(lab_scene, magnetometer="physical")


@pytest.fixture(scope="module")
def runs(twin):
    made = [
        simulate(twin, "figure8", seed=seed, speed=speed, duration_s=8.0, rate_hz=20.0)
        for seed, speed in ((1, 0.2), (2, 0.25))
    ]
    bump = np.zeros(made[0].rows, bool)
    bump[10:14] = bump[50] = True
    return [made[0].with_columns(flag_bump=bump), made[1]]


@pytest.fixture(scope="module")
def page(runs, twin):
    return page_of_runs([NamedRun("a.parquet", runs[0], twin.field), NamedRun("b.parquet", runs[1])])


class Reader(html.parser.HTMLParser):
    """What an HTML page has: its tags with their attributes, and its text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in ("meta", "img", "input"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def test_a_page_is_well_formed_and_asks_nothing_of_any_other_place(page):
    text = to_html(page)
    read = Reader(text)
    assert read.open == []
    assert {tag for tag, _ in read.tags}.isdisjoint({"script", "link", "iframe", "object", "form"})
    drawn = [attributes for tag, attributes in read.tags if tag == "img"]
    assert [attributes["alt"].split(",")[0] for attributes in drawn] == [
        "the path over the map lab",
        "the path",
    ]
    assert "http" not in re.sub(r"base64,[^\"]*", "", text.replace("http-equiv", ""))
    ids = [attributes["id"] for _, attributes in read.tags if "id" in attributes]
    links = [attributes["href"] for tag, attributes in read.tags if tag == "a"]
    assert links == [f"#{name}" for name in ids] == ["#run-0", "#run-1"]


def test_what_a_file_says_of_itself_is_text_and_nothing_else(runs):
    run = runs[0].with_metadata(path=EVIL, scene=EVIL, note=EVIL * 100, **{EVIL: EVIL})
    told = NamedRun(EVIL, run, note=EVIL)
    page = page_of_runs([told, told])
    read = Reader(to_html(page))
    assert read.open == []
    assert "script" not in {tag for tag, _ in read.tags}
    assert "\x1b" not in "".join(read.text)
    assert "<script>alert(1)</script>" in "".join(read.text)


def test_a_page_has_the_errors_and_the_times_of_events(page, runs):
    text = "".join(Reader(to_html(page)).text)
    error = np.sqrt(np.nanmean((runs[0]["b_measured_nt"] - runs[0]["b_truth_nt"]) ** 2))
    assert f"{error:.4g}" in text
    t = runs[0]["t"]
    assert f"{t[10]:.2f}–{t[13]:.2f}, {t[50]:.2f}" in text


def test_a_run_of_few_columns_is_told_by_what_it_has():
    t = np.arange(50.0)
    field = 41_000 + 10 * np.sin(t)
    field[7] = np.nan
    page = page_of_runs([NamedRun("bare", Run({"t": t, "b_measured_nt": field}, {"weight": float("nan")}))])
    assert page.player is not None
    assert not page.player.lab
    assert json.loads(to_json(Page("t", "", (), data={"weight": float("nan")})))["weight"] is None
    assert Reader(to_html(page)).open == []


def test_the_same_runs_give_the_same_bytes(runs, twin, tmp_path):
    for name in ("a.html", "b.html"):
        write_page(page_of_runs([NamedRun("a.parquet", runs[0], twin.field)]), tmp_path / name)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_commands_write_reports_and_comparisons(runs, lab_scene, tmp_path, capsys):
    files = [tmp_path / "a.parquet", tmp_path / "b.parquet"]
    for run, file in zip(runs, files, strict=True):
        write_parquet(run, file)
    names = [str(file) for file in files]
    main(["report", *names, "--out", str(tmp_path / "set.html")])
    text = (tmp_path / "set.html").read_text()
    assert all(f"{name}.parquet" in text for name in "ab")
    main(["compare", *names, "--align", "path", "--out", str(tmp_path / "two.svg")])
    assert "cross-track" in capsys.readouterr().out
    assert (tmp_path / "two.svg").read_text().startswith("<?xml")
    main(["compare", *names, "--json"])
    assert json.loads(capsys.readouterr().out)["agreements"]["b_map_nt"]["unit"] == "nT"


def test_what_cannot_be_reported_is_refused_and_nothing_is_written(runs, tmp_path):
    page = page_of_runs([NamedRun("a", runs[0])])
    (tmp_path / "there.html").write_text("precious")
    with pytest.raises(InputError, match="exists already; give `force=True`"):
        write_page(page, tmp_path / "there.html")
    with pytest.raises(InputError, match=r"a\.pdf: a report ends in \.html, \.json"):
        write_page(page, tmp_path / "a.pdf")
    with pytest.raises(InputError, match="no run to report on"):
        page_of_runs([])
    empty = Run({name: values[:0] for name, values in runs[0].items()})
    with pytest.raises(InputError, match="empty: has no readings to report on"):
        page_of_runs([NamedRun("empty", empty)])
    assert [p.name for p in tmp_path.iterdir()] == ["there.html"]
    assert (tmp_path / "there.html").read_text() == "precious"


def test_a_drawing_on_a_page_is_a_part_of_it_and_takes_its_colours(runs):
    a, b = (NamedRun(name, run) for name, run in zip("ab", runs, strict=True))
    page = page_of_comparison(a, b, compare(a.run, b.run))
    text = to_html(page)
    read = Reader(text)
    assert read.open == []
    drawings = [attributes for tag, attributes in read.tags if tag == "svg"]
    assert len(drawings) == len(page.sections[0].pictures) == 4
    assert all(drawing["aria-label"] for drawing in drawings)
    body = text[text.index("<body") :]
    light = {colour for colour, _ in PALETTE.values() if colour.startswith("#")}
    assert light.isdisjoint(re.findall("#[0-9a-f]{6}", body))
    names = re.findall(r'(?<=[ "])id="([^"]+)"', body)
    assert len(names) == len(set(names))
    assert set(re.findall(r"url\(#([^)]+)\)", body)) <= set(names)
    sizes = [float(size) for size in re.findall(r"font-size: ([\d.]+)px", body)]
    width = float(re.search(r'viewBox="0 0 ([\d.]+)', body)[1])
    assert min(sizes) * (390 - 34) / width >= 11  # as a phone shows them
    assert body.index('class="verdict"') < body.index("<svg") < body.index("<details")
    field = next(row for row in compare(a.run, b.run).agreements() if row.name == "b_measured_nt")
    assert f"b_measured_nt by {field.rms:,.1f} nT (RMS)" in page.verdict
