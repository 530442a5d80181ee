"""The page that plays a run: what it holds, and what a browser shows of it."""

import base64
import gzip
import hashlib
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html import unescape

import numpy as np
import pytest
from scipy.stats import chi2

from magtwin.cli import main
from magtwin.figures.bodies import simplified
from magtwin.figures.page import to_html
from magtwin.figures.player import MOST_ROWS, floor_of, player_of, rows_shown
from magtwin.figures.reporting import report_runs
from magtwin.figures.reports import NamedRun, page_of_runs
from magtwin.localization.track import EST_COLUMNS
from magtwin.run.run import Run
from magtwin.twin import open_twin, simulate

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
HOSTILE = '</script><script>document.title="hit"</script>'


@pytest.fixture(scope="module")
def twin(lab_scene):
    return open_twin(lab_scene)


@pytest.fixture(scope="module")
def run(twin):
    return simulate(twin, "figure8", seed=3)


def page_of(run, field=None, stage=None, name="run.parquet"):
    return to_html(page_of_runs([NamedRun(name, run, field, stage=stage)]))


def unpacked(block):
    """Head and arrays of a block, by the rules that player.js follows."""
    content = gzip.decompress(base64.b64decode(block))
    length = int.from_bytes(content[:4], "little")
    head, body = json.loads(content[4 : 4 + length]), np.frombuffer(content[4 + length :], np.uint8)
    arrays = {}
    for name, kind in head["arrays"].items():
        size, width = int(np.prod(kind["shape"])), kind["width"]
        planes = body[kind["at"] : kind["at"] + width * size].reshape(width, size).astype(np.int64)
        steps = sum(plane << (8 * k) for k, plane in enumerate(planes)).reshape(-1, kind["shape"][-1])
        bits = 8 * width
        values = np.cumsum(steps, axis=1) & (2**bits - 1)
        if kind["signed"] or width == 4:
            values = np.where(values >= 2 ** (bits - 1), values - 2**bits, values)
        arrays[name.removeprefix("0/")] = values.reshape(kind["shape"])
    return head, arrays


def opened(html, folder, *, at="", flags=()):
    """The document as a browser has made it, and what the browser has said."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here to open a page in: apt-get install chromium")
    file = folder / "page.html"
    file.write_text(html, encoding="utf-8")
    command = [
        CHROMIUM,
        *FLAGS,
        *flags,
        "--window-size=1440,900",
        "--virtual-time-budget=8000",
        "--enable-logging=stderr",
    ]
    done = subprocess.run(
        [*command, "--dump-dom", f"{file.as_uri()}{at}"], capture_output=True, text=True, timeout=900
    )
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def test_a_page_has_the_values_of_its_run_to_the_digit_that_it_shows(run, twin, lab_scene):
    _, arrays = unpacked(player_of([run], twin.field, lab_scene).block)
    rows = rows_shown(run, MOST_ROWS)
    assert [f"{v / 100:.2f}" for v in arrays["reading"]] == [
        f"{b / 1000:.2f}" for b in run["b_measured_nt"][rows]
    ]
    own = run["b_truth_nt"] - run["b_map_nt"]
    assert [f"{v}" for v in arrays["own"]] == [
        f"{b:.0f}".replace("-0", "0") if abs(b) < 0.5 else f"{b:.0f}" for b in own[rows]
    ]
    assert np.abs(arrays["x"] / 1000 - run["p_world_base"][rows, 0]).max() <= 5.01e-4


def test_a_page_is_small_the_same_for_the_same_run_and_asks_no_host(run, twin, lab_scene):
    html = page_of(run, twin.field, lab_scene)
    assert len(html) < 400_000
    assert html == page_of(run, twin.field, lab_scene)
    longer = simulate(twin, "figure8", seed=3, duration_s=600)
    assert len(page_of(longer, twin.field, lab_scene)) < 600_000
    assert "http" not in re.sub(r"http-equiv|http://www\.w3\.org/2000/svg", "", html)
    assert re.search(r"default-src 'none'; .*script-src 'sha256-", html)


def test_a_browser_plays_a_run_and_shows_the_values_of_its_row(run, twin, lab_scene, tmp_path):
    document, said = opened(page_of(run, twin.field, lab_scene), tmp_path, at="#t=45.4")
    assert not said
    assert 'data-state="live"' in document
    row = int(np.searchsorted(np.round(run["t"] * 100), 4540 + 1e-6, side="right")) - 1
    shown = dict(re.findall(r"<dt>([^<]+)</dt><dd>([^<]+)</dd>", document))
    assert shown["field"] == f"{run['b_measured_nt'][row] / 1000:.2f} µT"
    assert shown["reading − map"] == f"{run['b_measured_nt'][row] - run['b_map_nt'][row]:,.0f} nT".replace(
        "-", "−"
    )
    outputs = re.findall(r"<output[^>]*>([^<]+)</output>", document)
    error = run["b_total_nt"][row] - run["b_truth_nt"][row]
    assert outputs[4].startswith(f"{error:,.0f}".replace("-", "−") + " ± ")
    frames = int(re.search(r'data-frames="(\d+)"', document)[1])
    assert frames <= 6  # 8 s of the browser's time: nothing is drawn while nothing changes


def test_keys_clicks_drags_and_the_address_seek(run, twin, lab_scene, tmp_path):
    script = """setTimeout(() => {
      const t = () => Math.round(10 * parseFloat(document.querySelector('[data-part="time"]').textContent));
      const key = (key) => {
        document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
        return t();
      };
      const svg = document.querySelector("#player svg"), box = svg.getBoundingClientRect();
      svg.setPointerCapture = () => {};
      const point = (type, x) => {
        svg.dispatchEvent(new PointerEvent(type, { clientX: x, clientY: box.top + 9, buttons: 1 }));
        return t();
      };
      const told = [key("End"), key("Home"), key("ArrowRight"), key("ArrowRight"), key("ArrowLeft")];
      told.push(point("pointerdown", (box.left + 46 + box.right - 10) / 2));
      told.push(point("pointermove", box.right - 10));
      document.querySelector('[value="top"]').click();
      told.push(document.querySelector('[value="top"]').getAttribute("aria-pressed"));
      document.title = told.join(" ");
    }, 2000);"""
    html = page_of(run, twin.field, lab_scene)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    html = html.replace("script-src '", f"script-src 'sha256-{digest}' '", 1)
    document, said = opened(html.replace("</body>", f"<script>{script}</script></body>"), tmp_path)
    assert not said
    end = round(10 * run.duration_s)
    *times, top = re.search("<title>(.*)</title>", document)[1].split()
    assert [int(t) for t in times] == [end, 0, 10, 20, 10, pytest.approx(end / 2, abs=1), end]
    assert top == "true"


def test_readers_without_eyes_get_figures_charts_and_a_table(run, twin, lab_scene, tmp_path):
    document, _ = opened(page_of(run, twin.field, lab_scene), tmp_path)
    assert "<dt>mean error</dt>" in document
    low, high = (f(run["b_measured_nt"]) / 1000 for f in (np.min, np.max))
    assert f'aria-label="Field over time: reading from {low:.2f} to {high:.2f} µT, map from' in document
    table = re.search(r'<table data-part="values">(.*?)</table>', document, re.S)[1]
    assert table.count("<tr>") == 12
    assert table.count('scope="col"') == 6
    last = re.findall("<td>([^<]*)</td>", table)[-6:]
    assert last[:2] == [f"{run.duration_s:.2f}", f"{run['b_measured_nt'][-1] / 1000:.2f}"]
    assert 'aria-label="Play"' in document
    assert re.search(r'<canvas [^>]*aria-label="The lab with the robot', document)


def test_robots_that_drove_together_share_a_page_and_one_has_the_charts(twin, lab_scene, run, tmp_path):
    runs = [replace(run, metadata={**run.metadata, "robot": name}) for name in ("turtlebot4", "bob")]
    runs[1] = runs[1].with_columns(b_measured_nt=run["b_measured_nt"] + 1000)
    page = page_of_runs([NamedRun(name, one, twin.field) for name, one in zip("ab", runs, strict=True)])
    assert page.title == "2 robots in lab"
    document, said = opened(to_html(page), tmp_path, at="#t=20&robot=bob")
    assert not said
    assert re.search(r'<button value="bob"[^>]*aria-pressed="true"', document)
    row = rows_shown(runs[1], 4000)[-1]
    assert f"<td>{runs[1]['b_measured_nt'][row] / 1000:.2f}</td>" in document
    assert page_of_runs([NamedRun("a", run), NamedRun("b", run)]).player is None


def test_a_notebook_gets_the_page_in_a_frame_that_reaches_nothing(run, lab_scene):
    shown = run.view(lab_scene, height=500)
    frame = shown._repr_html_()
    assert re.match(r'<iframe sandbox="allow-scripts" [^>]*height: 500px', frame)
    assert unescape(re.search('srcdoc="([^"]*)"', frame)[1]) == shown.page
    assert len(frame) < 450_000
    assert "kB" in repr(shown)


def test_a_scene_without_a_run_shows_its_lab_and_map(lab_scene, tmp_path, capsys):
    out = tmp_path / "lab.html"
    main(["export", str(lab_scene), "--out", str(out)])
    html = out.read_text()
    assert len(html) < 200_000
    document, said = opened(html, tmp_path, at="#heading=90")
    assert not said
    assert 'data-state="live" data-scene="lab" data-plays="false"' in document
    assert ">90°</span>" in document
    with pytest.raises(SystemExit, match="1"):
        main(["export", str(lab_scene), "--out", str(tmp_path / "a.html"), "--target", "viewer"])
    assert "leave out --target" in capsys.readouterr().err


def test_the_folder_of_a_sweep_becomes_a_grid_of_stills_that_open_pages(run, lab_scene, tmp_path):
    folder, out = tmp_path / "runs", tmp_path / "report"
    folder.mkdir()
    (folder / "runs.csv").write_text("file\n")
    for k in range(2):
        run.select("p_world_base", "q_world_base_xyzw", "b_map_nt", "b_measured_nt").take(slice(k, 999)).save(
            folder / f"run_{k:05}.parquet"
        )
    report_runs([folder], out, scene=lab_scene)
    index = (out / "index.html").read_text()
    assert sorted(file.name for file in out.iterdir()) == ["index.html", "run_00000.html", "run_00001.html"]
    assert len(index) < 100_000
    for k in range(2):
        assert len(re.findall(f'<a href="run_0000{k}.html">', index)) == 2  # of its still, and of its row
    report_runs([folder], tmp_path / "one.html", scene=lab_scene)
    assert (tmp_path / "one.html").read_text().count('<a href="#run-1">') == 2


def test_a_scene_of_many_shapes_keeps_its_robot_and_its_largest_ones_and_says_so(run, lab_scene, monkeypatch):
    monkeypatch.setattr("magtwin.figures.bodies.MOST_TRIANGLES", 1_000)
    player = player_of([run], None, lab_scene)
    head, arrays = unpacked(player.block)
    assert re.search(r"\d+ small shapes of the scene are left out", player.note)
    names = [body["name"] for body in head["bodies"]]
    assert {"lab", "0/"} <= set(names)
    assert sum(len(arrays[f"{name}.faces".removeprefix("0/")]) for name in names) <= 3 * 1_000


def test_without_webgl_a_page_has_its_charts_and_a_picture(run, twin, lab_scene, tmp_path):
    html = page_of(run, twin.field, lab_scene)
    document, _ = opened(html, tmp_path, flags=("--disable-webgl", "--disable-webgl2", "--disable-3d-apis"))
    assert 'data-state="still"' in document
    assert "The lab is not drawn" in document
    assert document.count('class="line') >= 5
    assert 'class="still"' in document


def test_hostile_names_are_text(run, twin, lab_scene, tmp_path):
    evil = replace(run, metadata={**run.metadata, "scene": HOSTILE, "path": HOSTILE})
    html = page_of(evil, twin.field, lab_scene, name=HOSTILE)
    assert HOSTILE not in html
    document, said = opened(html, tmp_path)
    assert "<title>hit" not in document
    assert not said


@pytest.mark.parametrize("lacking", ["scene", "map", "truth", "places", "gaps"])
def test_a_run_that_lacks_something_has_a_page_of_the_rest(run, twin, lab_scene, tmp_path, lacking):
    columns, field, stage = dict(run.items()), twin.field, lab_scene
    if lacking in ("scene", "map"):
        field, stage = (None if lacking == "map" else field), None
    if lacking == "truth":
        columns["b_truth_nt"] = np.full(run.rows, np.nan)
    if lacking == "places":
        columns = {name: columns[name] for name in ("t", "b_measured_nt", "b_map_nt")}
    if lacking == "gaps":
        columns["b_measured_nt"] = np.where(np.arange(run.rows) % 900 < 300, np.nan, columns["b_measured_nt"])
    document, said = opened(page_of(Run(columns, run.metadata), field, stage), tmp_path)
    assert not said
    assert f'data-state="{"still" if lacking == "places" else "live"}"' in document
    name = "reading − map" if lacking in ("truth", "places") else "exact − map"
    assert name in document


def test_a_localized_run_has_its_ellipse_and_the_error_of_its_position(run, twin, lab_scene):
    rows = run.rows
    covariance = np.tile([0.04, 0.01, 0, 0.02, 0, 0.001], (rows, 1))
    estimate = run["p_world_base"] * [1, 1, 0] + [0.03, 0.04, 0]
    values = {"est_p_world_base": estimate, "est_yaw": run["yaw"], "est_covariance": covariance}
    made = Run(
        {**dict(run.items()), **values}, run.metadata, specs={name: EST_COLUMNS[name] for name in values}
    )
    head, arrays = unpacked(player_of([made], twin.field, lab_scene).block)
    assert head["robots"][0]["charts"][-1]["title"] == "Position error"
    assert set(arrays["off"]) == {50}  # mm
    axes, directions = np.linalg.eigh([[0.04, 0.01], [0.01, 0.02]])
    assert np.abs(arrays["est_a"] / 1000 - np.sqrt(chi2(2).ppf(0.9) * axes[1])).max() < 1e-3
    assert np.abs(np.tan(arrays["est_turn"][0] / 1000) - directions[1, 1] / directions[0, 1]) < 5e-3


def test_the_floor_is_the_map_at_every_heading(twin):
    place, parts, known = floor_of(twin.field)
    turns = twin.field.headings_rad
    basis = [np.ones_like(turns)]
    for k in range(1, (place["waves"] + 1) // 2):
        basis += [np.cos(k * turns), np.sin(k * turns)]
    drawn = np.tensordot(np.stack(basis, axis=1), parts, 1)
    error = (drawn - twin.field.values_nt)[:, known.astype(bool)]
    assert np.sqrt(np.mean(error**2)) < 5.5


def test_a_fine_mesh_is_simplified_to_its_shape():
    turn, rise = np.meshgrid(np.linspace(0, 2 * np.pi, 200, endpoint=False), np.linspace(-1, 1, 100))
    points = np.stack([np.cos(turn), np.sin(turn), rise], axis=-1).reshape(-1, 3)
    at = np.arange(20_000).reshape(100, 200)
    corners = np.stack([at[:-1], np.roll(at, -1, axis=1)[:-1], at[1:]], axis=-1).reshape(-1, 3)
    fewer, faces = simplified(points, corners, 2_000)
    assert 200 < len(faces) <= 2_000
    assert np.abs(np.hypot(*fewer[np.unique(faces)][:, :2].T) - 1).max() < 1e-9
    assert np.ptp(fewer[np.unique(faces)], axis=0).min() > 1.8


def test_a_day_of_readings_makes_a_page_of_bounded_size():
    n = 2_000_000
    t = np.arange(n) * 0.05
    b = 50_000 + 300 * np.sin(t / 900)
    b[1_234_567] += 900.0  # a single outlier, which a page must not lose
    run = Run({"t": t, "b_measured_nt": b}, {})
    _, arrays = unpacked(player_of([run], None, None).block)
    assert len(arrays["t"]) <= 8_001
    assert arrays["reading"].max() > 5_060
