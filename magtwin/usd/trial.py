"""Trial: a stage is opened in a process of its own first, as a damaged or malicious one can end its reader.

OpenUSD's readers can crash, loop, or fill the memory on a damaged .usdc, on deeply nested dictionaries, and
on references that multiply each other. A child process, which lives as long as this one, opens each file
before this process does, within limits of memory and time. It costs one start, then milliseconds a stage.
"""

import atexit
import contextlib
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from magtwin.budget import BUDGETS, SPARE, allowed
from magtwin.errors import InputError
from magtwin.files import shipped

VALUES = 16_000_000
"""Bytes of a layer up to which its values are tried too."""

_PROGRAM = """
import json, os, sys

try:
    import resource
except ImportError:  # Windows
    resource = None
os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
from pxr import Sdf, Usd

def sizes():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")

def limit(room):
    if resource is not None and os.path.exists("/proc/self/statm"):
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (sizes() + room, hard))

def values(layer):
    def read(path):
        if path.IsPropertyPath():
            spec = layer.GetObjectAtPath(path)
            spec.GetInfo("default"), spec.GetInfo("timeSamples")
    layer.Traverse("/", read)

def text(error):
    said = getattr(error.args[0], "commentary", None) if error.args else None
    return " ".join(str(said or error).split())

def special(file):
    return os.path.exists(file) and not os.path.isfile(file) and not os.path.isdir(file)

def layers(root, room, most_values):
    pending, seen = [root], {}
    while pending:
        file = pending.pop()
        if special(file):
            raise Refused("names " + file + ", which is no regular file")
        if file in seen or not os.path.isfile(file):
            continue
        size = os.stat(file).st_size
        room += 4 * size
        limit(room)
        with open(file, "rb") as head:
            crate = head.read(8) == b"PXR-USDC"
        try:
            layer = seen[file] = Sdf.Layer.FindOrOpen(file)
            if layer is None:
                continue
            if crate and size <= most_values:
                values(layer)
        except Exception as error:
            if crate:
                raise Refused("cannot be opened as USD: " + text(error)) from error
            continue  # raised again, with its text, where it is opened
        for asset in layer.GetCompositionAssetDependencies():
            if asset:
                pending.append(os.path.realpath(layer.ComputeAbsolutePath(asset)))
    return seen

class Refused(Exception):
    pass

for line in sys.stdin:
    job, answer = json.loads(line), ""
    held = stage = None
    try:
        held = layers(job["file"], job["room"], job["values"])
        stage = Usd.Stage.Open(job["file"])
    except MemoryError:
        answer = "memory"
    except Refused as error:
        memory = isinstance(error.__cause__, MemoryError) or "bad_alloc" in str(error)
        answer = "memory" if memory else str(error)
    except Exception:
        pass  # raised again, with its text, where it is opened
    held = stage = None
    print(json.dumps(answer), flush=True)
"""

Key = tuple[int, int, int, int]


class _Trial:
    """The child process; of a forked process, its own."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[str] | None = None
        self._owner = 0
        self._lock = threading.Lock()
        self._passed: set[Key] = set()

    def check(self, path: Path) -> None:
        """As `try_stage`."""
        about = path.stat()
        key = (about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns)
        with self._lock:
            if self._owner != os.getpid():
                self._child, self._owner = None, os.getpid()
            if key in self._passed:
                return
            self._ask(path, about.st_size)
            self._passed.add(key)

    def _ask(self, path: Path, size: int) -> None:
        for attempt in range(2):
            child = self._started()
            assert child.stdin is not None
            assert child.stdout is not None
            job = {"file": str(path.resolve()), "room": max(SPARE, allowed()), "values": VALUES}
            patience = BUDGETS["USD"].seconds + size / 1e6
            late = threading.Event()
            timer = threading.Timer(patience, _too_late, (child, late))
            timer.start()
            try:
                child.stdin.write(json.dumps(job) + "\n")
                child.stdin.flush()
                answer = child.stdout.readline()
            except BrokenPipeError:
                answer = ""
            finally:
                timer.cancel()
            if answer:
                break
            self.stop()
            if late.is_set():
                raise InputError(
                    f"{path}: USD does not open it in {patience:.0f} s: damaged, or its references multiply "
                    "each other; copy or write it again"
                )
            if attempt:  # alone in a fresh process
                raise InputError(f"{path}: damaged: USD crashes on it; copy it, or write it again")
        said = json.loads(answer)
        if said == "memory":
            self.stop()
            raise InputError(
                f"{path}: damaged, or its contents need over {max(SPARE, allowed()) / 1e9:g} GB and 4 times "
                "the size of its files; copy it again, or set MAGTWIN_ALLOW_GB"
            )
        if said:
            raise InputError(f"{path}: {said}")

    def _started(self) -> "subprocess.Popen[str]":
        if self._child is None or self._child.poll() is not None:
            # None of Python's settings of this process: they may print, or import from the working folder.
            options: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            self._child = subprocess.Popen([sys.executable, "-P", "-c", _PROGRAM], **options)
        return self._child

    def stop(self) -> None:
        """End the child."""
        child, self._child = self._child, None
        if child is not None and self._owner == os.getpid():
            child.kill()
            for pipe in (child.stdin, child.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()
            child.wait()


def _too_late(child: "subprocess.Popen[str]", late: threading.Event) -> None:
    """End a child that takes too long."""
    late.set()
    child.kill()


_TRIAL = _Trial()
atexit.register(_TRIAL.stop)


def try_stage(path: Path) -> None:
    """Open a stage in another process; a file that has not changed is tried once.

    Raises:
        InputError: USD crashes on it, does not end, or takes more memory than the budget; or it names a pipe
            or device as a layer.
    """
    if not any(path.resolve().is_relative_to(shipped(name)) for name in ("maps", "robots", "scenes")):
        _TRIAL.check(path)
