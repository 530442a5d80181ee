"""A run that goes on: into files that survive whatever ends it, and into a viewer."""

import os
import signal
import socket
import subprocess
import sys
import threading

import numpy as np
import pytest
from waiting import wait_until

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.io.bags import BagWriter
from magtwin.io.formats import read_run
from magtwin.io.recorder import FLUSH_S, TICK_S, Recorder, in_step, partial_of
from magtwin.io.rerun.file import read_run as read_rrd
from magtwin.io.rerun.live import LiveViewer, RrdWriter
from magtwin.io.rerun.viewer import live_viewer
from magtwin.io.tables import ParquetParts, read_parquet
from magtwin.run.run import Column, Run
from magtwin.twin import open_twin, simulate

CHILD = """
import sys
from magtwin.io.rerun.live import RrdWriter
from magtwin.io.recorder import Recorder, in_step
from magtwin.io.bags import BagWriter
from magtwin.io.tables import ParquetParts, read_parquet

folder = sys.argv[1]
run = read_parquet(f"{folder}/whole.parquet")
table, bag = ParquetParts(f"{folder}/run.parquet"), BagWriter(f"{folder}/run.mcap")
with Recorder([RrdWriter(f"{folder}/run.rrd"), table, bag]) as recorder:
    for block in in_step(run):
        recorder.append(block)
        print(block["t"][-1], flush=True)
"""


@pytest.fixture(scope="module")
def twin(lab_scene):
    return open_twin(lab_scene, network="none")


@pytest.fixture(scope="module")
def run(twin) -> Run:
    return simulate(twin, "figure8", seed=1, duration_s=12.0)


def equal(a: Run, b: Run) -> bool:
    same = list(a) == list(b) and dict(a.metadata) == dict(b.metadata)
    return same and all(a[name].tobytes() == np.ascontiguousarray(b[name]).tobytes() for name in b)


def rows(run: Run, part: slice) -> Run:
    return run.take(part)


def test_a_run_that_is_killed_leaves_files_that_lack_no_more_than_the_last_second(run, tmp_path):
    from magtwin.io.tables import write_parquet

    write_parquet(run, tmp_path / "whole.parquet")
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    driven = 0.0
    while driven < 2.5:
        driven = float(child.stdout.readline())
    child.kill()
    driven = float(([driven, *child.stdout.read().split()])[-1])
    child.wait()
    child.stdout.close()
    names = {"run.partial.rrd", "run.parquet.parts", "run.partial.mcap"}
    assert {path.name for path in tmp_path.iterdir()} == names | {"whole.parquet"}
    for name in names:
        left = read_run(tmp_path / name)
        assert left["t"][-1] > driven - 1.0, name
        assert np.array_equal(left["b_total_nt"], run["b_total_nt"][: left.rows]), name
        assert left.metadata["seed"] == 1
    assert equal(
        read_run(tmp_path / "run.partial.rrd"), rows(run, slice(read_run(tmp_path / "run.partial.rrd").rows))
    )


def test_a_recording_that_broke_off_in_a_message_is_read_up_to_it(run, tmp_path):
    writer = RrdWriter(tmp_path / "run.rrd")
    for k in range(4):
        writer.append(rows(run, slice(100 * k, 100 * (k + 1))))
    bytes_ = writer.partial.read_bytes()
    writer.abort()
    sizes = []
    for end in range(len(bytes_) - 20_000, len(bytes_), 1999):
        (tmp_path / "cut.partial.rrd").write_bytes(bytes_[:end])
        left = read_rrd(tmp_path / "cut.partial.rrd")
        assert equal(left, rows(run, slice(left.rows)))
        sizes.append(left.rows)
    assert set(sizes) <= {100, 200, 300, 400}
    (tmp_path / "cut.rrd").write_bytes(bytes_)
    with pytest.raises(InputError, match="was cut short: it holds 400 rows of a run that did not end"):
        read_rrd(tmp_path / "cut.rrd")
    assert max(sizes) == 400


def test_blocks_make_the_file_that_the_whole_run_makes(run, twin, tmp_path):
    sinks = [RrdWriter(tmp_path / "run.rrd", twin), ParquetParts(tmp_path / "run.parquet")]
    with Recorder([*sinks, BagWriter(tmp_path / "run.mcap", twin)]) as recorder:
        for start in range(0, run.rows, 77):
            recorder.append(rows(run, slice(start, start + 77)))
        assert not (tmp_path / "run.rrd").exists()
    assert recorder.rows == run.rows
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.mcap", "run.parquet", "run.rrd"]
    assert equal(read_rrd(tmp_path / "run.rrd"), run)
    assert equal(read_parquet(tmp_path / "run.parquet"), run)
    assert read_run(tmp_path / "run.mcap").rows == run.rows


def test_blocks_keep_what_is_said_of_columns_of_a_users_own(tmp_path):
    spec = Column("K", "room", "temperature", 2, ("in", "out"), interpolation="hold")
    run = Run({"t": np.arange(9.0), "heat": np.ones((9, 2))}, {"seed": 1}, {"heat": spec})
    names = ["run.rrd", "run.parquet", "run.mcap"]
    sinks = [
        kind(tmp_path / name) for kind, name in zip((RrdWriter, ParquetParts, BagWriter), names, strict=True)
    ]
    with Recorder(sinks) as recorder:
        for block in in_step(run, 1e3):
            recorder.append(block)
    for name in names:
        assert read_run(tmp_path / name).spec("heat") == spec


def test_a_fault_leaves_what_there_is_under_its_unfinished_name(run, tmp_path):
    with pytest.raises(ZeroDivisionError), Recorder([RrdWriter(tmp_path / "run.rrd")]) as recorder:  # noqa: PT012
        recorder.append(rows(run, slice(50)))
        recorder.flush()
        raise ZeroDivisionError
    assert [path.name for path in tmp_path.iterdir()] == ["run.partial.rrd"]
    assert read_rrd(tmp_path / "run.partial.rrd").rows == 50
    with pytest.raises(InputError, match=r"run\.partial\.rrd: exists already"):
        RrdWriter(tmp_path / "run.rrd")


def test_a_fault_before_the_first_rows_leaves_nothing_in_the_way(tmp_path):
    sinks = [RrdWriter(tmp_path / "run.rrd"), ParquetParts(tmp_path / "run.parquet")]
    with pytest.raises(ZeroDivisionError), Recorder([*sinks, BagWriter(tmp_path / "run.mcap")]):
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_an_unfinished_recording_under_a_finished_name_is_refused(run, tmp_path):
    writer = RrdWriter(tmp_path / "run.rrd")
    writer.append(run)
    writer.abort()
    writer.partial.rename(tmp_path / "moved.rrd")
    with pytest.raises(InputError, match=r"was cut short.*rename it to moved\.partial\.rrd"):
        read_rrd(tmp_path / "moved.rrd")


def test_a_recording_of_no_rows_leaves_nothing(tmp_path):
    with Recorder([RrdWriter(tmp_path / "run.rrd"), ParquetParts(tmp_path / "run.parquet")]):
        pass
    assert not list(tmp_path.iterdir())


class Clock:
    """Stands for the clock and for the event on which `in_step` waits; it is set at `end`."""

    def __init__(self, end=np.inf):
        self.now, self.end = 100.0, 100.0 + end

    def monotonic(self):
        return self.now

    def wait(self, seconds):
        self.now += seconds

    def is_set(self):
        return self.now >= self.end


def test_files_are_given_rows_at_least_once_a_second(monkeypatch):
    assert FLUSH_S <= 1.0
    taken, clock = [], Clock()
    monkeypatch.setattr("magtwin.io.recorder.time.monotonic", clock.monotonic)

    class Sink:
        def append(self, run):
            taken.append((clock.now, run.rows))

        def close(self):
            taken.append((clock.now, 0))

    run = Run({"t": np.arange(0, 2.2, 0.01)})
    with Recorder([Sink()]) as recorder:
        for block in in_step(run, stop=clock):
            recorder.append(block)
    assert sum(n for _, n in taken) == run.rows
    assert np.diff([100.0, *(when for when, _ in taken)]).max() <= 1.0


@pytest.mark.parametrize("pace", [0.5, 4.0])
def test_a_run_in_step_with_the_clock_takes_its_time_and_ends_when_told(pace, monkeypatch):
    run = Run({"t": 5 + np.arange(0, 1.0, 0.01)})

    def driven(clock):
        monkeypatch.setattr("magtwin.io.recorder.time.monotonic", clock.monotonic)
        return np.concatenate([block["t"] for block in in_step(run, pace, stop=clock)])

    whole = Clock()
    assert np.array_equal(driven(whole), run["t"])
    assert 0.99 / pace <= whole.now - 100.0 <= 0.99 / pace + 2 * TICK_S
    part = driven(Clock(end=0.2 / pace))
    assert np.array_equal(part, run["t"][: part.size])
    assert part.size == pytest.approx(20, abs=2 + 100 * TICK_S * pace)


def test_a_run_that_is_not_in_step_is_one_block():
    run = Run({"t": 5 + np.arange(0, 1.0, 0.01)})
    assert [block.rows for block in in_step(run, np.inf)] == [run.rows]
    with pytest.raises(InputError, match="pace must be above 0"):
        next(in_step(run, 0.0))


def deaf_address() -> str:
    """Where something listens that is no viewer, and says nothing."""
    server = socket.create_server(("127.0.0.1", 0))
    port = server.getsockname()[1]

    def hang_up() -> None:
        for _ in range(20):
            server.accept()[0].close()

    threading.Thread(target=hang_up, daemon=True).start()
    return f"rerun+http://127.0.0.1:{port}/proxy"


def test_ctrl_c_ends_a_live_run_and_keeps_what_was_driven(lab_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MAGTWIN_RUN_RATE_HZ", "50")
    monkeypatch.setenv("MAGTWIN_RUN_VIEWER", deaf_address())

    def interrupt() -> None:
        while not over.wait(0.05):
            if len(list(tmp_path.glob("out/run.parquet.parts/*"))) > 1:
                os.kill(os.getpid(), signal.SIGINT)
                return

    over, hand = threading.Event(), threading.Thread(target=interrupt)
    hand.start()
    arguments = ["run", str(lab_scene), "--network", "none", "--duration-s", "300", "--json"]
    outputs = ["--out", str(tmp_path / "out"), "--out", str(tmp_path / "run.csv")]
    try:
        main([*arguments, *outputs])
    finally:
        over.set()
        hand.join()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["run.parquet", "run.png", "run.rrd"]
    table = read_run(tmp_path / "out" / "run.parquet")
    assert 0 < table["t"][-1] < 60
    assert equal(read_run(tmp_path / "out" / "run.rrd"), table)
    assert equal(read_run(tmp_path / "run.csv"), table)


def test_a_viewer_that_is_not_there_is_refused_first(lab_scene, tmp_path, monkeypatch, capsys):
    arguments = [
        "run",
        str(lab_scene),
        "--network",
        "none",
        "--duration-s",
        "1",
        "--out",
        str(tmp_path / "out"),
    ]
    for address, said in (
        ("rerun+http://127.0.0.1:9/proxy", "no viewer listens there"),
        ("127.0.0.1:9", "no address of a viewer"),
    ):
        monkeypatch.setenv("MAGTWIN_RUN_VIEWER", address)
        with pytest.raises(SystemExit):
            main(arguments)
        assert said in capsys.readouterr().err.splitlines()[-1]
    monkeypatch.delenv("MAGTWIN_RUN_VIEWER")
    for setting, value, options, said in (
        ("PACE", "2", [], "pace is for a run that is shown"),
        ("PACE", "0", ["--live"], "pace must be above 0"),
        ("VIEWER", "rerun+http://127.0.0.1:9/proxy", ["--live"], "give one of them"),
        ("OUT_UNIT", "nT", [], "out_unit is for a bag"),
        ("USD_FPS", "10", [], "usd_fps is for a USD layer"),
    ):
        with monkeypatch.context() as patch:
            patch.setenv(f"MAGTWIN_RUN_{setting}", value)
            with pytest.raises(SystemExit):
                main([*arguments, *options])
        assert said in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_live_run_that_is_refused_leaves_nothing(lab_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MAGTWIN_RUN_VIEWER", deaf_address())
    far = tmp_path / "far.csv"
    far.write_text("x,y\n0,0\n50,0\n")
    live = ["--out", str(tmp_path / "out"), "--out", str(tmp_path / "a.mcap")]
    with pytest.raises(SystemExit):
        main(["run", str(lab_scene), "--network", "none", "--path", str(far), *live])
    assert "far.csv" in capsys.readouterr().err
    (tmp_path / "a.partial.mcap").touch()
    with pytest.raises(SystemExit):
        main(["run", str(lab_scene), "--network", "none", "--duration-s", "1", *live])
    assert "a.partial.mcap: exists already" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.partial.mcap", "far.csv"]


@pytest.fixture
def drawable():
    """Skips where nothing can be drawn."""
    try:
        with live_viewer(headless=True):
            pass
    except InputError as error:
        if "cannot draw here" not in str(error):
            raise
        pytest.skip(str(error))


@pytest.mark.usefixtures("drawable")
def test_a_viewer_gets_the_run_as_it_goes_on_and_its_end_ends_no_run(run, twin, tmp_path):
    file = RrdWriter(tmp_path / "run.rrd", twin)
    with live_viewer(headless=True) as (address, client):
        viewer = LiveViewer(address, twin, expected=run)
        recorder = Recorder([file], [viewer])
        recorder.append(rows(run, slice(700)))
        wait_until(lambda: any(one.timelines for one in client.get_state().recordings))
        assert viewer.shown
    with recorder:
        recorder.append(rows(run, slice(700, 1400)))
    assert not viewer.shown
    assert read_rrd(tmp_path / "run.rrd").rows == 1400


def test_partial_names_keep_the_ending_that_tells_the_kind(tmp_path):
    assert partial_of(tmp_path / "a.b.rrd").name == "a.b.partial.rrd"
