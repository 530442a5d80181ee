"""Progress of commands: when lines come, what they say, and that no output is broken into lines of 80."""

import io
import json
import os
import re
import subprocess
import sys
import threading
import time
from contextlib import suppress

import pytest
from waiting import wait_until

from magtwin.cli import main
from magtwin.cli.progress import EVERY_S, FIRST_S, Step, Watch, step, watched


class Clock:
    """A clock that is set by hand."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def stream():
    return io.StringIO()


@pytest.fixture
def watch(clock, stream):
    return Watch(stream=stream, clock=clock)


def times_of_lines(watch, clock, stream, until, every=0.1):
    """When lines came, while a thread looks every tenth of a second."""
    found, before = [], len(stream.getvalue())
    while clock.now < until:
        clock.now += every
        watch.tick()
        if len(stream.getvalue()) > before:
            found.append(clock.now)
            before = len(stream.getvalue())
    return found


def test_the_first_line_comes_within_2_s_and_the_next_ones_every_10_s(watch, clock, stream):
    times = times_of_lines(watch, clock, stream, 60.0)
    assert times == pytest.approx([1.5, 11.5, 21.5, 31.5, 41.5, 51.5], abs=0.11)
    assert FIRST_S < 2
    assert EVERY_S == 10
    assert stream.getvalue().splitlines()[0] == "  Starting: 2 s so far"


@pytest.mark.parametrize(
    ("reports", "now", "said"),
    [
        ([(20 * k, k, 100) for k in range(11)], 200, "0.05 runs/s, 30 min 0 s left"),
        ([(k, k, 100) for k in range(11)], 20, "0.5 runs/s, 3 min 0 s left"),  # late
        ([(k, 50_000 + 100 * k, 100_000) for k in range(5)], 4, "100 runs/s, 8 min 16 s left"),  # resumed
        ([(1, 0, 10), (2, 10, 10), (3, 0, 40), (5, 4, 40)], 5, "4 of 40 runs, 2 runs/s, 18 s left"),  # anew
        ([(1, 0, 10), (2, 10, 10), (3, 0, 40)], 3, "0 of 40 runs, 3 s so far"),
    ],
)
def test_rates_and_times_left_are_those_of_the_loop(reports, now, said):
    one = Step("Driving", "runs", 0.0)
    for report in reports:
        one.advance(*report)
    assert said in one.line(now)


def test_an_unknown_length_tells_the_time_that_has_gone(watch, clock, stream):
    clock.now = 5.0
    watch.step("Drawing the stage", announced=True)
    clock.now = 7.0
    watch.tick()
    with watch.progress("Recording", "messages") as advance:
        advance(0, None)
        clock.now = 17.5
        advance(2100, None)
    assert stream.getvalue().splitlines() == [
        "  Drawing the stage ...",
        "  Drawing the stage: 2 s so far",
        "  Recording: 2,100 messages, 200 messages/s, 10 s so far",
    ]


def test_a_thread_prints_what_a_library_without_a_hook_takes_long_for(capsys):
    with watched():
        step("Waiting for a library")
        said = wait_until(lambda: capsys.readouterr().err)
    assert re.fullmatch(r"  Waiting for a library: \d+ s so far\n", said)
    assert not [t for t in threading.enumerate() if t.name == "magtwin-progress"]


@pytest.fixture(scope="module")
def long_run(tmp_path_factory):
    """A run whose name and metadata are longer than a line of 80."""
    import numpy as np

    from magtwin.io.tables import write_parquet
    from magtwin.run.run import Run

    folder = tmp_path_factory.mktemp("a-folder-with-a-name-that-is-long" * 2)
    run = Run({"t": np.arange(5.0), "b_total_nt": np.full(5, 4e4)}, {"scene_file": "word " * 40 + "end"})
    write_parquet(run, folder / f"{'a-long-name-' * 8}.parquet")
    return folder / f"{'a-long-name-' * 8}.parquet"


@pytest.fixture
def piped(monkeypatch, capsys):
    """A function that gives stdout and stderr of a command, in an environment without a width."""
    monkeypatch.delenv("COLUMNS", raising=False)

    def run(*arguments):
        with suppress(SystemExit):
            main([str(word) for word in arguments])
        return capsys.readouterr()

    return run


def test_piped_reports_are_not_broken_and_have_no_spaces_at_the_end(long_run, piped):
    out = piped("info", long_run).out
    assert out.splitlines()[0] == str(long_run)
    assert len(str(long_run)) > 150
    assert any(line.endswith("word word end") for line in out.splitlines())
    assert not re.search(r" +$", out, re.M)
    assert any(re.match(r"  b_total_nt  nT  .*$", line) for line in out.splitlines())


@pytest.mark.parametrize("words", [("run", "--help"), ("info", "lab")])
def test_output_that_nobody_reads_to_its_end_gives_status_141_and_no_text(words):
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-c", "from magtwin.start import main; main()", *words]
    done = subprocess.run(command, stdout=writing, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writing)
    assert done.returncode == 141
    assert all(line.startswith("  ") for line in done.stderr.splitlines())  # progress, on a slow machine


def test_json_stays_json_while_progress_goes_to_stderr(long_run, monkeypatch, capsys):
    from magtwin.io import info

    whole = info.info_of
    monkeypatch.setattr(info, "info_of", lambda path, **how: time.sleep(2.2) or whole(path, **how))
    main(["info", str(long_run), "--json"])
    out, error = capsys.readouterr()
    assert json.loads(out)["figures"]
    assert re.match(r"  Reading a-long.*( \.\.\.|: [1-9] s so far)\n", error)
    main(["info", str(long_run), "--quiet"])
    assert capsys.readouterr() == ("", "")


def test_on_a_terminal_one_line_is_drawn_again_and_disappears(clock, stream, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    watch = Watch(stream=stream, clock=clock, terminal=True)
    with watch.progress("Driving figure8 with a long name of a path that has no end", "runs") as advance:
        advance(0, 10)
        assert stream.getvalue() == ""  # a short step is not drawn
        clock.now = 1.0
        advance(5, 10)
        clock.now = 1.05
        advance(6, 10)  # too early to draw again
    watch.clear()
    drawn = stream.getvalue().split("\r\033[2K")
    assert drawn[0] == drawn[-1] == ""
    assert drawn[1] == "  [##########..........] Driving figure8 with a long name of a"[:59]
    assert len(drawn) == 3
    watch.announces = True
    watch.step("simulating", announced=True)
    assert stream.getvalue().endswith("  simulating ...\n")
