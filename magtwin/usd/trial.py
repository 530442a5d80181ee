"""Trial: a stage is opened in a process of its own first, as a damaged or malicious one can end its reader.

OpenUSD's readers can crash, loop, or fill the memory on a damaged .usdc, on deeply nested dictionaries, and
on references that multiply each other. A stage can also name any file of the machine. A child process, which
lives as long as this one, opens each file before this process does, within limits of memory and time, and
refuses names out of the stage's folder. It costs one start, then milliseconds a stage, and nothing where no
file has changed since the stage passed (`tried`). Stages that ship with magtwin are not tried.
"""

import atexit
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from magtwin.errors import InputError
from magtwin.files.budget import BUDGETS, SPARE, allowed
from magtwin.files.children import end, environment, limited
from magtwin.files.file import shipped
from magtwin.files.folders import allowed_folders
from magtwin.usd.tried import Stamp, keep, key_of, recall, stamp_of

VALUES = 16_000_000
"""Bytes of a layer up to which its values are converted to Python; those of any layer are decoded."""

PROCESSOR_S = 15.0
"""Processor time of the child for a stage [s], plus 1 s per megabyte of its layers."""

_CUT_SHORT = -getattr(signal, "SIGXCPU", 1 << 20)
"""Exit status of a child that needs more."""

PROGRAM = Path(__file__).with_name("trial_process.py")
"""What the child runs."""

SHIPPED = ("maps", "robots", "scenes", "weights")
"""Folders that ship with magtwin: trusted as its code is."""


class _Trial:
    """The child process; of a forked process, its own."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[str] | None = None
        self._owner = 0
        self._lock = threading.Lock()
        self._passed: dict[str, dict[str, Stamp | None]] = {}

    def check(self, path: Path, *, composed: bool) -> None:
        """As `try_stage`."""
        job = {
            "file": str(path.absolute()),
            "folder": _working_folder(),
            "inside": folders_of(path),
            "composed": composed,
            "room": max(SPARE, allowed()),
            "seconds": PROCESSOR_S,
            "values": VALUES,
            "prims": BUDGETS["USD"].count,
        }
        file, key = str(path.absolute()), key_of(job, PROGRAM)
        with self._lock:
            if self._owner != os.getpid():
                self._child, self._owner = None, os.getpid()
            met = self._passed.get(key)
            if met is not None and all(stamp_of(name) == stamp for name, stamp in met.items()):
                return
            met = recall(key, file)
            if met is None:
                begun = time.time()
                met = self._ask(path, job)
                keep(key, met, begun)
            self._passed[key] = met

    def _ask(self, path: Path, job: dict[str, Any]) -> dict[str, Stamp | None]:
        """Let the child do a job; returns the files that it opened."""
        patience = BUDGETS["USD"].seconds + path.stat().st_size / 1e6
        for attempt in range(2):
            child = self._started()
            assert child.stdin is not None
            assert child.stdout is not None
            with limited(child, patience) as late:
                try:
                    child.stdin.write(json.dumps(job) + "\n")
                    child.stdin.flush()
                    answer = child.stdout.readline()
                except BrokenPipeError:
                    answer = ""
            if answer:
                break
            if late.is_set() or child.wait() == _CUT_SHORT:
                self.stop()
                if late.is_set():
                    raise InputError(
                        f"{path}: USD does not open it in {patience:.0f} s; try again, or copy it"
                    )
                raise InputError(
                    f"{path}: USD does not open it in {PROCESSOR_S:g} s of the processor: damaged, or its "
                    "references multiply each other; copy or write it again"
                )
            self.stop()
            if attempt:  # alone in a fresh process
                raise InputError(f"{path}: damaged: USD crashes on it; copy it, or write it again")
        said = json.loads(answer)
        if "memory" in said:
            self.stop()
            raise InputError(
                f"{path}: damaged, or its contents need over {max(SPARE, allowed()) / 1e9:g} GB and 4 times "
                "the size of its files; copy it again, or set MAGTWIN_ALLOW_GB"
            )
        if "refused" in said:
            raise InputError(f"{path}: {said['refused']}")
        if said["outside"]:
            raise InputError(_outside(path, said["outside"]), parameter="allow")
        return {name: stamp_of(name) for name in said["files"]}

    def _started(self) -> "subprocess.Popen[str]":
        if self._child is None or self._child.poll() is not None:
            # None of Python's settings of this process: they may print, or import from the working folder.
            options: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
            options["env"] = environment(os.devnull)  # it writes nothing
            self._child = subprocess.Popen([sys.executable, "-P", str(PROGRAM)], **options)
        return self._child

    def stop(self) -> None:
        """End the child."""
        child, self._child = self._child, None
        if child is not None and self._owner == os.getpid():
            child.kill()
            end(child)


def _working_folder() -> str:
    """The working folder; "/" if it was removed."""
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        return Path(sys.executable).anchor


def _outside(path: Path, names: list[dict[str, str]]) -> str:
    """The refusal of a stage that names files out of its folder."""
    first, others = names[0], len({name["file"] for name in names}) - 1
    where = first["where"].removeprefix(str(path.absolute())).strip()
    folders = sorted({name["folder"] for name in names})
    least = [f for f in folders if not any(f != g and Path(f).is_relative_to(g) for g in folders)]
    call = ", ".join(map(repr, least)).replace("`", r"\x60")  # which would end the call in the text
    more = f", and {others} more" if others else ""
    return (
        f"{path}: {f'{where} ' if where else ''}names {first['asset']}{more}, outside the stage's folder; if "
        f"you trust the stage, give `magtwin.allow({call})`"
    )


def folders_of(stage: Path) -> list[str]:
    """Folders in which a stage may name files: its own, those shipped with magtwin, and allowed ones."""
    return [str(stage.resolve().parent), *(str(shipped(name)) for name in SHIPPED), *allowed_folders()]


def check_named(stage: Path, file: Path, where: str = "") -> Path:
    """A file that USD found for a stage, if the stage may name it. A second check, after `try_stage`.

    Args:
        stage: Root layer of the stage.
        file: The file.
        where: Layer, prim or property that names it.

    Raises:
        InputError: It is out of the stage's folder, and not allowed.
    """
    real = file.resolve()
    if not _is_shipped(stage) and not any(real.is_relative_to(folder) for folder in folders_of(stage)):
        name = {"where": where, "asset": str(file), "file": str(real), "folder": str(real.parent)}
        raise InputError(_outside(stage, [name]), parameter="allow")
    return file


def _is_shipped(stage: Path) -> bool:
    """Whether a stage ships with magtwin."""
    return any(stage.resolve().is_relative_to(shipped(name)) for name in SHIPPED)


_TRIAL = _Trial()
atexit.register(_TRIAL.stop)


def try_stage(path: Path, *, composed: bool = True) -> None:
    """Open a stage in another process, and check the files that it names; unchanged files are tried once.

    Args:
        path: A regular file.
        composed: Whether the stage will be composed. Otherwise its root layer alone is opened.

    Raises:
        InputError: USD crashes on it, does not end, or takes more memory than the budget. Or it names a file
            that is not in its folder, in those of `magtwin.files.folders.allow`, or shipped with magtwin; an
            address in the network; or a pipe or device as a layer.
    """
    if not _is_shipped(path):
        _TRIAL.check(path, composed=composed)
