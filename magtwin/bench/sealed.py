"""Sealed: the worker's side of a localizer that runs in a jailed process of its own."""

import atexit
import contextlib
import hashlib
import json
import math
import os
import pickle
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Self

import numpy as np

from magtwin.bench.contestant import ALIGNED, ESTIMATE, FAILED, FRAME, LOCALIZER, LOOPS
from magtwin.bench.suite import Entry
from magtwin.errors import InputError
from magtwin.files.children import environment
from magtwin.files.file import shipped
from magtwin.localization.localizers import LOCALIZERS, SHIPPED, load_localizer
from magtwin.localization.problem import Estimate, Problem
from magtwin.localization.readings import onboard, packed
from magtwin.localization.track import LocalizerError
from magtwin.parallel import jail
from magtwin.run.run import Run

MOST_TEXT = 500
"""Longest reason of a failure that is taken from a contestant."""

DATA = ("maps", "scenes", "robots", "weights")
"""Folders that ship with magtwin and that no contestant can read."""

START_S = 300.0
"""Longest time in which the program of contestants must be ready [s]: it may compile loops."""


def foreign(method: str) -> bool:
    """Whether the code of a localizer is not part of magtwin."""
    return method not in SHIPPED


def seals(method: str) -> bool:
    """Whether a localizer runs in a jailed process of its own here; magtwin's own ones need none.

    One that the program itself registered is not known in another process.
    """
    if not foreign(method) or not jail.version():
        return False
    return ":" in method or method in entry_points(group=LOCALIZERS.group).names


def seed_of(suite: str, scenario: str, run: int, localizer: str, salt: bytes = b"") -> int:
    """Seed of a localizer that tells nothing of the seed of the case, below 2^63.

    Args:
        suite: Name and version of the suite, which are those of all of its parts.
        scenario: Name of the scenario.
        run: Seed of the run.
        localizer: Name of the localizer.
        salt: Secret of the suite's seeds; b"" for public ones.
    """
    text = json.dumps([suite, scenario, run, localizer]).encode()
    return int.from_bytes(hashlib.blake2b(text, key=salt, digest_size=8).digest(), "big") >> 1


class Contestant:
    """A jailed process with one localizer, from its start to its end.

    `load` it, `run` it as a smoother, whichever kind it is, and `end` it in any case.

    Args:
        entry: Which localizer, with which options.
        problem: What it is told, but for its seed.
        seed: Its seed.
        readings: What it gets, one after another or, if it is a smoother, at once.
        limit_s: Longest time in which it must answer [s].
        modules: Modules of compiled loops that it may use.
    """

    def __init__(
        self,
        entry: Entry,
        problem: Problem,
        seed: int,
        readings: Run,
        limit_s: float,
        modules: Sequence[str] = LOOPS,
    ) -> None:
        self.name, self.smooths = "", False
        self.step_s = math.nan
        self._rows = packed(readings)
        memory, buffers = _memory_of(problem)
        self._line, theirs = socket.socketpair()
        self._line.settimeout(limit_s)
        task = {"method": entry.method, "options": entry.options, "seed": seed, "buffers": buffers}
        here = str(Path.cwd())  # where `load_localizer` looks last
        path = tuple(sys.path) if here in sys.path else (*sys.path, here)
        self._nursery = _nursery(path, here, tuple(modules))
        with theirs:
            self._pid = self._nursery.fork({**task, "layout": self._rows[0]}, theirs.fileno(), memory)
        self.clock = (~self._pid << 3) | 2  # CLOCK_PROCESSCPUTIME of that process

    def load(self) -> Self:
        """Wait until it is there.

        Raises:
            LocalizerError: It cannot be made, as when its module does not exist.
        """
        answer = self._frame()
        self.smooths = answer[0] != LOCALIZER
        self.name = self._text(answer[1])
        return self

    def run(self, problem: Problem, readings: Run) -> Sequence[Estimate]:
        """Estimates at all readings, of which a localizer has got only those before and at its time."""
        rows = self._rows[1]
        made = np.zeros((len(rows), 16))
        begin = time.clock_gettime(self.clock)
        if self.smooths:
            data = pickle.dumps(onboard(readings), pickle.HIGHEST_PROTOCOL)
            self._send(struct.pack("=Q", len(data)) + data)
            for k in range(len(made)):
                made[k] = self._frame()
        else:
            self._steps(np.ascontiguousarray(rows), made)
        with contextlib.suppress(OSError):  # it may have ended since
            self.step_s = (time.clock_gettime(self.clock) - begin) / len(rows)
        return [
            Estimate(t, x, y, yaw, np.array(cov).reshape(3, 3), bias, bool(lost))
            for _, t, x, y, yaw, *cov, bias, lost in made.tolist()
        ]

    def _steps(self, rows: Any, made: Any) -> None:
        """Send a row and take the answer, one after another."""
        sent, answers = memoryview(rows).cast("B"), memoryview(made).cast("B")
        send, receive = self._line.send, self._line.recv_into
        size, full = rows.shape[1] * 8, FRAME.size
        try:
            for k in range(len(rows)):
                send(sent[k * size : (k + 1) * size])
                if receive(answers[k * full : (k + 1) * full]) != full or made[k, 0] != ESTIMATE:
                    self._refuse(made[k])
        except (BrokenPipeError, ConnectionResetError):
            self._frame()

    def _refuse(self, answer: Any) -> None:
        """Say why there was no estimate."""
        if answer[0] == FAILED:
            self._failed(answer[1])
        raise LocalizerError(self._ended() or "its process did not answer with an estimate")

    def _failed(self, length: float) -> None:
        raise LocalizerError(self._text(length) or "its process failed and said nothing")

    def _text(self, length: float) -> str:
        """What it says, without what moves a terminal."""
        size = int(length) if 0 <= length <= 4096 else 0
        text = self._take(size).decode(errors="replace")
        return "".join(c if c.isprintable() else " " for c in text)[:MOST_TEXT]

    def _frame(self) -> tuple[float, ...]:
        answer = FRAME.unpack(self._take(FRAME.size))
        if answer[0] == FAILED:
            self._failed(answer[1])
        return answer

    def _take(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            try:
                more = self._line.recv(size - len(data))
            except ConnectionResetError:
                more = b""
            if not more:
                raise LocalizerError(self._ended() or "the process ended its line")
            data += more
        return data

    def _send(self, data: bytes) -> None:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):  # which is noticed when it answers
            self._line.sendall(data)

    def _ended(self) -> str:
        """End the process; how it had ended."""
        pid, self._pid = self._pid, 0
        if not pid:
            return ""
        for _ in range(100):  # its line closes a moment before it ends
            if _state(pid) == "Z":
                break
            time.sleep(0.001)
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        code = os.waitstatus_to_exitcode(self._nursery.ended(pid))
        if code >= 0:
            return f"the process ended with status {code}"
        return f"the process was killed by {signal.Signals(-code).name}"

    def end(self) -> None:
        """Kill the process."""
        pid, self._pid = self._pid, 0
        self._line.close()
        if pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            with contextlib.suppress(OSError, ValueError):  # the program has ended
                self._nursery.ended(pid)


def _state(pid: int) -> str:
    """State of a process, such as "Z" for one that has ended; "Z" too if there is none."""
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii", errors="replace") as file:
            return file.read().rpartition(")")[2].split()[0]
    except OSError:
        return "Z"


class _Nursery:
    """The program that forks contestants."""

    def __init__(self, path: Sequence[str], folder: str, modules: Sequence[str]) -> None:
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [sys.executable, "-P", "-m", "magtwin.bench.contestant", str(theirs.fileno())]
        changes = {"PYTHONPATH": os.pathsep.join(filter(None, path))}
        self._process = subprocess.Popen(
            command,
            pass_fds=[theirs.fileno()],
            env=environment(os.devnull, changes),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        theirs.close()
        hidden = [str(shipped(name)) for name in DATA]
        setup = {"path": list(path), "folder": folder, "modules": modules, "hidden": hidden}
        self._control.send(json.dumps(setup).encode())
        self._control.settimeout(START_S)
        if self._control.recv(16) != b"ready":
            raise InputError("the program that runs localizers in jail does not start; see magtwin doctor")

    def fork(self, task: Any, line: int, memory: int) -> int:
        """Start a contestant; its process."""
        return self._ask(task, [line, memory])

    def ended(self, pid: int) -> int:
        """Status of a contestant that has ended."""
        return self._ask({"ended": pid}, [])

    def _ask(self, order: Any, files: list[int]) -> int:
        try:
            socket.send_fds(self._control, [json.dumps(order).encode()], files)
            return int(self._control.recv(32))
        except BaseException:  # as of a time limit: its answer would be taken for that to the next order
            close()
            raise

    def close(self) -> None:
        """End the program, and with it all of its contestants."""
        self._control.close()
        self._process.kill()
        self._process.wait()


_started: dict[tuple[Any, ...], _Nursery] = {}
"""The program that runs, by where it looks for modules."""


def _nursery(*key: Any) -> _Nursery:
    if key not in _started:
        close()
        _started[key] = _Nursery(*key)
    return _started[key]


@atexit.register
def close() -> None:
    """End the program that forks contestants; the next one starts it again."""
    while _started:
        _started.popitem()[1].close()


def check_localizer(method: str, options: Mapping[str, Any]) -> None:
    """Refuse a localizer that cannot be made; foreign code is tried in a jail.

    Raises:
        InputError: It is unknown, cannot be imported, or refuses its options.
    """
    if not seals(method):
        load_localizer(method, options)
        return
    nothing = np.zeros((2, 4))
    nothing[:, 3] = 1.0
    columns = {"t": np.arange(2.0), "b_measured_nt": nothing[:, 0], "odom_p": nothing[:, :3]}
    readings = Run({**columns, "odom_q_xyzw": nothing})
    entry = Entry(method=method, options=dict(options))
    contestant = Contestant(
        entry, Problem(belief=None, extent=(0, 1, 0, 1)), 0, readings, START_S, ("numba",)
    )
    try:
        contestant.load()
    except LocalizerError as error:
        raise InputError(str(error)) from error
    finally:
        contestant.end()


_kept: list[tuple[Problem, int, list[list[int]]]] = []
"""The last problem, and the memory that it was written to."""


def _memory_of(problem: Problem) -> tuple[int, list[list[int]]]:
    """A problem in a memory file that nobody can write: the file, and the place and size of its parts."""
    import fcntl  # not on Windows

    if _kept and _kept[0][0] is problem:
        return _kept[0][1:]
    arrays: list[pickle.PickleBuffer] = []
    parts = [memoryview(pickle.dumps(problem, 5, buffer_callback=arrays.append))]
    parts += [each.raw() for each in arrays]
    memory = os.memfd_create("problem", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    buffers, at = [], 0
    for part in parts:
        buffers.append([at, part.nbytes])
        os.pwrite(memory, part, at)
        at += -(-part.nbytes // ALIGNED) * ALIGNED
    seals = fcntl.F_SEAL_WRITE | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_SEAL
    fcntl.fcntl(memory, fcntl.F_ADD_SEALS, seals)
    for _, old, _ in _kept:
        os.close(old)
    _kept[:] = [(problem, memory, buffers)]
    return memory, buffers
