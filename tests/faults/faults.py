"""Fill the disk, or kill the process, at the calls by which commands change the disk, and look what is left.

`make faults` fills the disk at each call of every command and kills 200 processes. `python
tests/faults/faults.py robot "map fit" --kills 20 --full 50 --seed 1` does so with some commands.
Outputs must be old or new, all of them together where the disk is full; nothing that was reported as written
may be lost; a full disk is reported in one line; and the next process removes what was left. A command runs
in a process that is forked from one that has imported all modules.
"""

import argparse
import atexit
import contextlib
import hashlib
import json
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from commands import COMMANDS, Command, make_inputs
from disk import COUNT, FULL, HIDDEN, KILL, Disk, Trace, start_below_the_shim

LIMIT_S = 300.0
"""Time after which a command hangs."""

FULL_DISK = re.compile("No space left on device|disk is full|is the disk full")
"""What the refusal says; Rerun and OpenUSD do not say why they cannot write."""

OLD = "what was there before"
"""Content of older outputs."""

Tree = dict[str, str]
"""Checksums of files by their names; "folder" of folders."""


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    status: int
    """Exit status; minus the signal that ended it."""
    out: str
    err: str


def forked(work: Callable[[], object], folder: Path, disk: Disk | None = None) -> Ended:
    """Run a function in a process of its own, and in a process group of its own."""
    files = [folder.with_name(f"{folder.name}.{name}") for name in ("out", "err")]
    child = os.fork()
    if child == 0:
        _child(work, folder, files, disk)
    with contextlib.suppress(OSError):
        os.setpgid(child, child)
    status = _waited(child)
    for _ in range(100):  # until nobody of the group writes any more
        try:
            os.killpg(child, signal.SIGKILL)
        except (ProcessLookupError, PermissionError):
            break
        time.sleep(0.01)
    return Ended(status, *(file.read_text(encoding="utf-8", errors="replace") for file in files))


def _child(work: Callable[[], object], folder: Path, files: Sequence[Path], disk: Disk | None) -> None:
    """The life of a forked process; it ends as one of its own would."""
    status: object = 70
    try:
        os.setpgid(0, 0)
        for number, file in enumerate(files, 1):
            descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
            os.dup2(descriptor, number)
            os.close(descriptor)
        os.chdir(folder)
        os.environ["TMPDIR"] = str(folder / ".tmp")
        tempfile.tempdir = None
        if disk is not None:
            disk.control.group = os.getpid()
        work()
        status = 0
    except SystemExit as end:
        status = end.code
    except BaseException as error:
        print(f"Traceback: {error!r}", file=sys.stderr)
    finally:
        with contextlib.suppress(BaseException):
            threading._shutdown()  # type: ignore[attr-defined]
            atexit._run_exitfuncs()
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status if isinstance(status, int) else int(status is not None))


def _waited(child: int) -> int:
    """Exit status of a child; one that hangs is killed, with -99 as its status."""
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return -99


def tree(folder: Path) -> tuple[Tree, list[str]]:
    """What can be seen in a folder, and the hidden folders of outputs in it."""
    shown, hidden = Tree(), list[str]()
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name.split("/")[0] == ".tmp":
            continue
        if any(part.startswith(".") and HIDDEN in part for part in name.split("/")):
            if path.is_dir() and HIDDEN in path.name:
                hidden.append(name)
        elif path.is_dir():
            shown[name] = "folder"
        else:
            shown[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return shown, hidden


@dataclass
class Result:
    """What became of a command's attempts."""

    command: str
    calls: int = 0
    writes: int = 0
    full: int = 0
    kills: int = 0
    old: int = 0
    """Attempts after which the outputs were the older ones."""
    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


class Trial:
    """A command in a folder whose disk fills up, or which is killed."""

    def __init__(self, command: Command, disk: Disk, inputs: Path, base: Path) -> None:
        self.command, self.disk, self.inputs = command, disk, inputs
        self.folder = base / "work"
        self.result = Result(command.name)
        self.new: Tree = {}
        self.varies: set[str] = set()
        self.before: Tree = {}

    def count(self) -> Trace:
        """Run the command as usual: how it changes the disk, and what it makes."""
        trace_file = self.folder.with_name("trace")
        trace_file.unlink(missing_ok=True)
        self._prepare(older=False)
        first = self._run(COUNT)
        if first.status:
            raise RuntimeError(f"{self.command.name}: {first.status}: {first.err}")
        made, _ = tree(self.folder)
        self.new = made
        self._prepare(older=True)
        again = self._run(COUNT, trace=trace_file)
        self.new, hidden = tree(self.folder)
        trace = Trace.read(trace_file)
        self.result.calls, self.result.writes = len(trace.calls), len(trace.at("write"))
        if again.status or hidden or self.new.keys() != made.keys():
            self._fault("alone", 0, f"{again.status} {again.err} {hidden} {self.new.keys() ^ made.keys()}")
        self.varies = {name for name in made if made[name] != self.new.get(name)}
        if self.varies:
            self.result.notes.append(f"bytes vary: {', '.join(sorted(self.varies))}")
        for file in sorted(trace.unsynced):
            self._fault("alone", 0, f"{file}: renamed before it was on the disk")
        return trace

    def attempt(self, mode: int, at: int, *, older: bool) -> None:
        """Fill the disk, or kill the command, at a call; then look what is left."""
        self._prepare(older=older)
        ended = self._run(mode, at, older=older)
        name = {FULL: "full disk", KILL: "kill"}[mode] + ("" if older else ", nothing before")
        if mode == FULL:
            self.result.full += 1
        else:
            self.result.kills += 1
        for problem in self._problems(ended, killed=mode == KILL):
            self._fault(name, at, problem)

    def _problems(self, ended: Ended, *, killed: bool) -> list[str]:
        found = []
        now, hidden = tree(self.folder)
        said = [line for line in ended.err.splitlines() if line.startswith("magtwin: ")]
        wrote = any(line.startswith(("Wrote ", "Next: ")) for line in ended.out.splitlines())
        if "Traceback" in ended.err or "a fault in magtwin" in ended.err or "please report" in ended.err:
            found.append(f"a fault: {ended.err.strip()[-400:]}")
        if killed and ended.status not in (0, -signal.SIGKILL):
            found.append(f"status {ended.status}: {ended.err.strip()[-300:]}")
        if not killed:
            if ended.status not in (0, 1):
                found.append(f"status {ended.status}: {ended.err.strip()[-300:]}")
            if ended.status == 1 and (len(said) != 1 or not FULL_DISK.search(said[0])):
                found.append(f"says {said or ended.err.strip()[-300:]}")
            if hidden:
                found.append(f"leaves {hidden}")
        if self.command.keeps:
            return found + self._kept(now)
        if (ended.status == 0 or wrote) and not killed and not self._is(now, self.new):
            found.append(
                f"status {ended.status}, {'reported' if wrote else 'not reported'}, but {self._unlike(now)}"
            )
        if killed:
            mixed = [n for n in now.keys() | self.new.keys() if not self._either(n, now)]
            if mixed:
                found.append(f"neither old nor new: {mixed}")
            if wrote and not self._is(now, self.new):
                found.append(f"reported as written, but {self._unlike(now)}")
        whole = [self._is(now, self.new) or self._is(now, self.before)]
        if killed:  # each output by itself: the last renames may be missing
            parts = {name.split("/")[0] for then in (now, self.new, self.before) for name in then}
            whole = [self._is_part(part, now) for part in parts]
        if not all(whole):
            found.append(f"partly new: {self._unlike(now)}")
        if not killed and ended.status and not self._is(now, self.before):
            found.append(f"failed, but new: {sorted(n for n in now if now[n] != self.before.get(n))}")
        self.result.old += self._is(now, self.before)
        return found

    def _kept(self, now: Tree) -> list[str]:
        """Parts that remain must be whole, and a repeat must complete the work."""
        found = []
        for name, what in now.items():
            known = self.new.get(name)
            if known and name not in self.varies and what not in (known, self.before.get(name)):
                found.append(f"{name}: neither old nor new")
        if self._is(now, self.new):  # it was complete
            return found
        again = forked(lambda: self._magtwin(older=self.command.name.startswith("train")), self.folder)
        now, _ = tree(self.folder)
        if again.status:
            found.append(f"a repeat ends with {again.status}: {again.err.strip()[-300:]}")
        elif not self._is(now, self.new):
            found.append(f"a repeat makes something else: {self._unlike(now)}")
        return found

    def _is(self, now: Tree, then: Tree) -> bool:
        """Whether two trees are equal, but for files whose bytes vary."""
        return now.keys() == then.keys() and all(
            what == then[name] or (then is self.new and name in self.varies and what != OLD_SUM)
            for name, what in now.items()
        )

    def _is_part(self, part: str, now: Tree) -> bool:
        """Whether a file or folder of the working folder is, with all in it, as before or new."""
        names = [n for n in {*now, *self.new, *self.before} if n.split("/")[0] == part]
        return any(
            all(now.get(n) == then.get(n) or (then is self.new and n in self.varies) for n in names)
            for then in (self.before, self.new)
        )

    def _either(self, name: str, now: Tree) -> bool:
        options = [then.get(name) for then in (self.before, self.new)]
        return now.get(name) in options or (name in self.varies and now.get(name) is not None)

    def _unlike(self, now: Tree) -> str:
        names = sorted(now.keys() | self.new.keys())
        new = [n for n in names if n in now and now[n] == self.new.get(n) != self.before.get(n)]
        old = [n for n in names if now.get(n) == self.before.get(n) != self.new.get(n)]
        other = [n for n in names if n not in new and n not in old and now.get(n) != self.new.get(n)]
        return f"new {new[:6]}, old {old[:6]}, other {other[:6]}"

    def _prepare(self, *, older: bool) -> None:
        """Empty the folder; give it what the command changes and, unless `older` is False, other outputs."""
        self.disk.disarm()
        shutil.rmtree(self.folder, ignore_errors=True)
        (self.folder / ".tmp").mkdir(parents=True)
        if self.command.begins:
            shutil.copytree(self.inputs / self.command.begins, self.folder / self.command.begins)
        begun, _ = tree(self.folder)
        if older and not self.command.keeps and self.command.force:
            for name, what in self.new.items():
                if "/" in name or name in begun:
                    continue
                place = self.folder / name
                if what == "folder":
                    place.mkdir()
                    place /= "old.usda"
                place.write_text(OLD, encoding="utf-8")
        self.before, _ = tree(self.folder)

    def _run(self, mode: int, at: int = 0, *, older: bool = True, trace: Path | None = None) -> Ended:
        self.disk.arm(self.folder, mode, at, trace)
        try:
            return forked(lambda: self._magtwin(older=older), self.folder, self.disk)
        finally:
            self.disk.disarm()

    def _magtwin(self, *, older: bool) -> None:
        from magtwin.cli import main

        main(self.command.arguments(self.inputs, force=older and not (self.command.keeps and not older)))

    def _fault(self, how: str, at: int, text: str) -> None:
        self.result.faults.append(f"{self.command.name}, {how} at {at}: {text}")
        print(f"  FAULT {self.result.faults[-1]}", flush=True)


OLD_SUM = hashlib.sha256(OLD.encode()).hexdigest()


def preload() -> None:
    """Import what commands import, without starting a thread, which a fork would lose."""
    from magtwin import cli

    cli.load()
    for name in PRELOADED:
        with contextlib.suppress(ImportError):
            __import__(name)
    tasks = Path("/proc/self/task")
    threads = [name for task in tasks.iterdir() if (name := (task / "comm").read_text().strip()) != ARROW]
    if len(threads) > 1:
        raise RuntimeError(f"threads before the first fork: {threads}")


ARROW = "jemalloc_bg_thd"
"""A thread of Arrow, which starts it again after a fork."""

PRELOADED = ("numpy", "scipy.spatial", "scipy.sparse.linalg", "scipy.optimize", "numba", "pyarrow.parquet")
PRELOADED += ("pxr.Usd", "pxr.UsdGeom", "pxr.UsdPhysics", "pxr.UsdShade", "pxr.UsdUtils", "matplotlib.pyplot")
PRELOADED += ("torch",)
"""OpenUSD's plugins and Rerun start threads when they are loaded, so each fork loads them."""


def chosen(numbers: list[int], count: int, rng: random.Random) -> list[int]:
    """At most `count` of some numbers, with the last ones, which rename."""
    if len(numbers) <= count:
        return numbers
    last = numbers[-min(count // 3, 25) :] if count >= 3 else []
    return sorted({*last, *rng.sample(numbers[: len(numbers) - len(last)], count - len(last))})


def main() -> int:
    """Try commands; returns 1 if there are faults."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("commands", nargs="*", help="names of commands; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--full", type=int, default=150, help="most full disks per command")
    parser.add_argument("--kills", type=int, default=10, help="most kills per command")
    parser.add_argument("--inputs", type=Path, default=None, help="folder of inputs to keep")
    parser.add_argument("--json", type=Path, default=None, help="results to write")
    given = parser.parse_args()
    known = {command.name: command for command in COMMANDS}
    wrong = [name for name in given.commands if name not in known]
    if wrong:
        parser.error(f"unknown {wrong}; known: {', '.join(known)}")
    start_below_the_shim()
    disk, commands = Disk(), [known[name] for name in given.commands or known]
    base = Path(os.environ["MAGTWIN_FAULTS_FOLDER"])
    inputs = (given.inputs or base / "inputs").resolve()
    inputs.mkdir(parents=True, exist_ok=True)
    made = forked(lambda: make_inputs(inputs, {n for c in commands for n in c.needs}), inputs)
    if made.status:
        raise RuntimeError(made.err)
    preload()
    results = []
    for command in commands:
        rng, trial, begun = (
            random.Random(f"{given.seed} {command.name}"),
            Trial(command, disk, inputs, base),
            time.time(),
        )
        try:
            trace = trial.count()
        except (RuntimeError, OSError) as error:  # the others are tried
            results.append({"command": command.name, "faults": [str(error)]})
            print(f"  FAULT {error}", flush=True)
            continue
        for at in chosen(trace.at(), given.full, rng):
            trial.attempt(FULL, at, older=True)
        every = [call.number for call in trace.calls]
        for index, at in enumerate(chosen(every, given.kills, rng)):
            trial.attempt(KILL, at, older=index % 4 != 3)
        result = trial.result
        results.append(vars(result))
        print(
            f"{command.name:18s} {result.calls:5d} calls {result.writes:5d} writes {result.full:4d} full "
            f"{result.kills:4d} kills {result.old:4d} old {len(result.faults):3d} faults "
            f"{time.time() - begun:6.1f} s "
            f"{'; '.join(result.notes)}",
            flush=True,
        )
        if given.json:
            given.json.write_text(json.dumps(results, indent=1), encoding="utf-8")
    return int(any(result["faults"] for result in results))


if __name__ == "__main__":
    sys.exit(main())
