"""Functions that tests of pools call in workers."""

import os
import signal
import time
from pathlib import Path

from magtwin.errors import InputError
from magtwin.parallel import beat


def square(x):
    return x * x


def threads(_):
    import numpy as np  # noqa: F401 - its linear algebra is looked at
    from threadpoolctl import threadpool_info

    from magtwin import compiled

    return compiled.threads(8), {info["num_threads"] for info in threadpool_info()}, os.getpid()


def refuse(x):
    if x == 1:
        raise InputError("x must not be 1; give another", parameter="x")
    if x == 2:
        raise ZeroDivisionError("two")
    if x == 3:
        raise SystemExit(3)
    return x


def die_until(marks: str, times: int, x: int):
    """Be killed the first `times` times that chunk 1 is tried."""
    if x == 1:
        tried = len(list(Path(marks).iterdir()))
        Path(marks, f"{tried}-{os.getpid()}").touch()
        if tried < times:
            os.kill(os.getpid(), signal.SIGKILL)
    return x


def slow(folder: str, seconds: float, x: int):
    """Say who works, and work for a time."""
    Path(folder, f"{x}-{os.getpid()}").touch()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.01)
    return x


def waits_to_be_killed(folder: str, first: int, x: int):
    """Say who works; the first to work on the chunk `first` does not end by itself."""
    tried = list(Path(folder).glob(f"{x}-*"))
    return slow(folder, 0.0 if x != first or tried else 3600.0, x)


def hang(x):
    beat("before")
    if x == 1:
        beat("the second of three")
        while True:
            time.sleep(1)
    return x


def beating(x):
    for _ in range(40):
        time.sleep(0.1)
        beat()
    return x


def big(x):
    print("a worker's stdout is not the program's")  # noqa: T201
    return bytes(3_000_000) + bytes([x])


def grandchild(marks: str, x: int):
    """Start a process, and hang."""
    import subprocess

    child = subprocess.Popen(["sleep", "60"])
    Path(marks, str(child.pid)).touch()
    while True:
        time.sleep(1)


class Refusing:
    """Refuses to finish any run of a sweep."""

    def identity(self, job):
        return str(job.seed)

    def __call__(self, jobs, sensed):
        raise InputError("the robot is out of the map")
