"""Worker processes: results, retries, time limits, and what is left after an interruption."""

import os
import signal
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import chunk_work
import pytest
from waiting import PATIENCE_S, wait_until

from magtwin.errors import InputError
from magtwin.parallel import WorkerError, in_shard, open_pool, parse_shard


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    """Workers import the functions of tests."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(chunk_work.__file__).parent), *sys.path]))


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def gone(pids):
    """Whether processes end."""
    return wait_until(lambda: not any(map(alive, pids)))


def test_each_chunk_has_its_result_and_progress_counts_them():
    said = []
    with open_pool(2) as pool:
        outcomes = list(pool.run(chunk_work.square, range(20), progress=lambda *at: said.append(at)))
        assert sorted((o.index, o.result()) for o in outcomes) == [(k, k * k) for k in range(20)]
        assert said == [(k, 20) for k in range(21)]
        again = {o.result() for o in pool.run(partial(pow, 2), [3, 4])}  # the same workers, other work
    assert again == {8, 16}
    assert list(open_pool(2).run(chunk_work.square, [])) == []


def test_workers_have_one_thread_and_are_as_many_as_asked_for():
    with open_pool(2) as pool:
        outcomes = [o.result() for o in pool.run(chunk_work.threads, range(6))]
    assert {(count, *libraries) for count, libraries, _ in outcomes} == {(1, 1)}
    assert os.getpid() not in {pid for *_, pid in outcomes}
    assert len({pid for *_, pid in outcomes}) <= 2


def test_an_exception_is_the_outcome_of_its_chunk_only():
    with open_pool(1) as pool:
        outcomes = {o.index: o for o in pool.run(chunk_work.refuse, range(5))}
    assert [outcomes[k].value for k in (0, 4)] == [0, 4]
    assert {outcomes[k].failure.kind for k in (1, 2, 3)} == {"raised"}
    with pytest.raises(InputError, match="x must not be 1") as refused:
        outcomes[1].result()
    assert refused.value.parameter == "x"
    with pytest.raises(WorkerError, match=r"ZeroDivisionError: two(.|\n)*in refuse"):
        outcomes[2].result()
    assert outcomes[3].failure.reason == "SystemExit: 3"


@pytest.mark.parametrize(("times", "failed"), [(2, False), (3, True)])
def test_a_killed_chunk_is_tried_two_more_times(tmp_path, times, failed):
    with open_pool(2) as pool:
        work = partial(chunk_work.die_until, str(tmp_path), times)
        outcomes = {o.index: o for o in pool.run(work, range(4))}
    assert [outcomes[k].result() for k in (0, 2, 3)] == [0, 2, 3]
    assert len(list(tmp_path.iterdir())) == 3
    if failed:
        assert outcomes[1].failure.kind == "lost"
        assert "killed by SIGKILL" in outcomes[1].failure.reason
    else:
        assert outcomes[1].result() == 1


def test_a_worker_that_is_killed_from_outside_is_replaced(tmp_path):
    def kill() -> None:
        wait_until(lambda: list(tmp_path.glob("2-*")))
        os.kill(int(next(tmp_path.glob("2-*")).name.partition("-")[2]), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    with open_pool(2) as pool:
        work = partial(chunk_work.waits_to_be_killed, str(tmp_path), 2)
        outcomes = list(pool.run(work, range(6), limit_s=PATIENCE_S))
    killer.join()
    assert sorted(o.result() for o in outcomes) == list(range(6))
    assert len(list(tmp_path.glob("2-*"))) == 2


def test_a_chunk_that_hangs_is_stopped_and_the_others_go_on():
    with open_pool(2) as pool:
        outcomes = {o.index: o for o in pool.run(chunk_work.hang, range(4), limit_s=4.0)}
    assert [outcomes[k].result() for k in (0, 2, 3)] == [0, 2, 3]
    failure = outcomes[1].failure
    assert (failure.kind, failure.at) == ("late", "the second of three")
    assert "within" in failure.reason


def test_a_beat_gives_a_chunk_its_time_again():
    with open_pool(1) as pool:
        (outcome,) = pool.run(chunk_work.beating, [1], limit_s=3.0)  # takes 4 s
    assert outcome.result() == 1


def test_processes_that_a_task_has_started_end_with_it(tmp_path):
    with open_pool(1) as pool:
        (outcome,) = pool.run(partial(chunk_work.grandchild, str(tmp_path)), [1], limit_s=5.0)
    assert outcome.failure.kind == "late"
    (mark,) = tmp_path.iterdir()
    assert gone([int(mark.name)])


SCRIPT = """
import sys
import threading
from functools import partial
import chunk_work
from magtwin.parallel import open_pool

if __name__ == "__main__":
    with open_pool(2) as pool:
        for outcome in pool.run(partial(chunk_work.slow, sys.argv[1], 60), range(4)):
            print(outcome)
"""


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_worker_outlives_the_program(tmp_path, how):
    marks, script = tmp_path / "marks", tmp_path / "script.py"
    marks.mkdir()
    script.write_text(SCRIPT)
    program = subprocess.Popen([sys.executable, script, marks], stderr=subprocess.PIPE, text=True)
    wait_until(lambda: len(list(marks.iterdir())) >= 2)
    workers = [int(mark.name.partition("-")[2]) for mark in marks.iterdir()]
    assert len(workers) == 2
    program.send_signal(how)
    err = program.communicate(timeout=PATIENCE_S)[1]
    assert program.returncode == -how
    assert gone(workers)
    assert err.count("Traceback") == (how == signal.SIGINT)  # that of the program itself


def test_a_script_without_a_guard_is_told_so(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "from magtwin.parallel import open_pool\nwith open_pool(2) as pool:\n    [*pool.run(abs, [1, 2])]\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1  # that of the program itself
    assert done.stderr.splitlines()[-1] == (
        "magtwin.errors.InputError: worker processes import the script that starts them: let it begin its "
        'work below `if __name__ == "__main__":`'
    )


def test_shards_split_all_chunks():
    for count in (1, 2, 7):
        shards = [[k for k in range(20) if in_shard(k, parse_shard(f"{i}/{count}"))] for i in range(count)]
        assert sorted(k for shard in shards for k in shard) == list(range(20))


@pytest.mark.parametrize("text", ["2/2", "1", "a/b", "-1/2", "0/0", "1/2/3"])
def test_a_wrong_shard_is_refused(text):
    with pytest.raises(InputError, match="shard"):
        parse_shard(text)


@pytest.mark.parametrize("jobs", [0, -1, 1.5, True])
def test_a_wrong_number_of_jobs_is_refused(jobs):
    with pytest.raises(InputError, match="`jobs` must be a whole number from 1 up"):
        open_pool(jobs)


def test_more_processes_than_the_memory_holds_are_refused_before_one_starts(monkeypatch):
    from magtwin.parallel import processes

    monkeypatch.setattr(processes, "free_memory", lambda: 3_000_000_000)
    monkeypatch.setattr(processes, "processors", lambda: 4)
    text = r"50 processes need about 15 GB of memory, and 3 GB are free; give `jobs` of at most 10"
    with open_pool(10**12) as pool, pytest.raises(InputError, match=text):
        list(pool.run(chunk_work.square, range(50)))
    with open_pool(10**12) as pool:  # as many workers as chunks
        assert [outcome.result() for outcome in pool.run(chunk_work.square, [3])] == [9]
