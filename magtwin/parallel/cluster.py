"""Workers of a dask cluster."""

import contextlib
import hashlib
import pickle
import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, Self

from magtwin.errors import InputError
from magtwin.parallel.pool import C, Failure, Outcome, R, WorkerError
from magtwin.parallel.processes import Processes
from magtwin.version import __version__

ANSWER_S = 10.0
"""Time in which a dask scheduler must answer, and in which a first worker must join it [s]."""

IDLE_S = 300.0
"""Time after which a process that a dask worker has started for chunks ends itself, if it gets none [s]."""


class Cluster:
    """A pool of the workers of a dask cluster.

    Each thread of a dask worker starts a process of its own, which is a worker as on this machine. So a chunk
    that crashes or hangs costs no dask worker. If a dask worker itself is lost, dask gives its chunks to
    others, as often as its setting `distributed.scheduler.allowed-failures` allows.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError as error:
            text = f"`dask` needs dask.distributed ({error}): pip install 'magtwin[cluster]'"
            raise InputError(text, parameter="dask") from error
        self.address, self._session = address, uuid.uuid4().hex
        try:
            self.client = Client(address, timeout=ANSWER_S, set_as_default=False)
        except (OSError, ValueError) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            text = f"no dask scheduler answers at {address} ({reason}); start `dask scheduler`, or correct it"
            raise InputError(text, parameter="dask") from error
        try:
            self._check_workers()
        except BaseException:
            self.close()
            raise

    def _check_workers(self) -> None:
        """Refuse a cluster without workers, or whose workers do not run this version."""
        try:
            self.client.wait_for_workers(1, timeout=ANSWER_S)
        except TimeoutError as error:
            text = f"the dask scheduler at {self.address} has no workers; start `dask worker {self.address}`"
            raise InputError(text, parameter="dask") from error
        for worker, version in self.client.run(_version, on_error="return").items():
            if isinstance(version, BaseException):
                text = f"the dask worker at {worker} cannot load magtwin ({version}); install it there"
                raise InputError(text, parameter="dask")
            _check_version(str(version), f"the dask worker at {worker}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop what the workers do for this pool, and let them go."""
        with contextlib.suppress(Exception):
            self.client.run(_end_lent, self._session)
        with contextlib.suppress(Exception):
            self.client.close(timeout=2)

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
        from distributed import as_completed

        say = progress or (lambda done, total: None)
        client, waiting, done = self.client, iter(range(len(chunks))), 0
        pickled = client.submit(_same, pickle.dumps(work, pickle.HIGHEST_PROTOCOL), pure=False)
        sent: dict[str, tuple[int, Any]] = {}

        def send() -> list[Any]:
            """Send chunks, until each thread has one to work on and one that waits."""
            futures = []
            for index in islice(waiting, max(0, 2 * sum(client.nthreads().values()) + 2 - len(sent))):
                chunk = pickle.dumps(chunks[index], pickle.HIGHEST_PROTOCOL)
                future = client.submit(
                    _lend, pickled, chunk, index, limit_s, self._session, _version(), pure=False
                )
                sent[future.key] = index, future
                futures.append(future)
            return futures

        say(0, len(chunks))
        try:
            completed = as_completed(send(), loop=client.loop)
            for future in completed:
                index, _ = sent.pop(future.key)
                outcome = self._outcome(index, future)
                future.release()
                completed.update(send())
                done += 1
                say(done, len(chunks))
                yield outcome
        finally:
            if sent:
                with contextlib.suppress(Exception):
                    client.cancel([future for _, future in sent.values()], force=True)

    def _outcome(self, index: int, future: Any) -> Outcome[Any]:
        """The outcome of a future that has ended."""
        from distributed import KilledWorker
        from distributed.client import FutureCancelledError

        try:
            outcome: Outcome[Any] = future.result()
        except KilledWorker as error:
            text = f"its dask worker ended, {error.allowed_failures + 1} times"
            return Outcome(index, failure=Failure("lost", text))
        except (FutureCancelledError, OSError) as error:
            text = f"the dask scheduler at {self.address} has ended or dropped the work; start it again"
            raise InputError(text, parameter="dask") from error
        return outcome


_lent: list[Processes] = []
"""In a dask worker: pools of one process each that no thread uses now."""

_used: list[tuple[str, Processes]] = []
"""In a dask worker: those that a thread uses, and for which session."""

_ended: set[str] = set()
"""In a dask worker: sessions whose program has ended."""


def _same(value: bytes) -> bytes:
    return value


@lru_cache
def _version() -> str:
    """Version of magtwin in this process, with a checksum of its code: a version in development changes."""
    package = Path(__file__).parent.parent
    code = hashlib.sha256()
    for file in sorted(package.rglob("*.py")):
        code.update(f"{file.relative_to(package).as_posix()} ".encode() + file.read_bytes())
    return f"{__version__} (code {code.hexdigest()[:8]})"


def _check_version(version: str, where: str) -> None:
    if version != _version():
        text = f"{where} has magtwin {version}, and this is {_version()}; install the same"
        raise InputError(text, parameter="dask")


def _lend(
    work: bytes, chunk: bytes, index: int, limit_s: float | None, session: str, version: str
) -> Outcome[Any]:
    """In a thread of a dask worker: call a function for one chunk, in a process of its own."""
    _check_version(version, "the program that sends the work")
    if session in _ended:
        raise WorkerError("the program that sent the work has ended")
    try:
        pool = _lent.pop()
    except IndexError:
        pool = Processes(1, idle_s=IDLE_S)
    _used.append((session, pool))
    try:
        (outcome,) = pool.run_pickled(work, 1, lambda k: chunk, limit_s, lambda done, total: None)
        _lent.append(pool)
    except BaseException:
        pool.close()
        raise
    finally:
        _used.remove((session, pool))
        if session in _ended:
            _end_lent(session)
    return replace(outcome, index=index)


def _end_lent(session: str) -> None:
    """In a dask worker: end the processes that work for a session, and those that do not work."""
    _ended.add(session)
    for owner, pool in tuple(_used):
        if owner == session:
            pool.stop()
    with contextlib.suppress(IndexError):
        while True:
            _lent.pop().close()
