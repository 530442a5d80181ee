"""A finished run in a viewer, in step with the clock."""

import socket
import threading
import time

import numpy as np
import pytest
from waiting import wait_until

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.io.formats import read_run
from magtwin.io.rerun.live import check_listens, play
from magtwin.io.rerun.viewer import live_viewer
from magtwin.twin import open_twin, simulate


@pytest.fixture(scope="module")
def twin(lab_scene):
    return open_twin(lab_scene, network="none")


@pytest.fixture(scope="module")
def run(twin):
    return simulate(twin, "figure8", seed=1, duration_s=3.0)


def deaf_address() -> str:
    """Where something listens that is no viewer, and says nothing."""
    server = socket.create_server(("127.0.0.1", 0))

    def hang_up() -> None:
        for _ in range(20):
            server.accept()[0].close()

    threading.Thread(target=hang_up, daemon=True).start()
    return f"rerun+http://127.0.0.1:{server.getsockname()[1]}/proxy"


@pytest.mark.parametrize(
    ("address", "words"), [("rerun+http://127.0.0.1:9/proxy", "no viewer"), ("127.0.0.1:9", "no address")]
)
def test_where_no_viewer_listens_is_refused(address, words):
    with pytest.raises(InputError, match=words):
        check_listens(address)


@pytest.mark.parametrize(
    ("settings", "options", "words"),
    [
        ({"VIEWER": "rerun+http://127.0.0.1:9/proxy"}, [], "no viewer"),
        ({"PACE": "2"}, [], "pace"),
        ({"PACE": "0"}, ["--live"], "pace"),
        ({"VIEWER": "rerun+http://127.0.0.1:9/proxy"}, ["--live"], "give one"),
        ({"OUT_UNIT": "nT"}, [], "for a bag"),
        ({"USD_FPS": "10"}, [], "for a USD layer"),
    ],
)
def test_options_that_cannot_be_are_refused_before_anything_is_written(
    settings, options, words, lab_scene, tmp_path, monkeypatch, capsys
):
    for name, value in settings.items():
        monkeypatch.setenv(f"MAGTWIN_RUN_{name}", value)
    with pytest.raises(SystemExit):
        main(["run", str(lab_scene), "--network", "none", "--out", str(tmp_path / "out"), *options])
    assert words in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())


def test_a_viewer_that_does_not_answer_costs_no_output(lab_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MAGTWIN_RUN_PACE", "50")
    monkeypatch.setenv("MAGTWIN_RUN_VIEWER", deaf_address())
    words = ["--network", "none", "--duration-s", "1", "--out", str(tmp_path / "out")]
    main(["run", str(lab_scene), *words, "--json"])
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["run.parquet", "run.png", "run.rrd"]
    table = read_run(tmp_path / "out" / "run.parquet")
    assert np.array_equal(read_run(tmp_path / "out" / "run.rrd")["b_total_nt"], table["b_total_nt"])


@pytest.mark.usefixtures("drawable")
def test_a_viewer_gets_the_run_in_step_with_the_clock(run, twin):
    told = []
    with live_viewer(headless=True) as (address, client):
        begun = time.monotonic()
        play(run, twin, address, pace=2.0, progress=lambda *words: told.append(words))
        assert time.monotonic() - begun >= 1.4
        wait_until(lambda: any(one.timelines for one in client.get_state().recordings))
    assert told[-1][:2] == (3, 3)
    assert len(told) > 5
