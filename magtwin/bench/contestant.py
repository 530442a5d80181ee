"""Contestant: the life of a process that runs one localizer on one case, in a jail.

    python -P -m magtwin.bench.contestant FD

`magtwin.bench.sealed` starts this program once in a worker. It opens compiled loops and never sees a case.
It forks for each run: the fork jails itself, and only then imports the localizer. So a localizer has the
problem, in memory that it cannot write, and the readings that were sent to it. What it does to Python, numpy
or this program ends with it.
"""

import contextlib
import gc
import importlib
import json
import mmap
import os
import pickle
import random
import socket
import struct
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from magtwin import compiled
from magtwin.errors import InputError
from magtwin.localization.localizers import load_localizer
from magtwin.localization.problem import Estimate, Localizer, Problem, Smoother
from magtwin.localization.readings import unpacked
from magtwin.localization.track import LocalizerError, called, checked_estimates, stepped
from magtwin.parallel import jail
from magtwin.parallel.machine import ends_with_parent

FRAME = struct.Struct("=16d")
"""An answer: its kind, then t, x, y, yaw, covariance (3 x 3), bias and lost; or the length of a text."""

ESTIMATE, FAILED, LOCALIZER, SMOOTHER = 0.0, 1.0, 2.0, 3.0

ALIGNED = 64
"""Arrays of a problem begin at multiples of this in its memory."""

LOOPS = (
    "magtwin.field.maps.loops",
    "magtwin.localization.grid.bank_loops",
    "magtwin.localization.particle_loops",
    "magtwin.localization.slam.hilbert_loops",
)
"""Compiled loops that localizers may use: a jailed process would compile them for a minute."""

_UNKNOWN = (float("nan"),) * 9


def main(control: socket.socket) -> None:
    """Fork a contestant for each order on a socket, until it closes."""
    setup = json.loads(control.recv(1 << 20))
    os.chdir(setup["folder"])
    sys.path[:] = setup["path"]
    compiled.limit_threads(1)
    for module in setup["modules"]:
        with contextlib.suppress(ImportError):
            importlib.import_module(module)
    if "numba" in sys.modules:
        from numba.core.dispatcher import Dispatcher

        # numba refuses what cannot be cached, and in a jail nothing can
        Dispatcher.enable_caching = lambda self: None  # type: ignore[method-assign]
    ruleset = jail.readable(jail.libraries([Path(each) for each in setup["hidden"]]))
    with open(os.devnull, "r+b") as null:
        for stream in range(3):
            os.dup2(null.fileno(), stream)
    gc.collect()
    gc.freeze()
    control.send(b"ready")
    while True:
        order, files, _, _ = socket.recv_fds(control, 1 << 16, 2)
        if not order:
            return
        task = json.loads(order)
        if "ended" in task:
            control.send(str(os.waitpid(task["ended"], 0)[1]).encode())
            continue
        if pid := os.fork():
            for file in files:
                os.close(file)
            control.send(str(pid).encode())
            continue
        try:
            control.close()
            _contest(socket.socket(fileno=files[0]), files[1], ruleset, task)
        finally:
            os._exit(0)


def _contest(line: socket.socket, memory: int, ruleset: int, task: Mapping[str, Any]) -> None:
    if ask := ends_with_parent():
        ask()
    for name in os.listdir("/proc/self/fd"):
        if int(name) not in (0, 1, 2, line.fileno(), memory, ruleset):
            with contextlib.suppress(OSError):
                os.close(int(name))
    problem = replace(_problem(memory, task["buffers"]), seed=task["seed"])
    random.seed(task["seed"])
    np.random.seed(task["seed"] % 2**32)  # noqa: NPY002  for localizers that draw from it
    with _said(line):
        jail.close_in(ruleset)
        algorithm = load_localizer(task["method"], task["options"])
        name = type(algorithm).__name__
        causal = isinstance(algorithm, Localizer)
        said = name.encode()[:100]
        line.sendall(FRAME.pack(LOCALIZER if causal else SMOOTHER, len(said), *[0.0] * 14) + said)
        if isinstance(algorithm, Localizer):
            called(f"{name}.reset", lambda: algorithm.reset(problem))
            _steps(line, name, algorithm, task["layout"])
        elif isinstance(algorithm, Smoother):
            size = struct.unpack("=Q", _exactly(line, 8))[0]
            run = pickle.loads(_exactly(line, size))
            made = called(f"{name}.run", lambda: list(algorithm.run(problem, run)))
            if len(made) != run.rows:
                text = f"{name}.run returned {len(made)} estimates for {run.rows} readings"
                raise LocalizerError(text)
            times = run["t"].tolist()
            line.sendall(b"".join(_frame(name, e, t) for e, t in zip(made, times, strict=True)))


def _steps(line: socket.socket, name: str, algorithm: Localizer, layout: Any) -> None:
    """Answer each reading with an estimate."""
    step, plain = algorithm.step, [tuple(each) for each in layout]
    row = struct.Struct(f"={7 + sum(width or 1 for _, width, _ in plain)}d")
    receive, send, size = line.recv, line.send, row.size
    while True:
        data = receive(size)
        if len(data) < size:
            if not data:
                return
            data += _exactly(line, size - len(data))
        reading = unpacked(plain, row.unpack(data))  # type: ignore[arg-type]
        send(_frame(name, stepped(name, step, reading), reading.t))


def _frame(name: str, estimate: Any, t: float) -> bytes:
    """An estimate as a frame.

    Raises:
        LocalizerError: It is no estimate.
    """
    if isinstance(estimate, Estimate):
        e = estimate
        with contextlib.suppress(Exception):  # which is named below
            covariance: Any = _UNKNOWN
            if e.covariance is not None:
                covariance = np.asarray(e.covariance, float)
                if covariance.shape != (3, 3):
                    raise ValueError
                covariance = covariance.ravel().tolist()
            bias = _UNKNOWN[0] if e.bias_nt is None else e.bias_nt
            return FRAME.pack(ESTIMATE, e.t, e.x, e.y, e.yaw, *covariance, bias, bool(e.lost))
    checked_estimates(name, [estimate], np.array([t]))
    raise LocalizerError(f"{name} returned an estimate that is not made of numbers at t = {t:g} s")


@contextlib.contextmanager
def _said(line: socket.socket) -> Iterator[None]:
    """Tell the worker why the block failed."""
    try:
        yield
    except (InputError, OSError, MemoryError) as error:
        text = (str(error) or type(error).__name__).encode(errors="replace")[:4096]
        line.sendall(FRAME.pack(FAILED, len(text), *[0.0] * 14) + text)


def _problem(memory: int, buffers: list[list[int]]) -> Problem:
    """The problem in a memory file, whose arrays stay there: first its pickle, then they."""
    data = memoryview(mmap.mmap(memory, 0, prot=mmap.PROT_READ))
    parts = [data[start : start + size] for start, size in buffers]
    problem: Problem = pickle.loads(parts[0], buffers=parts[1:])
    return problem


def _exactly(line: socket.socket, size: int) -> bytes:
    data = bytearray()
    while len(data) < size:
        more = line.recv(min(size - len(data), 1 << 20))
        if not more:
            os._exit(0)
        data += more
    return bytes(data)


if __name__ == "__main__":
    main(socket.socket(fileno=int(sys.argv[1])))
