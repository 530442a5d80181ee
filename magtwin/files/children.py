"""Children: the programs that magtwin starts, each with a home folder of its own and a dead proxy.

A program may write settings, caches and identifiers into HOME, or ask hosts for news. The HOME of a child is
a temporary folder, removed when it ends; a program that honours the proxy settings reaches no host.
"""

import json
import os
import site
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

LATE = -(1 << 16)  # Status of a program that was ended at its time limit; none has it by itself
_NOWHERE = "http://127.0.0.1:0"  # nothing can listen on port 0: nothing is asked, no name is looked up
_QUIET = {
    "CI": "1",  # Rerun collects no usage data where this is set, and writes no identifier
    **dict.fromkeys(("NO_PROXY", "no_proxy"), "127.0.0.1,localhost"),
    **dict.fromkeys(("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY"), _NOWHERE),
    **dict.fromkeys(("http_proxy", "https_proxy", "all_proxy"), _NOWHERE),
}
_LOUD = ("FORCE_RERUN_ANALYTICS", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME")
Changes = Mapping[str, str | None]
_NONE: Changes = MappingProxyType({})
_HOMES = ("HOME", "USERPROFILE", "APPDATA", "LOCALAPPDATA", "TMPDIR", "TMP", "TEMP")
_user = os.path.expanduser  # Path.expanduser raises where there is no home


def environment(home: str, changes: Changes = _NONE) -> dict[str, str]:
    """Environment of a child.

    Args:
        home: Folder for its settings, caches and temporary files; `os.devnull` for a child that writes none.
        changes: Other variables; None removes one.
    """
    # From the user's home: packages of `pip install --user`, and the right to open windows.
    same = {"PYTHONUSERBASE": site.getuserbase(), "XAUTHORITY": _user("~/.Xauthority")}
    changed = {**dict.fromkeys(_LOUD), **_QUIET, **dict.fromkeys(_HOMES, home), **changes}
    return {name: v for name, v in {**same, **os.environ, **changed}.items() if v is not None}


def caches() -> str:
    """This user's folder of caches, for `XDG_CACHE_HOME` of a child that compiles for minutes."""
    return os.environ.get("XDG_CACHE_HOME") or _user("~/.cache")


@contextmanager
def own_home(changes: Changes = _NONE) -> Iterator[dict[str, str]]:
    """The environment of a child whose home folder is removed after the block."""
    with tempfile.TemporaryDirectory(prefix="magtwin-child-", ignore_cleanup_errors=True) as home:
        yield environment(home, changes)


def run(
    command: Sequence[str], *, limit_s: float | None = None, changes: Changes = _NONE, **options: Any
) -> "subprocess.CompletedProcess[Any]":
    """Run a program to its end and capture what it prints, as text unless `options` say otherwise.

    At its time limit it is killed; then the status is `LATE`, and `stderr` states the limit.
    """
    wanted: Any = {"text": True, "errors": "replace", "capture_output": True, "stdin": subprocess.DEVNULL}
    with own_home(changes) as env:
        try:
            return subprocess.run(command, check=False, timeout=limit_s, env=env, **(wanted | options))
        except subprocess.TimeoutExpired:
            return subprocess.CompletedProcess(command, LATE, "", f"took longer than {limit_s:.0f} s")


def answer_of(
    module: str, job: Mapping[str, Any], limit_s: float, *flags: str
) -> tuple[Any, "subprocess.CompletedProcess[str]"]:
    """Let a module do a job in a process of its own: its answer, None if it gave none, and how it ended.

    The module gets the name of a JSON file with the job, whose key `answer` names the JSON file to write.
    """
    with tempfile.TemporaryDirectory() as folder:
        task, answer = Path(folder, "job.json"), Path(folder, "answer.json")
        task.write_text(json.dumps({**job, "answer": str(answer)}), encoding="utf-8")
        done = run([sys.executable, "-P", *flags, "-m", module, str(task)], limit_s=limit_s)
        return json.loads(answer.read_text(encoding="utf-8")) if answer.is_file() else None, done


@contextmanager
def limited(process: "subprocess.Popen[Any]", limit_s: float | None) -> Iterator[threading.Event]:
    """Kill a process if the block takes longer; the event is set then."""
    late = threading.Event()

    def kill() -> None:
        late.set()
        process.kill()

    timer = threading.Timer(limit_s or 0.0, kill)
    timer.daemon = True
    if limit_s is not None:
        timer.start()
    try:
        yield late
    finally:
        timer.cancel()


def end(process: "subprocess.Popen[Any]", *, patience_s: float = 0.0) -> None:
    """Close a process's input, wait for its end, then kill it, and close its pipes."""
    with suppress(OSError):
        if process.stdin is not None:
            process.stdin.close()
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()
