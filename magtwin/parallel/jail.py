"""Jail: what a process gives up before it runs somebody else's code (Linux on x86-64, by ctypes).

Landlock leaves it the files in a list, to be read; seccomp leaves it the system calls of a program that
computes: no new process, no network, no signal, no look into another process. Both hold for good, and for
all of its threads.
"""

import ctypes
import errno
import os
import platform
import struct
import sys
import sysconfig
from collections.abc import Collection, Iterable, Iterator
from functools import cache
from pathlib import Path

MEMORY_BYTES = 2 << 30
"""Memory that a jailed process can take beyond what it had [bytes]."""

_SHARED = ("/lib", "/lib64", "/usr/lib", "/usr/lib64", "/etc/ld.so.cache")
"""Shared libraries."""

_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF, _CAPSET = 444, 445, 446, 126
_PR_SET_SECCOMP, _PR_SET_NO_NEW_PRIVS, _FILTER = 22, 38, 2
_READ_FILE, _READ_DIR, _SCOPES = 1 << 2, 1 << 3, 3
_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15, 5: 16}
"""Rights over files that Landlock knows, by its version (linux/landlock.h); later versions as the last."""

_MACHINE = 0xC000003E  # AUDIT_ARCH_X86_64
_ALLOWED = (
    *range(16),  # read, write, open, close, stat, poll, lseek, memory and signal handlers of its own
    *(17, 19, 20, 21, 23, 24, 25, 28, 32, 35, 39, 44, 45, 60, 63, 79, 89, 96, 97, 98, 99, 100),
    *(102, 104, 107, 108, 131, 186, 202, 204, 217, 218, 228, 229, 230, 231, 257, 262, 267, 269, 270, 271),
    *(273, 318, 324, 332, 334, 439),
)
"""pread64, readv, writev, access, select, sched_yield, mremap, madvise, dup, nanosleep, getpid, sendto,
recvfrom, exit, uname, getcwd, readlink, gettimeofday, getrlimit, getrusage, sysinfo, times, user and group,
sigaltstack, gettid, futex, sched_getaffinity, getdents64, set_tid_address, clocks, exit_group, openat,
newfstatat, readlinkat, faccessat, pselect6, ppoll, set_robust_list, getrandom, membarrier, statx, rseq,
faccessat2."""

_CLONE, _CLONE3, _FCNTL, _PRLIMIT = 56, 435, 72, 302
_THREAD = 0x10000  # CLONE_THREAD
_FCNTLS = (0, 1, 2, 3, 1030)  # F_DUPFD, F_GETFD, F_SETFD, F_GETFL, F_DUPFD_CLOEXEC
_LOAD, _EQUAL, _ANY, _RETURN = 0x20, 0x15, 0x45, 0x06  # Instructions of BPF
_DO, _REFUSE, _KILL = 0x7FFF0000, 0x00050000, 0x80000000


class JailError(OSError):
    """The system did not take the jail."""


@cache
def version() -> int:
    """Version of Landlock; 0 where there is no jail."""
    if not sys.platform.startswith("linux") or platform.machine() != "x86_64":
        return 0
    return max(0, int(ctypes.CDLL(None).syscall(_CREATE_RULESET, None, 0, 1)))


def readable(paths: Iterable[str | os.PathLike[str]]) -> int:
    """A ruleset of Landlock by which the files at and below some paths can be read, and nothing else.

    Returns:
        Its file descriptor, for `close_in`. Processes that are forked can use it.

    Raises:
        JailError: There is no Landlock.
    """
    libc, known = ctypes.CDLL(None, use_errno=True), version()
    rights = (1 << _RIGHTS.get(known, _RIGHTS[5])) - 1
    words = [rights, *([3] if known >= 4 else []), *([_SCOPES] if known >= 6 else [])]
    asked = struct.pack(f"={len(words)}Q", *words)
    ruleset = _done(libc.syscall(_CREATE_RULESET, asked, len(asked), 0))
    for path in dict.fromkeys(Path(each).resolve() for each in paths):
        if not path.exists():
            continue
        at = os.open(path, os.O_PATH | os.O_CLOEXEC)
        allowed = _READ_FILE | (_READ_DIR if path.is_dir() else 0)
        _done(libc.syscall(_ADD_RULE, ruleset, 1, struct.pack("=Qi", allowed, at), 0))
        os.close(at)
    return ruleset


def libraries(hidden: Collection[Path] = ()) -> list[str]:
    """Where a jailed Python finds what it imports: libraries, installed packages, modules, and no data.

    Of folders in `sys.path` that are no libraries, as a working folder is none, modules and packages alone.

    Args:
        hidden: Folders to leave out.
    """
    site = [p for p in sys.path if Path(p).name in ("site-packages", "dist-packages")]
    standard = [sysconfig.get_path(name) for name in ("stdlib", "platstdlib")]
    roots = {Path(p).resolve() for p in (*standard, *site, *_SHARED)}
    for folder in {Path(p).resolve() for p in sys.path} - roots:
        if folder.is_dir() and not any(folder.is_relative_to(root) for root in roots):
            roots |= {each for each in folder.iterdir() if _is_code(each)}
    return [str(each) for root in roots if root.exists() for each in _without(root, hidden)]


def _without(path: Path, hidden: Collection[Path]) -> Iterator[Path]:
    """A folder, or what is in it, if something in it is hidden."""
    if path in hidden:
        return
    if any(each.is_relative_to(path) for each in hidden):
        for each in path.iterdir():
            yield from _without(each, hidden)
    else:
        yield path


def _is_code(path: Path) -> bool:
    if path.is_dir():
        return path.name == "__pycache__" or (path / "__init__.py").is_file()
    return path.suffix in (".py", ".so", ".pyc")


def close_in(ruleset: int) -> None:
    """Jail this process for good; it must have no other thread.

    Args:
        ruleset: What `readable` gave; it is closed.

    Raises:
        JailError: The system did not take it. Then do not run foreign code.
    """
    import resource

    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most = pages * resource.getpagesize() + MEMORY_BYTES
    for kind, limit in ((resource.RLIMIT_AS, most), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(kind, (limit, limit))
    libc = ctypes.CDLL(None, use_errno=True)
    _done(libc.syscall(_CAPSET, struct.pack("=Ii", 0x20080522, 0), bytes(24)))  # root could raise its limits
    _done(libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0))
    _done(libc.syscall(_RESTRICT_SELF, ruleset, 0))
    os.close(ruleset)
    code = ctypes.create_string_buffer(_program())
    program = struct.pack("@HP", len(_program()) // 8, ctypes.addressof(code))
    _done(libc.prctl(_PR_SET_SECCOMP, _FILTER, program, 0, 0))


@cache
def _program() -> bytes:
    """The filter of system calls. Beyond the list: threads, harmless `fcntl`, and the reading of limits."""

    def step(code: int, value: int, yes: int = 0, no: int = 0) -> bytes:
        return struct.pack("=HBBI", code, yes, no, value)

    number, machine, first, second, third = 0, 4, 16, 24, 32
    refuse, allow = step(_RETURN, _REFUSE | errno.EPERM), step(_RETURN, _DO)
    made = step(_LOAD, machine) + step(_EQUAL, _MACHINE, 1) + step(_RETURN, _KILL) + step(_LOAD, number)
    for call in _ALLOWED:
        made += step(_EQUAL, call, 0, 1) + allow
    made += step(_EQUAL, _CLONE3, 0, 1) + step(_RETURN, _REFUSE | errno.ENOSYS)  # the library uses clone then
    made += step(_EQUAL, _CLONE, 0, 4) + step(_LOAD, first) + step(_ANY, _THREAD, 0, 1) + allow + refuse
    commands = b"".join(step(_EQUAL, command, 0, 1) + allow for command in _FCNTLS)
    made += step(_EQUAL, _FCNTL, 0, 2 + len(commands) // 8) + step(_LOAD, second) + commands + refuse
    halves = (step(_LOAD, third) + step(_EQUAL, 0, 0, 3)) + (step(_LOAD, third + 4) + step(_EQUAL, 0, 0, 1))
    return made + step(_EQUAL, _PRLIMIT, 0, 5) + halves + allow + refuse


def _done(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise JailError(number, f"no jail: {os.strerror(number)}")
    return result
