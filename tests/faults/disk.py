"""The preloaded shim `disk.c`: compile it; say at which call the disk fills up or the process is killed."""

import ctypes
import mmap
import os
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

OFF, COUNT, FULL, KILL = range(4)
"""What happens at the chosen call."""

SOURCE = Path(__file__).with_suffix(".c")

HIDDEN = ".magtwin-"
"""In the name of the folders in which outputs are written."""


class Control(ctypes.Structure):
    """As `struct control` in disk.c."""

    _fields_ = (
        ("calls", ctypes.c_long),
        ("at", ctypes.c_long),
        ("mode", ctypes.c_long),
        ("full", ctypes.c_long),
        ("group", ctypes.c_long),
        ("folder", ctypes.c_char * 1024),
        ("trace", ctypes.c_char * 1024),
    )


def start_below_the_shim() -> None:
    """Start this program again with the shim loaded, unless it is. Exits with 77 if nothing compiles it."""
    if "MAGTWIN_FAULTS" in os.environ:
        return
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not sys.platform.startswith("linux"):
        print("faults: needs Linux and a C compiler", file=sys.stderr)
        sys.exit(77)
    folder = Path(tempfile.mkdtemp(prefix="magtwin-faults-"))
    library, control = folder / "disk.so", folder / "control"
    options = ["-shared", "-fPIC", "-O2", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([compiler, *options, "-o", library, SOURCE, "-ldl"], check=True)
    control.write_bytes(bytes(ctypes.sizeof(Control)))
    more = {"LD_PRELOAD": str(library), "MAGTWIN_FAULTS": str(control), "MAGTWIN_FAULTS_FOLDER": str(folder)}
    try:
        done = subprocess.run([sys.executable, *sys.argv], env=os.environ | more, check=False)
    finally:
        shutil.rmtree(folder)
    sys.exit(done.returncode)


class Disk:
    """The counters that all processes with the shim share."""

    def __init__(self) -> None:
        with open(os.environ["MAGTWIN_FAULTS"], "r+b") as file:
            self._content = mmap.mmap(file.fileno(), ctypes.sizeof(Control))
        self.control = Control.from_buffer(self._content)

    def arm(self, folder: Path, mode: int, at: int = 0, trace: Path | None = None) -> None:
        """Count the calls below a folder from now on."""
        self.control.mode = OFF
        self.control.calls = self.control.full = self.control.group = 0
        self.control.at, self.control.folder = at, os.fsencode(folder)
        self.control.trace = b"" if trace is None else os.fsencode(trace)
        self.control.mode = mode

    def disarm(self) -> None:
        """Let every call pass."""
        self.control.mode = OFF


@dataclass(frozen=True)
class Call:
    """A call that changed the disk."""

    number: int
    kind: str
    path: str
    other: str
    size: int


@dataclass
class Trace:
    """The calls of a command."""

    calls: list[Call]
    unsynced: set[str] = field(default_factory=set)
    """Files that were renamed to their places before their content was on the disk."""

    @classmethod
    def read(cls, file: Path) -> "Trace":
        """The trace that disk.c wrote."""
        calls = []
        for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
            number, kind, path, other, size = line.split("\t")
            calls.append(Call(int(number), kind, os.path.normpath(path), other, int(size)))
        trace = cls(sorted(calls, key=lambda call: call.number))
        trace._follow()
        return trace

    def _follow(self) -> None:
        dirty: set[str] = set()
        for call in self.calls:
            if call.kind == "write":
                dirty.add(call.path)
            elif call.kind == "fsync":
                dirty.discard(call.path)
            elif call.kind == "rename":
                moved = [path for path in dirty if _within(path, call.other)]
                shown = HIDDEN not in call.path and HIDDEN in call.other
                self.unsynced |= {call.path + path[len(call.other) :] for path in moved if shown}
                dirty = {_moved(path, call) for path in dirty}

    def at(self, *kinds: str) -> list[int]:
        """Numbers of the calls of some kinds; all but removals by default."""
        return [c.number for c in self.calls if (c.kind in kinds if kinds else c.kind != "remove")]


def _within(path: str, folder: str) -> bool:
    return path == folder or path.startswith(folder + "/")


def _moved(path: str, call: Call) -> str:
    return call.path + path[len(call.other) :] if _within(path, call.other) else path
