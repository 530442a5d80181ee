"""Chunks of work in other processes: on this machine, or on the workers of a dask cluster.

A task is a pure function that can be pickled, such as a function of a module, or a `functools.partial` of
one. It gets one chunk and returns one result. A `Pool` calls it for many chunks, and yields the results as
they are ready:

    with open_pool(jobs=4) as pool:
        for outcome in pool.run(simulate_block, blocks, limit_s=600):
            if outcome.failure:
                print(outcome.index, outcome.failure.reason)
            else:
                write(outcome.index, outcome.value)

- Results arrive in any order. They depend on neither the number of processes nor the machine: linear algebra
  and compiled loops use one thread in a worker.
- A worker that is killed or crashes is replaced, and its chunk is tried again, at most `RETRIES` times.
- A chunk that takes longer than its limit is stopped by killing its worker. A function that reports to
  `beat` gets that time again after each report.
- At the end of the block, by Ctrl-C or any other exception, all workers are killed. If the program itself is
  killed, its workers end themselves.
- Functions of a script are found by importing it, so a script that opens a pool needs
  `if __name__ == "__main__":`.

The process that opened the pool writes the results, so workers need no folder in common with it.
"""

from collections.abc import Callable, Sequence
from typing import Any

from magtwin.errors import InputError
from magtwin.parallel.machine import check_room, free_memory, processors
from magtwin.parallel.pool import RETRIES, C, Failure, Outcome, Pool, R, WorkerError
from magtwin.parallel.shard import checked_shard, in_shard, parse_shard
from magtwin.parallel.worker import beat

__all__ = [
    "RETRIES",
    "Failure",
    "Outcome",
    "Pool",
    "WorkerError",
    "beat",
    "check_room",
    "checked_shard",
    "free_memory",
    "in_shard",
    "open_pool",
    "parse_shard",
    "processors",
    "run_all",
]


def open_pool(jobs: int | None = None, *, dask: str | None = None) -> Pool:
    """Start workers.

    Args:
        jobs: Processes on this machine. Default: one for each processor that this process may use.
        dask: Address of a dask scheduler, such as "tcp://10.0.0.1:8786", whose workers are used instead.

    Raises:
        InputError: `jobs` is not a whole number from 1 up, the extra `cluster` is not installed, the
            scheduler does not answer, it has no workers, or they have another version of magtwin.
    """
    if jobs is not None and (isinstance(jobs, bool) or not isinstance(jobs, int) or jobs < 1):
        raise InputError(f"`jobs` must be a whole number from 1 up, got {jobs!r}", parameter="jobs")
    if dask is None:
        from magtwin.parallel.processes import Processes

        return Processes(jobs or processors())
    if jobs is not None:
        raise InputError("`dask` has its own workers; drop `jobs`", parameter="jobs")
    from magtwin.parallel.cluster import Cluster

    return Cluster(dask)


def run_all(
    work: Callable[[C], R],
    chunks: Sequence[C],
    *,
    jobs: int | None = None,
    progress: Callable[[int, int], Any] = lambda done, total: None,
) -> list[R]:
    """Call a function for every chunk; gives the results in the order of the chunks.

    Args:
        work: A pure function. With `jobs` it and its chunks must be of the kind that can be pickled.
        chunks: What it is called with, one at a time.
        jobs: Processes on this machine. Default: this process, whose compiled loops use several threads.
        progress: Called with the chunks done and all chunks.

    Raises:
        InputError: `jobs` is wrong, or the function refused a chunk.
        WorkerError: A worker failed in another way.
    """
    if jobs is None:
        results = []
        for k, chunk in enumerate(chunks):
            progress(k, len(chunks))
            results.append(work(chunk))
        progress(len(chunks), len(chunks))
        return results
    with open_pool(jobs) as pool:
        outcomes = {each.index: each.result() for each in pool.run(work, chunks, progress=progress)}
    return [outcomes[k] for k in range(len(chunks))]
