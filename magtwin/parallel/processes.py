"""Worker processes on this machine."""

import contextlib
import math
import multiprocessing
import pickle
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import wait
from typing import Any, Self

from magtwin.errors import InputError
from magtwin.parallel.machine import end_group, free_memory, processors, variables
from magtwin.parallel.pool import RETRIES, C, Failure, Outcome, R, WorkerError
from magtwin.parallel.worker import serve

STARTS = 3
"""Workers that may end, one after the other, before any of them was ready."""

UNGUARDED = 97
"""Status of a worker that ended itself, because the script that it imports would start workers again."""

ONE_THREAD = {
    "BLIS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "NUMEXPR_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
}
"""Environment of a worker: libraries of linear algebra, and numba, with one thread."""

_start_lock = threading.Lock()


class _Worker:
    """A process and the chunk that it works on."""

    def __init__(self, idle_s: float | None) -> None:
        context = multiprocessing.get_context("spawn")  # no fork: this process may have threads
        self.connection, theirs = context.Pipe()
        self.process = context.Process(
            target=serve, args=(theirs, idle_s), daemon=True, name="magtwin-worker"
        )
        with _start_lock, _no_interrupt(), _as_parent(), variables(ONE_THREAD):
            self.process.start()
        theirs.close()
        self.ready = False
        self.work: bytes | None = None
        self.chunk: int | None = None
        self.since = time.monotonic()
        self.at, self.times = "", 1.0

    def take(self, index: int, work: bytes, chunk: bytes) -> None:
        """Begin with a chunk; a worker that has ended is noticed later."""
        new_work = None if work == self.work else work
        self.work, self.chunk, self.since = work, index, time.monotonic()
        self.at, self.times = "", 1.0
        with contextlib.suppress(OSError):
            self.connection.send((new_work, chunk))

    def end(self, *, died: bool = False) -> str:
        """Kill the process with those that it started; gives the reason of its end, if it `died` itself."""
        if died:
            self.process.join(1)  # its connection closes a moment before it ends
        code, pid = self.process.exitcode, self.process.pid
        if pid is not None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                end_group(pid)
        self.process.kill()
        self.process.join()
        self.process.close()
        self.connection.close()
        return _reason(code)


def _reason(code: int | None) -> str:
    """Why a process ended."""
    if code is None or code >= 0:
        return f"ended with status {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else str(-code)
    return f"was killed by {name}" + (", as by a lack of memory" if name == "SIGKILL" else "")


WORKER_BYTES = 300_000_000
"""Memory of a worker that simulates or labels."""


def _check_memory(workers: int) -> None:
    """Refuse more workers than there are processors if their memory is not free."""
    free = free_memory()
    if workers > processors() and free is not None and workers * WORKER_BYTES > free:
        need, have = (f"{size / 1e9:.3g} GB" for size in (workers * WORKER_BYTES, free))
        raise InputError(
            f"{workers:,} processes need about {need} of memory, and {have} are free; give `jobs` of at most "
            f"{max(processors(), free // WORKER_BYTES)}",
            parameter="jobs",
        )


class Processes:
    """A pool of processes on this machine. They start when there is work, and stay for the next.

    Args:
        jobs: Number of processes.
        idle_s: Time after which a process without work ends itself [s]. Default: never.
    """

    def __init__(self, jobs: int, *, idle_s: float | None = None) -> None:
        if getattr(multiprocessing.current_process(), "_inheriting", False):  # as multiprocessing checks it
            sys.exit(UNGUARDED)
        self.jobs, self._idle_s = jobs, idle_s
        self._workers: list[_Worker] = []
        self._failed_starts = 0
        self._stopped = False
        self._heard: Callable[[int, str], Any] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Kill all workers."""
        while self._workers:
            self._workers.pop().end()

    def stop(self) -> None:
        """Kill all workers from another thread than that of `run`, which then raises a WorkerError."""
        self._stopped = True
        for worker in list(self._workers):
            with contextlib.suppress(ValueError):
                worker.process.kill()

    def run(
        self,
        work: Callable[[C], R],
        chunks: Sequence[C],
        *,
        limit_s: float | None = None,
        progress: Callable[[int, int], Any] | None = None,
        heard: Callable[[int, str], Any] | None = None,
    ) -> Iterator[Outcome[R]]:
        """As `Pool.run`."""
        self._heard = heard
        return self.run_pickled(
            pickle.dumps(work, pickle.HIGHEST_PROTOCOL),
            len(chunks),
            lambda index: pickle.dumps(chunks[index], pickle.HIGHEST_PROTOCOL),
            limit_s,
            progress or (lambda done, total: None),
        )

    def run_pickled(
        self,
        work: bytes,
        count: int,
        chunk: Callable[[int], bytes],
        limit_s: float | None,
        progress: Callable[[int, int], Any],
    ) -> Iterator[Outcome[Any]]:
        """As `run` for a pickled function; `chunk` gives pickled chunks by number."""
        _check_memory(min(self.jobs, count))
        waiting, tries, done = deque(range(count)), [0] * count, 0
        progress(0, count)
        try:
            while done < count:
                if self._stopped:
                    raise WorkerError("the pool was stopped")
                self._assign(waiting, work, chunk)
                for outcome in self._outcomes(limit_s):
                    if outcome.failure is not None and outcome.failure.kind == "lost":
                        tries[outcome.index] += 1
                        if tries[outcome.index] <= RETRIES:
                            waiting.appendleft(outcome.index)
                            continue
                    done += 1
                    progress(done, count)
                    yield outcome
        finally:
            for worker in [each for each in self._workers if each.chunk is not None]:
                self._workers.remove(worker)
                worker.end()

    def _assign(self, waiting: deque[int], work: bytes, chunk: Callable[[int], bytes]) -> None:
        """Give each free worker a chunk, and start workers for the rest."""
        for worker in list(self._workers):
            if waiting and worker.ready and worker.chunk is None:
                if worker.process.is_alive():
                    worker.take(index := waiting.popleft(), work, chunk(index))
                else:  # it was idle for too long
                    self._workers.remove(worker)
                    worker.end()
        starting = sum(not worker.ready for worker in self._workers)
        for _ in range(min(self.jobs - len(self._workers), len(waiting) - starting)):
            self._workers.append(_Worker(self._idle_s))

    def _outcomes(self, limit_s: float | None) -> list[Outcome[Any]]:
        """Wait until a worker has something to say or a limit has passed; gives the outcomes of chunks."""
        outcomes: list[Outcome[Any]] = []
        ends: dict[int, float] = {}
        for worker in self._workers:
            if worker.chunk is not None and limit_s is not None:
                ends[id(worker)] = worker.since + limit_s * worker.times
        left = min(ends.values(), default=math.inf) - time.monotonic()
        ready = set(wait([w.connection for w in self._workers], None if left == math.inf else max(0.0, left)))
        for worker in list(self._workers):
            index = worker.chunk
            if worker.connection in ready:
                try:
                    message = worker.connection.recv()
                except (EOFError, OSError, pickle.UnpicklingError):
                    self._workers.remove(worker)
                    reason = worker.end(died=True)
                    if not worker.ready:
                        self._count_start(reason)
                    if index is not None:
                        text = f"its worker process {reason}, {RETRIES + 1} times"
                        outcomes.append(Outcome(index, failure=Failure("lost", text, at=worker.at)))
                    continue
                if message[0] == "ready":
                    worker.ready, self._failed_starts = True, 0
                elif message[0] == "beat":
                    worker.since = time.monotonic()
                    _, worker.at, worker.times = message
                    if self._heard is not None and index is not None:
                        self._heard(index, worker.at)
                else:
                    assert index is not None
                    outcomes.append(_outcome(index, message, worker.at))
                    worker.chunk = None
            elif time.monotonic() >= ends.get(id(worker), math.inf):
                assert index is not None
                self._workers.remove(worker)
                worker.end()
                text = f"no result within {ends[id(worker)] - worker.since:.0f} s"
                outcomes.append(Outcome(index, failure=Failure("late", text, at=worker.at)))
        return outcomes

    def _count_start(self, reason: str) -> None:
        """Count workers that ended before they were ready, and give up after `STARTS`."""
        self._failed_starts += 1
        guard = '`if __name__ == "__main__":`'
        if reason == _reason(UNGUARDED):
            text = "worker processes import the script that starts them: let it begin its work below"
            raise InputError(f"{text} {guard}") from None
        if self._failed_starts >= STARTS:
            raise InputError(
                f"worker processes cannot start: the last one {reason}; a Python script that starts them "
                f"must begin its work below {guard}"
            ) from None


def _outcome(index: int, message: tuple[Any, ...], at: str) -> Outcome[Any]:
    """The outcome from a worker's answer."""
    if message[0] == "done":
        return Outcome(index, pickle.loads(message[1]))
    _, reason, trace, parameter, refused = message
    error = InputError(reason, parameter=parameter) if refused else None
    return Outcome(index, failure=Failure("raised", reason, trace, error, at))


@contextlib.contextmanager
def _no_interrupt() -> Iterator[None]:
    """Hold Ctrl-C back; a process that is started here holds it back until it says otherwise."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows; the process ignores it a moment later
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _as_parent() -> Iterator[None]:
    """Let a daemonic process, as a worker of dask is, start processes."""
    this = multiprocessing.current_process()
    if not this.daemon:
        yield
        return
    this.daemon = False
    try:
        yield
    finally:
        this.daemon = True
