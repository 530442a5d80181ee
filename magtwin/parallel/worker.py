"""The life of a worker process, and what a task may call in it."""

import contextlib
import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from multiprocessing.connection import Connection
from typing import Any

from magtwin import compiled
from magtwin.errors import InputError
from magtwin.parallel.machine import end_group

_beating: Connection | None = None
"""Where `beat` reports to, in a worker."""


def beat(what: str = "", *, times: float = 1.0) -> None:
    """Report from a worker that its chunk goes on, and give it its time limit again.

    Args:
        what: What is done next; `Failure.at` has it if that fails. Outside a worker nothing happens.
        times: Factor of the time limit until the next beat.
    """
    if _beating is not None:
        _beating.send(("beat", what, times))


def serve(connection: Connection, idle_s: float | None) -> None:
    """The life of a worker, which ends itself after `idle_s` without work."""
    global _beating
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the parent, which kills its workers
    if hasattr(signal, "pthread_sigmask"):  # neither on Windows
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    if hasattr(os, "setpgid"):
        os.setpgid(0, 0)  # killed together with the processes that a task has started
    multiprocessing.current_process().daemon = False  # a task may start processes
    os.dup2(2, 1)  # stdout belongs to the parent
    threading.Thread(target=_end_with_parent, daemon=True).start()
    compiled.limit_threads(1)
    _beating = connection
    connection.send(("ready",))
    work: Any = None
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while connection.poll(idle_s):
            new_work, chunk = connection.recv()
            answer: tuple[Any, ...]
            try:
                if new_work is not None:
                    work = pickle.loads(new_work)
                answer = ("done", pickle.dumps(work(pickle.loads(chunk)), pickle.HIGHEST_PROTOCOL))
            except InputError as error:
                answer = ("raised", str(error), "", error.parameter, True)
            except BaseException as error:
                reason = f"{type(error).__name__}: {error}".rstrip(": ")
                answer = ("raised", " ".join(reason.split()), traceback.format_exc(), None, False)
            connection.send(answer)


def _end_with_parent() -> None:
    """End this process, and those that it started, when its parent has ended."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    end_group(0)
