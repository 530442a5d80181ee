"""Workers of a dask cluster: a real scheduler and real workers on this machine."""

import os
import shutil
import signal
import sys
import threading
import time
from functools import partial
from pathlib import Path

import chunk_work
import pytest
from dask_cluster import Cluster
from waiting import PATIENCE_S, wait_until

import magtwin
from magtwin.errors import InputError
from magtwin.parallel import open_pool
from magtwin.version import __version__

pytest.importorskip("distributed")

pytestmark = pytest.mark.filterwarnings("default")  # of dask


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    cluster = Cluster(tmp_path_factory.mktemp("dask"))
    for _ in range(2):
        cluster.add_worker()
    yield cluster
    cluster.close()


def children_of(pid):
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            text = (folder / "stat").read_text()
        except OSError:
            continue
        if text.rpartition(")")[2].split()[1] == str(pid):
            found += [int(folder.name), *children_of(folder.name)]
    return found


def magtwin_workers(cluster):
    """Processes of tasks below the dask workers, of which each is below a nanny."""
    return [
        pid
        for process in cluster.processes[1:]
        for dask_worker in children_of(process.pid)
        for pid in children_of(dask_worker)
        if "spawn_main" in Path(f"/proc/{pid}/cmdline").read_text()
    ]


def test_results_are_those_of_processes_and_nothing_is_left(cluster):
    with open_pool(dask=cluster.address) as pool:
        outcomes = list(pool.run(chunk_work.square, range(20)))
        assert magtwin_workers(cluster)
    assert sorted((o.index, o.result()) for o in outcomes) == [(k, k * k) for k in range(20)]
    assert not magtwin_workers(cluster)


def test_exceptions_crashes_and_hangs_are_outcomes_of_their_chunks(cluster, tmp_path):
    with open_pool(dask=cluster.address) as pool:
        raised = {o.index: o for o in pool.run(chunk_work.refuse, range(5))}
        killed = {o.index: o for o in pool.run(partial(chunk_work.die_until, str(tmp_path), 3), range(3))}
        late = {o.index: o for o in pool.run(chunk_work.hang, range(3), limit_s=1.0)}
    with pytest.raises(InputError, match="x must not be 1"):
        raised[1].result()
    assert raised[2].failure.reason == "ZeroDivisionError: two"
    assert [raised[k].result() for k in (0, 4)] == [0, 4]
    assert killed[1].failure.kind == "lost"
    assert len(list(tmp_path.iterdir())) == 3
    assert (late[1].failure.kind, late[1].failure.at) == ("late", "the second of three")
    assert [late[k].result() for k in (0, 2)] == [killed[k].result() for k in (0, 2)] == [0, 2]


def test_a_killed_dask_worker_loses_no_chunk(cluster, tmp_path):
    extra = cluster.add_worker("--no-nanny", "--name", "short-lived")
    with open_pool(dask=cluster.address) as pool:
        pool.client.wait_for_workers(3)
        outcomes = []
        for outcome in pool.run(partial(chunk_work.slow, str(tmp_path), 0.3), range(12)):
            if not outcomes:
                extra.send_signal(signal.SIGKILL)
            outcomes.append(outcome)
    assert sorted(o.result() for o in outcomes) == list(range(12))
    extra.wait(PATIENCE_S)
    cluster.processes.remove(extra)


def test_an_interruption_stops_what_the_cluster_does(cluster, tmp_path):
    def interrupt():
        while len(list(tmp_path.iterdir())) < 2:
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGINT)

    def interrupted():
        with open_pool(dask=cluster.address) as pool:
            threading.Thread(target=interrupt).start()
            list(pool.run(partial(chunk_work.slow, str(tmp_path), 60), range(8)))

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    wait_until(lambda: not magtwin_workers(cluster))
    assert len(list(tmp_path.iterdir())) == 2  # nothing else has begun


@pytest.mark.parametrize(
    ("line", "version"), [('__version__ = "0.0.1"', "0.0.1"), ("# a change", __version__)]
)
def test_workers_of_another_version_or_with_other_code_are_refused(tmp_path, line, version):
    package = Path(magtwin.__file__).parent
    shutil.copytree(package, tmp_path / "magtwin", ignore=shutil.ignore_patterns("__pycache__"))
    with open(tmp_path / "magtwin" / "version.py", "a") as file:
        file.write(f"{line}\n")
    other = Cluster(tmp_path)
    try:
        path = other.environment["PYTHONPATH"]
        other.add_worker(PYTHONPATH=os.pathsep.join([str(tmp_path), path]))
        with pytest.raises(InputError, match=rf"has magtwin {version} \(code .*, and this is {__version__} "):
            open_pool(dask=other.address)
    finally:
        other.close()


def test_a_scheduler_that_does_not_answer_is_refused(monkeypatch):
    monkeypatch.setattr("magtwin.parallel.cluster.ANSWER_S", 0.5)
    with pytest.raises(InputError, match=r"no dask scheduler answers at tcp://127\.0\.0\.1:9"):
        open_pool(dask="tcp://127.0.0.1:9")
    with pytest.raises(InputError, match="no dask scheduler answers at nonsense"):
        open_pool(dask="nonsense://x")


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"pip install 'magtwin\[cluster\]'"):
        open_pool(dask="tcp://127.0.0.1:9")
    with pytest.raises(InputError, match="`dask` has its own workers; drop `jobs`"):
        open_pool(2, dask="tcp://127.0.0.1:9")
