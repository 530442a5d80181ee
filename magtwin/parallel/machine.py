"""Processors and memory that this process may use, and the end of its children."""

import contextlib
import ctypes
import math
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from magtwin.errors import InputError

PR_SET_PDEATHSIG = 1
"""Request of prctl(2): the signal that a process gets when its parent dies."""


def processors() -> int:
    """Processors that this process may use: its affinity, and the quota of its control group."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota, _, period = _cgroup("cpu.max").partition(" ")
    if quota.isdecimal() and period.strip().isdecimal():
        count = min(count, math.ceil(int(quota) / int(period)))
    return max(1, count)


def free_memory() -> int | None:
    """Memory that this process and its workers can still take [bytes]; None if that is unknown."""
    free = []
    with contextlib.suppress(OSError, ValueError, IndexError):
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free.append(1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")))
    most, used = _cgroup("memory.max"), _cgroup("memory.current")
    if most.isdecimal() and used.isdecimal():
        cached = dict(line.split() for line in _cgroup("memory.stat").splitlines())
        free.append(max(0, int(most) - int(used) + int(cached.get("inactive_file", 0))))
    return min(free, default=None)


def room() -> int | None:
    """Memory that this process alone can still take [bytes], with its limit of addresses (`ulimit -v`).

    None if that is unknown.
    """
    free = [] if (most := free_memory()) is None else [most]
    with contextlib.suppress(OSError, ValueError, IndexError, ImportError):
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit != resource.RLIM_INFINITY:
            used = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
            free.append(max(0, limit - used * os.sysconf("SC_PAGE_SIZE")))
    return min(free, default=None)


def check_room(needed: float, what: str, remedy: str, parameter: str) -> None:
    """Refuse what needs more memory than this process can take, before it is asked for.

    Args:
        needed: Memory that it takes [bytes].
        what: What needs it, for the refusal.
        remedy: What to do.
        parameter: The parameter that asks for it.

    Raises:
        InputError: `needed` is above `room()`.
    """
    free = room()
    if free is not None and needed > free:
        raise InputError(
            f"{what} needs about {needed / 1e9:.3g} GB of memory, and {free / 1e9:.3g} GB are free; {remedy}",
            parameter=parameter,
        )


def _cgroup(name: str) -> str:
    """A setting of the control group (version 2) that this process is in, as a container sees it."""
    try:
        return Path("/sys/fs/cgroup", name).read_text(encoding="ascii").strip()
    except OSError:
        return ""


def ends_with_parent() -> Callable[[], None] | None:
    """What a child process calls before its program, so that it is killed when this thread's process is.

    None where the system cannot.
    """
    if not sys.platform.startswith("linux"):
        return None
    prctl = ctypes.CDLL(None).prctl  # looked up here: the child may not

    def ask() -> None:
        prctl(PR_SET_PDEATHSIG, signal.SIGKILL)

    return ask


def end_group(pid: int, *, ask: bool = False) -> None:
    """Kill a process and those that it started, or `ask` them to end; 0 stands for this process.

    Where there are no groups of processes (Windows), that process alone is ended.

    Raises:
        ProcessLookupError: It has ended.
    """
    if hasattr(os, "killpg"):
        os.killpg(pid, signal.SIGTERM if ask else signal.SIGKILL)
    elif pid:
        os.kill(pid, signal.SIGTERM)
    else:
        os._exit(1)


@contextlib.contextmanager
def variables(values: Mapping[str, str | None]) -> Iterator[None]:
    """Set variables of the environment in the block, for a process or a library that starts there.

    None unsets one.
    """
    before = {name: os.environ.pop(name, None) for name in values}
    os.environ.update({name: value for name, value in values.items() if value is not None})
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
