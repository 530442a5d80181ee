"""Localizers that cheat, for tests of the jail. One whose attack works flags all of its estimates as lost."""

import contextlib
import ctypes
import gc
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from magtwin.localization.odometry import Odometry

LIBC = ctypes.CDLL(None, use_errno=True)


class _Attack(Odometry):
    """Odometry, and an attack before it."""

    def reset(self, problem):
        super().reset(problem)
        self.won = False
        with contextlib.suppress(OSError, ImportError, AttributeError, ValueError, TypeError):
            self.won = bool(self.attack(problem))

    def step(self, reading):
        return replace(super().step(reading), lost=self.won)


class Frames(_Attack):
    def attack(self, problem):
        frame = sys._getframe()
        while frame is not None:
            if any(hasattr(value, "truth") for value in frame.f_locals.values()):
                return True
            frame = frame.f_back
        return False


class Garbage(_Attack):
    def attack(self, problem):
        return [each for each in gc.get_objects() if type(each).__name__ in ("Case", "Truth")]


class Inverts(_Attack):
    """The seed is the last of the children of the case's generator, if that was told."""

    def attack(self, problem):
        from magtwin.bench.twin_case import STREAMS

        children = (np.random.default_rng((5 + k, 1)).spawn(len(STREAMS))[-1] for k in range(10))
        return problem.seed in [int(rng.integers(2**31)) for rng in children]


class Patches(_Attack):
    """Falsifies the scores of all, if it shares their process; wins where it sees the scorer at work."""

    def attack(self, problem):
        import magtwin.bench.row

        at_work = any(type(each).__name__ == "Suite" for each in gc.get_objects())
        magtwin.bench.row.score = lambda *_, **__: magtwin.bench.row.Scores(rmse_m=0.0)
        np.hypot = lambda *_: np.zeros(1)
        return at_work


class OtherMemory(_Attack):
    def attack(self, problem):
        maps = Path(f"/proc/{os.getppid()}/maps").read_text(encoding="ascii").splitlines()
        start = int(next(line for line in maps if " rw-p " in line).split("-")[0], 16)
        with open(f"/proc/{os.getppid()}/mem", "rb", 0) as memory:
            memory.seek(start)
            return memory.read(64)


class ReadsByCall(_Attack):
    def attack(self, problem):
        got = ctypes.create_string_buffer(8)
        words = struct.pack("@PN", ctypes.addressof(got), 8), struct.pack("@PN", id(None), 8)
        return LIBC.syscall(310, os.getppid(), words[0], 1, words[1], 1, 0) >= 0 or ctypes.get_errno() == 14


class Traces(_Attack):
    def attack(self, problem):
        return LIBC.ptrace(0x4206, os.getppid(), 0, 0) >= 0  # PTRACE_SEIZE


class SuiteFiles(_Attack):
    """Looks for suites, earlier results and fields below the working folder and in /tmp."""

    def attack(self, problem):
        import magtwin

        for folder in (Path.cwd(), Path(magtwin.__file__).parents[1] / "scenes"):
            for file in (*folder.rglob("*.parquet"), *folder.rglob("*.toml"), *folder.rglob("*.usd*")):
                with contextlib.suppress(OSError):
                    return file.read_bytes()
        return False


class ShippedMap(_Attack):
    def attack(self, problem):
        import magtwin as mt

        return (Path(mt.__file__).parents[1] / "maps" / "lab" / "lab.usdc").read_bytes()


class Forks(_Attack):
    """A child would live on and watch the next run."""

    def attack(self, problem):
        if pid := os.fork():
            os.waitpid(pid, 0)
            return True
        os._exit(0)


class Programs(_Attack):
    def attack(self, problem):
        return subprocess.run(["/bin/true"], check=False).returncode == 0


class Network(_Attack):
    def attack(self, problem):
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as line:
            return line.fileno() >= 0


class Kills(_Attack):
    def attack(self, problem):
        os.kill(os.getppid(), 0)
        return True


class Unjails(_Attack):
    """Raises its limits, watches by io_uring, takes a signal's owner, and joins another user's namespace."""

    def attack(self, problem):
        import fcntl
        import resource

        calls = ((425, 8, bytes(120)), (272, 0x10000000, None), (157, 1, 0), (126, bytes(8), bytes(24)))
        with contextlib.suppress(OSError, ValueError):
            fcntl.fcntl(0, fcntl.F_SETOWN, os.getpid())
            return True
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_AS, (-1, -1))
            return True
        return any(LIBC.syscall(*call) >= 0 for call in calls)


class Poisons(_Attack):
    """Writes into a cache of modules that the next process reads."""

    def attack(self, problem):
        file = Path(__file__).parent / "poison.tmp"
        file.write_bytes(b"x")
        file.unlink()
        return True


class WritesProblem(_Attack):
    """Changes the map under those that share it: its memory is read-only, so it ends by SIGSEGV."""

    def attack(self, problem):
        values = problem.belief.values_nt
        ctypes.memset(values.ctypes.data, 0, 8)
        return not values.flat[0]


class Answers(_Attack):
    """Answers before it is asked, on the line to the worker."""

    def attack(self, problem):
        for number in range(3, 20):
            with contextlib.suppress(OSError):
                os.write(number, struct.pack("=16d", *[0.0] * 16) * 500)
        return False


class Shouts(_Attack):
    def attack(self, problem):
        sys.stdout.write("\x1b[2Jhostile")
        sys.stdout.flush()
        os.write(2, b"\x1b]0;hostile\x07")
        raise RuntimeError("\x1b[2Jhostile" + "x" * 100_000)


class Eats(_Attack):
    def attack(self, problem):
        self.all = [np.zeros(1 << 25) for _ in range(100)]  # 256 MiB each
        return True


class Hangs(_Attack):
    def attack(self, problem):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM, signal.SIGTERM})
        while True:
            time.sleep(0.1)


class Leaves(_Attack):
    def attack(self, problem):
        os._exit(3)


GAIN_NOTHING = (
    *(Frames, Garbage, Inverts, Patches, OtherMemory, ReadsByCall, Traces, SuiteFiles, ShippedMap, Forks),
    *(Programs, Network, Kills, Unjails, Poisons),
)
FAIL = {
    WritesProblem: "the process was killed by SIGSEGV",
    Answers: "an estimate of another reading",
    Shouts: "raised RuntimeError",
    Eats: "MemoryError",
    Hangs: "took longer than the time limit of 15 s",
    Leaves: "the process ended with status 3",
}
OUT_OF_JAIL = (OtherMemory, SuiteFiles, ShippedMap, Forks, Programs, Network, Kills, Poisons)
"""Attacks that work in a process without a jail, and harm nothing."""
