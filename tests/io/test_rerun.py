import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path as FilePath
from types import SimpleNamespace

import numpy as np
import pytest
import rerun as rr
import rerun_cli
from PIL import Image
from rerun.chunk import RrdReader
from waiting import PATIENCE_S, wait_until

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.frames import rotate
from magtwin.io.rerun import recording, viewer
from magtwin.io.rerun.file import read_run, read_runs, show_run, write_comparison, write_rrd
from magtwin.io.rerun.series import STATES
from magtwin.io.rerun.viewer import live_viewer, screenshot, show
from magtwin.io.rerun.world import Scale, heading_of
from magtwin.path import figure8
from magtwin.run.run import Run
from magtwin.twin import open_twin, simulate


@pytest.fixture(scope="module")
def parts(lab_scene):
    """A run of 12 s, and what write_rrd needs beside it."""
    twin = open_twin(lab_scene, network="none")
    return simulate(twin, "figure8", seed=1, duration_s=12.0), {"twin": twin, "planned": figure8()}


@pytest.fixture(scope="module")
def written(parts, tmp_path_factory):
    run, rest = parts
    path = tmp_path_factory.mktemp("rrd") / "run.rrd"
    write_rrd(run, path, **rest)
    return path


def columns_of(rrd, entity):
    """Times [ns] and values by component of an entity, the values nested as Rerun nests them."""
    times, values = [], {}
    for chunk in RrdReader(rrd).stream().to_chunks():
        if chunk.entity_path == f"/{entity}":
            batch = chunk.to_record_batch()
            if "sim_time" in batch.schema.names:
                times += batch.column("sim_time").cast("int64").to_pylist()
            for name in batch.schema.names:
                if name not in ("sim_time", "rerun.controls.RowId"):
                    values.setdefault(name, []).extend(batch.column(name).to_pylist())
    return np.array(times), values


def test_every_column_is_a_component_under_its_own_name_at_full_rate(parts, written):
    run, _ = parts
    times, values = columns_of(written, "run")
    assert np.array_equal(times, np.rint(run["t"] * 1e9))  # Rerun's clock counts nanoseconds
    for name in run:
        rows = [row[0] for row in values[name]]
        if parts_of := run.spec(name).parts:
            assert list(rows[0]) == list(parts_of)
            rows = [list(row.values()) for row in rows]
        assert np.array_equal(np.array(rows), run[name], equal_nan=run[name].dtype != bool), name


def test_states_hold_from_each_change_of_a_flag_to_the_next(parts, written):
    run, _ = parts
    for column, state in STATES.items():
        times, values = columns_of(written, f"states/{state.name}")
        words = np.array([state[0] for state in values["StateChange:state"]])
        held = words[np.searchsorted(times, np.rint(run["t"] * 1e9), side="right") - 1]
        assert np.array_equal(held, np.where(run[column], state.up, state.down)), column


def test_the_robot_stands_where_the_run_has_it_at_fifty_hertz_or_less_to_the_last_row(parts, written):
    run, _ = parts
    times, values = columns_of(written, "world/robot")
    rows = np.searchsorted(run["t"], times / 1e9 - 1e-6)
    assert np.diff(times)[:-1].min() >= 1e9 / 50
    assert rows[-1] == run.rows - 1
    p = np.array(values["Transform3D:translation"])[:, 0]
    q = np.array(values["Transform3D:quaternion"])[:, 0]
    np.testing.assert_allclose(p, run["p_world_base"][rows], atol=1e-6)  # Rerun's poses are single precision
    np.testing.assert_allclose(q, run["q_world_base_xyzw"][rows], atol=1e-6)


def test_wheels_turn_about_their_axles_by_the_runs_angles(parts, written):
    run, _ = parts
    for side, name in enumerate(("left_wheel", "right_wheel")):
        times, values = columns_of(written, f"world/robot/{name}")
        q = np.array(values["Transform3D:quaternion"])[:, 0]
        rows = np.searchsorted(run["t"], times / 1e9 - 1e-6)
        axle, spoke = rotate(q, [0.0, 0, 1]), rotate(q, [1.0, 0, 0])
        np.testing.assert_allclose(axle, np.tile([0, 1, 0], (len(q), 1)), atol=1e-6)  # y points to the left
        angle = np.arctan2(-spoke[:, 2], spoke[:, 0])  # a wheel that rolls forward turns x downwards
        off = np.angle(np.exp(1j * (angle - run["wheel_angle"][rows, side])))
        np.testing.assert_allclose(off, 0, atol=1e-5)


def test_the_ribbon_of_readings_goes_where_the_sensor_was_and_the_plan_lies_on_the_floor(parts, written):
    run, rest = parts
    times, values = columns_of(written, "world/readings")
    strips = np.array(values["LineStrips3D:strips"])[:, 0]
    rows = np.searchsorted(run["t"], times / 1e9 - 1e-6)
    sensor = rest["twin"].scene.robot.p_base_magnetometer
    at = run["p_world_base"][rows] + rotate(run["q_world_base_xyzw"][rows], sensor)
    np.testing.assert_allclose(strips[:, 1], at, atol=1e-6)
    np.testing.assert_array_equal(strips[1:, 0], strips[:-1, 1])  # a ribbon without a gap
    _, plan = columns_of(written, "world/planned")
    strip = np.array(plan["LineStrips3D:strips"][0][0])
    np.testing.assert_allclose(strip[:, :2], rest["planned"].p_xy, atol=1e-6)


def test_the_floor_is_viridis_of_the_map_and_see_through_where_it_is_unknown(parts, written):
    run, rest = parts
    field = rest["twin"].field
    _, values = columns_of(written, "world/map")
    form = values["GridMap:format"][0][0]
    pixels = np.array(values["GridMap:data"][0][0], np.uint8).reshape(form["height"], form["width"], 4)
    x0, x1, y0, y1 = field.extent
    x = x0 + (np.arange(form["width"]) + 0.5) * (x1 - x0) / form["width"]
    y = y1 - (np.arange(form["height"]) + 0.5) * (y1 - y0) / form["height"]  # the first row is the top
    b_nt = field.lookup(np.stack(np.meshgrid(x, y), axis=-1), heading_of(field, run))
    brightness = pixels[..., :3].sum(axis=-1)
    assert (pixels[..., 3] == 255).all()
    assert np.corrcoef(b_nt.ravel(), brightness.ravel())[0, 1] > 0.9
    assert Scale.over(field, np.empty(0)).colours(np.array([np.nan]))[0, 3] == 0


def rerun(*arguments):
    """Rerun's own command line."""
    program = FilePath(rerun_cli.__file__).with_name("rerun")
    return subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, check=False)


def test_two_recordings_of_one_run_are_the_same_recording(parts, tmp_path):
    run, rest = parts
    run = Run({name: np.nan_to_num(values) for name, values in run.items()}, run.metadata)  # nan != nan
    for name in ("a.rrd", "b.rrd"):
        write_rrd(run, tmp_path / name, **rest)
    a, b = (RrdReader(tmp_path / name).recordings()[0].recording_id for name in ("a.rrd", "b.rrd"))
    assert a == b
    assert rerun("rrd", "verify", tmp_path / "a.rrd").returncode == 0
    done = rerun("rrd", "compare", "--unordered", tmp_path / "a.rrd", tmp_path / "b.rrd")
    assert done.returncode == 0, done.stderr[:500]


def test_runs_without_rows_existing_files_and_a_disabled_rerun_are_refused(parts, tmp_path, monkeypatch):
    run, rest = parts
    path = tmp_path / "run.rrd"
    path.write_text("kept")
    for bad, words in (
        (run.take(slice(0)), r"run\.rrd: the run has no rows"),
        (Run({"t": [0.0, 1.0, np.nan]}), "t of row 3 is not finite"),
        (Run({"t": np.arange(2.0), "word": np.array(["a", "b"])}), "column 'word' cannot be recorded"),
    ):
        with pytest.raises(InputError, match=words):
            write_rrd(bad, path, force=True)
    with pytest.raises(InputError, match=r"run\.rrd: exists already"):
        write_rrd(run, path, **rest)
    monkeypatch.setenv("RERUN", "off")
    with pytest.raises(InputError, match="environment variable RERUN; unset it"):
        write_rrd(run, path, **rest, force=True)
    assert path.read_text() == "kept"


def events_of(rrd):
    times, values = columns_of(rrd, "events")
    texts = [text[0] for text in values.get("TextLog:text", [])]
    return sorted(zip((times / 1e9).tolist(), texts, strict=True))


def test_events_tell_when_and_where_each_flag_began_and_ended(tmp_path):
    t = np.arange(0, 10, 0.01)
    flag = np.zeros(len(t), bool)
    flag[100:151], flag[160:201], flag[500:], lock = True, True, True, np.zeros(len(t), bool)
    p = np.column_stack([t, -t, 0 * t])
    lock[0] = True
    run = Run({"t": t, "p_world_base": p, "flag_bump": flag, "flag_lost_lock": lock})
    write_rrd(run, tmp_path / "run.rrd")
    assert events_of(tmp_path / "run.rrd") == [
        (0.0, "magnetometer has lock again at x, y = +0.00, -0.00 m, after 0.00 s"),
        (0.0, "magnetometer loses lock at x, y = +0.00, -0.00 m"),
        (1.0, "bump: touches an obstacle at x, y = +1.00, -1.00 m"),
        (
            2.0,
            "clear of the obstacle at x, y = +2.00, -2.00 m, after 1.00 s",
        ),  # 0.1 s apart are not two bumps
        (5.0, "bump: touches an obstacle at x, y = +5.00, -5.00 m"),  # and the last one does not end
    ]


def test_runs_that_are_compared_stand_on_one_timeline_and_come_back(parts, tmp_path):
    run, rest = parts
    other = Run({name: values[:500] for name, values in run.items()}, {"seed": 2})
    runs = {"the first": run, "b/2": other}
    write_comparison(runs, tmp_path / "two.rrd", rest["twin"])
    back = read_runs(tmp_path / "two.rrd")
    assert list(back) == list(runs)
    for name, one in runs.items():
        assert dict(back[name].metadata) == dict(one.metadata)
        assert all(back[name][key].tobytes() == np.ascontiguousarray(one[key]).tobytes() for key in one)
    for entity in ("run/b_2", "world/robot/b_2"):
        times, _ = columns_of(tmp_path / "two.rrd", entity)
        assert times[0] == 0
    assert rerun("rrd", "verify", tmp_path / "two.rrd").returncode == 0
    with pytest.raises(InputError, match=r"compares 2 runs \(the first, b/2\)"):
        read_run(tmp_path / "two.rrd")


@pytest.mark.parametrize("names", [(), ("a b", "a_b"), ("",)])
def test_runs_that_cannot_be_told_apart_are_refused(names, parts, tmp_path):
    with pytest.raises(InputError, match=r"no runs|names that differ"):
        write_comparison(dict.fromkeys(names, parts[0]), tmp_path / "two.rrd")
    assert not list(tmp_path.iterdir())


def test_a_recording_that_was_cut_short_or_is_none_is_refused_in_a_line(written, tmp_path):
    whole = written.read_bytes()
    changed = bytearray(whole)
    changed[len(whole) // 2 : len(whole) // 2 + 400] = bytes(400)
    rec = rr.RecordingStream("another", send_properties=False)
    rec.save(tmp_path / "foreign.rrd")
    rec.log("points", rr.Points3D([[0, 0, 0]]))
    rec.log("run", rr.TextDocument("not a table"), static=True)
    rec.flush()
    rec.disconnect()
    for name, content, said in (
        ("half.rrd", whole[: len(whole) // 2], "can be read|cut short"),
        ("no_end.rrd", whole[:-5000], "can be read|cut short"),
        ("changed.rrd", bytes(changed), "can be read"),
        ("text.rrd", b"t,b_total_nt\n0,1\n" * 99, "not a Rerun recording that can be read"),
        ("empty.rrd", b"", "not a Rerun recording that can be read"),
        ("foreign.rrd", None, "not one of a run"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=said) as refused:
            read_run(tmp_path / name)
        assert str(refused.value).startswith(str(tmp_path / name))
        assert "\n" not in str(refused.value)


@pytest.fixture
def no_display(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    if sys.platform != "linux":
        pytest.skip("only on Linux a display can be taken away")


@pytest.mark.usefixtures("no_display")
def test_without_a_display_the_error_names_the_run_or_the_browser(parts, written, tmp_path):
    source = tmp_path / "run.parquet"
    with pytest.raises(InputError, match="the Rerun viewer opened no window: ") as refused:
        show_run(parts[0], file=source)
    text = str(refused.value)
    assert text.startswith(f"{source}: ")
    assert text.endswith(f"; without a display, magtwin report {source} --out run.html makes a page of it")
    with pytest.raises(InputError, match=r"opened no window: .*DISPLAY.*; .*rerun --web-viewer --bind 127"):
        show(written)


def test_a_run_from_any_file_is_shown_as_series_and_one_without_plotted_columns_is_refused(
    parts, tmp_path, monkeypatch
):
    run, _ = parts
    seen = tmp_path / "seen.rrd"
    monkeypatch.setattr("magtwin.io.rerun.file.show", lambda rrd, **_: shutil.copy(rrd, seen))
    show_run(run, file="run.parquet")
    assert np.array_equal(read_run(seen)["b_disturbance_nt"], run["b_disturbance_nt"])
    bare = Run({"t": np.arange(3.0), "est_bias_nt": np.zeros(3)})
    with pytest.raises(InputError, match=r"run\.parquet: holds none of the columns that are plotted, such"):
        show_run(bare, file="run.parquet")


@pytest.mark.usefixtures("drawable")
def test_the_viewer_draws_every_view_without_a_complaint(written, tmp_path):
    assert screenshot(written, tmp_path / "run.png", time_s=9.0, size=(800, 500)) == []
    content = (tmp_path / "run.png").read_bytes()
    assert content[:4] == b"\x89PNG"
    assert [int.from_bytes(content[k : k + 4]) for k in (16, 20)] == [800, 500]


def test_what_is_no_recording_is_refused_before_a_viewer_starts(written, tmp_path, monkeypatch):
    monkeypatch.setattr("magtwin.io.rerun.viewer.live_viewer", lambda **options: pytest.fail("was started"))
    fake, out = tmp_path / "fake.rrd", tmp_path / "run.png"
    fake.write_text("t,b\n0,1\n")
    with pytest.raises(InputError, match=r"fake\.rrd: not a Rerun recording"):
        screenshot(fake, out)
    with pytest.raises(InputError, match=r"a folder; name the \.rrd file in it"):
        screenshot(tmp_path, out)
    with pytest.raises(InputError, match=r"must lie in 200\.\.8000 pixels each way, got 20 x 500"):
        screenshot(written, out, size=(20, 500))
    assert not out.exists()


@pytest.mark.usefixtures("drawable")
def test_the_picture_command_draws_a_recording_and_refuses_a_time_beyond_it(written, tmp_path, capsys):
    out = tmp_path / "run.png"
    with pytest.raises(SystemExit):
        main(["plot", str(written), "--out", str(out), "--at", "9999"])
    assert re.search(r"the recording goes from 0 to [\d.]+ s; there is no 9999 s", capsys.readouterr().err)
    assert not out.exists()
    main(["plot", str(written), "--out", str(out), "--at", "5", "--size", "640x400"])
    with Image.open(out) as image:
        assert image.size == (640, 400)
        assert np.std(np.asarray(image.convert("L"))) > 20


@pytest.mark.usefixtures("drawable")
def test_a_picture_that_is_interrupted_leaves_no_viewer_and_no_file(written, tmp_path):
    if not FilePath("/proc").is_dir():
        pytest.skip("processes are read from /proc, which is not there")

    def viewers(parent):
        found = []
        for stat in FilePath("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                words = stat.read_text().rpartition(")")[2].split()
                if int(words[1]) == parent and b"--headless" in (stat.parent / "cmdline").read_bytes():
                    found.append(stat.parent)
        return found

    command = [sys.executable, "-m", "magtwin", "plot", str(written), "--out", str(tmp_path / "run.png")]
    (temporary := tmp_path / "temporary").mkdir()
    environment = {**os.environ, "TMPDIR": str(temporary)}
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, env=environment)
    try:
        found = wait_until(lambda: viewers(process.pid))
        assert len(found) == 1
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE_S) == 130
    finally:
        process.kill()
        process.wait()
    assert not found[0].exists()
    assert [path.name for path in tmp_path.iterdir() if "run.png" in path.name] == []
    assert list(temporary.iterdir()) == []


@pytest.mark.usefixtures("drawable")
def test_the_viewer_listens_on_this_machine_only_and_ends_with_its_block():
    tables = [path for path in map(FilePath, ("/proc/net/tcp", "/proc/net/tcp6")) if path.exists()]
    if not tables:
        pytest.skip("listening sockets are read from /proc, which is not there")

    def listening(port):
        rows = [line.split() for table in tables for line in table.read_text().splitlines()]
        return [row[1] for row in rows if row[1].endswith(f":{port:04X}") and row[3] == "0A"]

    with live_viewer(headless=True) as (address, _):
        port = int(address.rsplit(":", 1)[1].split("/")[0])
        assert listening(port) == [f"0100007F:{port:04X}"]
    assert listening(port) == []


def test_metadata_in_the_viewer_are_text_and_no_markdown():
    page = recording.metadata_page({"scene": "![x](http://a.example/t.png) <b> \u202e\x1b a\\|b\n| c"})
    (text,) = page.text.as_arrow_array().to_pylist()
    cell = text.splitlines()[2]
    assert cell == r"| scene | \!\[x\](http://a.example/t.png) \<b\> \\u202e\\x1b a\\\|b \| c |"


def test_a_viewer_that_lives_is_waited_for_and_a_command_is_sent_once(monkeypatch):
    monkeypatch.setattr(viewer, "LATE_S", 0.05)
    sent, ended = [], [None]

    def ask(name, late):
        sent.append(name)
        if late and sent.count(name) < 3:
            time.sleep(late)
            raise RuntimeError("deadline has elapsed")
        return name

    names = ("take_screenshot", "run_command", "get_state", "open", "save_screenshot")
    slow = SimpleNamespace(**{name: lambda late=0.0, name=name: ask(name, late) for name in names})
    client = viewer._Patient(slow, SimpleNamespace(poll=lambda: ended[0]))
    assert client.take_screenshot(0.06) == "take_screenshot"
    assert client.run_command(0.06) == "get_state"
    assert sent == ["take_screenshot"] * 3 + ["run_command", "get_state"]
    with pytest.raises(RuntimeError):
        client.open(0.01)  # it came at once
    ended[0] = 1
    with pytest.raises(RuntimeError):
        client.save_screenshot(0.06)
