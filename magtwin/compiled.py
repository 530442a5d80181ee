"""Compiled loops: when they pay, how they are opened, and how their work is shared between threads.

Some loops stand twice: in plain Python or numpy, and compiled with numba to the same bytes. Importing numba
takes half a second if its machine code is cached, else a few seconds. A short job should not wait for that.
So compiled functions live in modules that nothing imports at the top, and each such module has one `Loops`
object, which opens it once the plain code has done as much work as the opening costs.

    # magtwin/room/loops.py, imported only through `LOOPS`
    @inlined
    def square(x): ...

    @compiled(types.float64)
    def total(x): ...

    # the module that has the plain code
    LOOPS = Loops("magtwin.room.loops", pays=20_000_000)

    def work(x):
        code = LOOPS.after(len(x))
        return plain_total(x) if code is None else code.total(x)

Where numba does not work, `after` returns None for good, and `open` raises ImportError.
"""

import contextlib
import functools
import importlib
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from types import ModuleType
from typing import Any

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
"""Options of numba for every compiled function: no fused and no reordered sums, so that no bit changes."""

NUMBA_SHARE = 20  # Opening a module is this many times cheaper if numba is already imported
MOST_THREADS = 8  # Most threads that share a loop; beyond, memory limits the speed

_limit = MOST_THREADS
"""Most threads that share work in this process."""

_steady = False
"""Whether this process must not pause now to open modules."""


class Loops:
    """A module of compiled functions that is imported when that pays. Threads may share it.

    Args:
        module: Full name of the module.
        pays: Work of the plain code that takes as long as importing numba and the module, in any unit.
    """

    def __init__(self, module: str, *, pays: float) -> None:
        self.module, self.pays = module, pays
        self.code: ModuleType | None = None
        """The module, once opened."""

        self.done = 0.0
        """Work that the plain code has done so far."""

        self._lock = threading.Lock()

    def open(self) -> ModuleType:
        """Import the module now, as pays before a long job, and return it.

        Raises:
            ImportError: numba does not work here.
        """
        with self._lock:
            if self.code is None:
                self.code = importlib.import_module(self.module)
            return self.code

    def after(self, work: float) -> ModuleType | None:
        """The module if it is open, or if opening it pays now; None if the plain code should do the work.

        Within `steady`, the plain code goes on.

        Args:
            work: Work to be done now, in the unit of `pays`.
        """
        if self.code is None and not _steady:
            self.done += work
            if self.done >= self.pays / (NUMBA_SHARE if "numba" in sys.modules else 1):
                try:
                    return self.open()
                except ImportError:
                    self.done = -math.inf
        return self.code


def compiled(*signature: Any, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Decorate a function: compile it for one signature at import, or load its cached machine code.

    numba caches machine code in `__pycache__` beside the source, or in the user's cache folder if that is
    not writable. If neither is, each process compiles anew.

    Args:
        *signature: numba's types of the arguments.
        **options: Options of numba beside `OPTIONS`, such as fastmath={"contract"}.
    """
    from numba import njit

    def compile_or_load(function: Callable[..., Any]) -> Any:
        with contextlib.suppress(RuntimeError, OSError):  # the cache has no place, or no room
            return njit(signature, cache=True, **OPTIONS, **options)(function)
        return njit(signature, **OPTIONS, **options)(function)

    return compile_or_load


def inlined(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """Let compiled functions call a function; it stays a plain one for all others.

    Args:
        function: Plain Python that numba can compile. The functions that it calls are marked likewise.
        **options: Options of numba beside `OPTIONS`, such as inline="always".
    """
    from numba.extending import register_jitable

    marked: Callable[..., Any] = register_jitable(**OPTIONS, **options)(function)
    return marked


def limit_threads(count: int) -> None:
    """Let at most `count` threads share work in this process, as where other processes use the processors."""
    global _limit
    _limit = count


@contextlib.contextmanager
def steady() -> Iterator[None]:
    """Within the block, open no module only because it pays: a node in real time would pause for seconds.

    Modules that have no plain code, or that are opened before a job, still open.
    """
    global _steady
    before, _steady = _steady, True
    try:
        yield
    finally:
        _steady = before


def threads(most: int) -> int:
    """Number of threads that may share work: at most `most`, and one for each processor."""
    return max(1, min(most, os.cpu_count() or 1, _limit))  # cpu_count takes 3 us


def in_threads(work: Callable[[slice], Any], rows: int, share: int) -> None:
    """Call `work` on slices that cover all rows, on several threads if there is work for them.

    Args:
        work: Works on the rows of a slice; it must release the interpreter lock to gain from threads.
        rows: Number of rows.
        share: Rows that a thread takes at a time; the first thread that is free takes the next share.
    """
    count = rows // share
    workers = 1 if count < 2 else threads(min(count, MOST_THREADS))
    if workers < 2:
        work(slice(0, rows))
        return
    starts = iter(range(0, rows, share))

    def take() -> None:
        for start in starts:
            work(slice(start, min(start + share, rows)))

    others = [_pool().submit(take) for _ in range(workers - 1)]
    try:
        take()
    finally:
        started = [other for other in others if not other.cancel()]  # all work is taken: do not wait for more
        wait(started)
    for other in started:
        other.result()


@functools.cache
def _pool() -> ThreadPoolExecutor:
    """Threads that stay for the next work: starting them takes as long as 4,000 particles."""
    return ThreadPoolExecutor(MOST_THREADS - 1, "magtwin")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a fork has none of the threads
