"""Reports of runs and comparisons as pages."""

import base64
import html.parser
import json
import re
import shutil
import subprocess

import numpy as np
import pytest

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.figures.canvas import short_pair, thinned
from magtwin.figures.page import Page, to_html, to_json, write_page
from magtwin.figures.reports import MOST_SPANS, NamedRun, draw_comparison, page_of_runs
from magtwin.figures.runs import pictures_of_run
from magtwin.io.tables import write_parquet
from magtwin.run.compare import compare
from magtwin.run.run import Run
from magtwin.twin import open_twin, simulate

EVIL = "<script>alert(1)</script>\"'&|`_*\n\x1b[31m"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


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
        if tag not in ("meta", "img"):
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
    pictures = [attributes for tag, attributes in read.tags if tag == "img"]
    assert len(pictures) == 10
    assert all(picture["src"].startswith("data:image/") and picture["alt"] for picture in pictures)
    assert "http" not in re.sub(r"base64,[^\"]*", "", text.replace("http-equiv", ""))
    ids = [attributes["id"] for _, attributes in read.tags if "id" in attributes]
    links = [attributes["href"] for tag, attributes in read.tags if tag == "a"]
    assert links == [f"#{name}" for name in ids] == ["#run-0", "#run-1"]


def test_pictures_inside_a_page_are_png_and_svg(page):
    sources = [a["src"] for tag, a in Reader(to_html(page)).tags if tag == "img"]
    for source in sources:
        kind, data = source.removeprefix("data:image/").split(";base64,")
        start = base64.b64decode(data)[:100]
        assert start.startswith(b"\x89PNG" if kind == "png" else b"<?xml")


def test_what_a_file_says_of_itself_is_text_and_nothing_else(runs):
    run = runs[0].with_metadata(path=EVIL, scene=EVIL, note=EVIL * 100, **{EVIL: EVIL})
    told = NamedRun(EVIL, run, note=EVIL)
    page = page_of_runs([told, told], pictures=False)
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


def test_of_many_events_the_first_are_listed_and_the_rest_counted(runs):
    often = np.arange(runs[0].rows) % 4 == 0
    text = to_html(page_of_runs([NamedRun("a", runs[0].with_columns(flag_bump=often))], pictures=False))
    assert f"and {often.sum() - MOST_SPANS} more" in text


def test_a_run_of_few_columns_is_told_by_what_it_has():
    t = np.arange(50.0)
    field = 41_000 + 10 * np.sin(t)
    field[7] = np.nan
    page = page_of_runs([NamedRun("bare", Run({"t": t, "b_measured_nt": field}, {"weight": float("nan")}))])
    titles = [picture.title for picture in page.sections[0].pictures]
    assert titles == ["Field"]
    assert json.loads(to_json(Page("t", "", (), data={"weight": float("nan")})))["weight"] is None
    assert Reader(to_html(page)).open == []


def test_pages_are_made_for_phones_and_their_wide_tables_scroll_on_a_desk(page):
    read = Reader(to_html(page))
    viewport = next(a["content"] for tag, a in read.tags if tag == "meta" and a.get("name") == "viewport")
    assert "width=device-width" in viewport
    inside = [
        at > 0 and read.tags[at - 1] == ("div", {"class": "wide"})
        for at, (tag, _) in enumerate(read.tags)
        if tag == "table"
    ]
    assert inside
    assert all(inside)
    labels = [a for tag, a in read.tags if tag == "span" and a.get("class") == "label"]
    assert len(labels) > 50  # what a phone shows before each value


def test_charts_shorten_long_names_and_tell_two_apart(runs):
    names = tuple(f"{'a_long_name_' * 8}{end}.parquet" for end in ("one", "two"))
    assert short_pair(("a.parquet", "b.parquet")) == ("a.parquet", "b.parquet")
    alike = short_pair((f"{names[0]}1{names[0]}", f"{names[0]}2{names[0]}"))
    assert alike[0] != alike[1]


def test_the_same_runs_give_the_same_bytes(runs, twin, tmp_path):
    for name in ("a.html", "b.html"):
        write_page(page_of_runs([NamedRun("a.parquet", runs[0], twin.field)]), tmp_path / name)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_a_thinned_line_keeps_its_ends_and_its_extremes():
    t = np.linspace(0, 1, 100_000)
    values = np.sin(40 * t)
    values[33_333], values[77_777], values[5_000:5_100] = 9.0, -9.0, np.nan
    x, y = thinned(t, values)
    assert len(x) < 2000
    assert (x[0], x[-1]) == (0, 1)
    assert np.nanmax(y) == 9
    assert np.nanmin(y) == -9
    assert (np.diff(x) > 0).all()


def test_a_comparison_draws_both_runs_by_their_names(runs):
    a, b = runs
    figure = draw_comparison(NamedRun("a", a), NamedRun("b", b), compare(a, b, align="path"))
    assert len(figure.axes) == 4
    assert figure.axes[0].get_legend_handles_labels()[1] == ["a", "b"]


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


def test_a_data_sets_folder_is_reported_run_by_run(runs, tmp_path):
    for k, run in enumerate(runs):
        write_parquet(run, tmp_path / "set" / f"run_{k:05d}.parquet")
    (tmp_path / "set" / "runs.csv").write_text("file\n")
    main(["report", str(tmp_path / "set"), "--out", str(tmp_path / "set.html")])
    assert all(f"run_0000{k}.parquet" in (tmp_path / "set.html").read_text() for k in range(2))


def test_a_map_that_is_no_longer_what_the_run_read_is_not_shown(runs, tmp_path, capsys):
    file = tmp_path / "a.parquet"
    write_parquet(runs[0].with_metadata(map_sha256="0" * 64), file)
    main(["report", str(file), "--out", str(tmp_path / "a.html")])
    assert "is not the map of the run" in (tmp_path / "a.html").read_text()


def test_what_cannot_be_reported_is_refused_and_nothing_is_written(runs, tmp_path):
    page = page_of_runs([NamedRun("a", runs[0])], pictures=False)
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
    assert pictures_of_run(Run({"t": np.arange(3.0)})) == []
    assert [p.name for p in tmp_path.iterdir()] == ["there.html"]
    assert (tmp_path / "there.html").read_text() == "precious"


def test_a_browser_lays_a_page_out_within_its_window_on_a_phone_as_on_a_desk(page, tmp_path):
    if CHROMIUM is None:
        pytest.skip("no Chromium here to open a page in: apt-get install chromium")
    probe = (
        "<script>onload = () => { const d = document; d.title = [d.documentElement.scrollWidth,"
        " d.documentElement.clientWidth, [...d.images].filter(i => !i.naturalWidth).length,"
        " Math.min(...[...d.images].map(i => i.clientWidth)),"
        " [...d.querySelectorAll('.wide')].filter(w => w.scrollWidth > w.clientWidth + 1).length,"
        " Math.round(100 * Math.min(...[...d.querySelectorAll('.pictures')].map(p => {"
        " const area = e => e.getBoundingClientRect().width * e.getBoundingClientRect().height;"
        " return [...p.children].map(area).reduce((a, b) => a + b) / area(p) })))].join(' ') }</script>"
    )
    text = re.sub(r"<meta http-equiv[^>]*>", "", to_html(page))
    text = text.replace("a.parquet", f"{'a_run_of_a_long_name_' * 5}.parquet")
    (tmp_path / "page.html").write_text(text.replace("</body>", probe + "</body>"))
    windows = ((360, 780), (390, 844), (1280, 900), (1440, 900))
    frames = "".join(f"<iframe src=page.html width={w} height={h}></iframe>" for w, h in windows)
    outer = tmp_path / "frames.html"  # a window of Chromium's own is never narrower than 500, a frame can be
    outer.write_text(
        f"{frames}<script>onload = () => document.title = [...document.querySelectorAll('iframe')]"
        ".map(f => f.contentDocument.title).join(',')</script>"
    )
    command = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", outer.as_uri()]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    said = re.search(r"<title>([\d ,]+)</title>", out)[1].split(",")
    for (width, _), frame in zip(windows, said, strict=True):
        wide, window, broken, least, cut, filled = map(int, frame.split())
        assert wide <= window <= width
        assert broken == 0
        assert least > 0.8 * min(width, 500)
        assert cut == 0  # no table has to be scrolled
        assert filled > 80  # per cent of the pictures' space
