"""Benchmarks and sweeps on a dask cluster, of which a worker is killed, write what one process writes."""

import signal

import pytest
from dask_cluster import Cluster

from magtwin.bench.results import read_results
from magtwin.bench.runner import benchmark
from magtwin.errors import InputError
from magtwin.twin import open_twin, sweep

pytest.importorskip("distributed")

pytestmark = pytest.mark.filterwarnings("default")  # of dask

SUITE = """
name = "small"
chunk = 1

[[scenario]]
name = "exact"
runs = 8
duration_s = 4.0

[[localizer]]
method = "odometry"
"""


def files_in(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and "times" not in path.parts
    }


def test_a_cluster_writes_the_same_bytes_although_a_worker_is_killed(tmp_path, lab_scene):
    (tmp_path / "dask").mkdir()
    cluster = Cluster(tmp_path / "dask")
    try:
        cluster.add_worker()
        victim = cluster.add_worker("--no-nanny", "--name", "short-lived")
        suite = tmp_path / "small.toml"
        suite.write_text(SUITE)

        def kill(done, total, what):
            if done == 2 and victim.poll() is None:
                victim.send_signal(signal.SIGKILL)

        results = benchmark(suite, tmp_path / "a", dask=cluster.address, progress=kill)
        assert victim.wait(5) == -signal.SIGKILL
        assert results.missing == 0
        assert set(results.rows["status"]) == {"ok"}
        benchmark(suite, tmp_path / "b", jobs=1)
        assert files_in(tmp_path / "a") == files_in(tmp_path / "b")

        options = {"duration_s": 1.0, "rate_hz": 20.0, "sessions": 2}
        runs = sweep(open_twin(lab_scene, magnetometer="neural"), seeds=6, **options)
        runs.save(tmp_path / "c", dask=cluster.address)
        runs.save(tmp_path / "d")
        assert files_in(tmp_path / "c") == files_in(tmp_path / "d")
    finally:
        cluster.close()


@pytest.mark.slow
def test_a_scheduler_that_ends_in_the_middle_is_an_error_and_a_repeat_goes_on(tmp_path):
    (tmp_path / "dask").mkdir()
    cluster = Cluster(tmp_path / "dask")
    suite = tmp_path / "small.toml"
    suite.write_text(SUITE)
    try:
        cluster.add_worker()

        def end(done, total, what):
            if done == 2:
                cluster.processes[0].kill()

        with pytest.raises(InputError, match=r"dask scheduler at .* has ended or dropped the work"):
            benchmark(suite, tmp_path / "a", dask=cluster.address, progress=end)
    finally:
        cluster.close()
    assert 2 <= len(read_results(tmp_path / "a").rows["run"]) < 8
