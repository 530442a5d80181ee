"""Ctrl-C ends the program with status 130 and without a traceback, from its first import to its last line."""

import os
import signal
import subprocess
import sys

import pytest

INTERRUPT = "import os, signal; os.kill(os.getpid(), signal.SIGINT)"

WHILE_IMPORTING = f"""
import sys

class Finder:
    def find_spec(self, name, path, target=None):
        if name == {{name!r}}:
            {INTERRUPT}

sys.meta_path.insert(0, Finder())
sys.argv = ["magtwin", "info", "missing.parquet"]
from magtwin.start import main
main()
"""

IN_A_DESTRUCTOR = f"""
import time
import magtwin.cli
from magtwin.start import main

class Swallowed:
    def __del__(self):
        {INTERRUPT}

def command():
    Swallowed()
    time.sleep(60)

magtwin.cli.main = command
main()
"""

IN_AN_IMPORT_OF_OPENUSD = f"""
import sys
import time
import magtwin.cli
from magtwin.start import main

class Finder:
    def find_spec(self, name, path, target=None):
        if name == "pxr.Gf._gf":
            {INTERRUPT}

def command():
    sys.meta_path.insert(0, Finder())
    from pxr import UsdGeom  # OpenUSD goes on after an interrupt, with half of its modules
    time.sleep(60)

magtwin.cli.main = command
main()
"""

AS_ANOTHER_ERROR = f"""
import sys
import magtwin.cli
from magtwin.start import main

def command():
    try:
        {INTERRUPT}
    except KeyboardInterrupt:
        sys.exit(1)  # as a library that turns it into an error, which the command line reports

magtwin.cli.main = command
main()
"""


@pytest.mark.parametrize(
    "script",
    [
        *(WHILE_IMPORTING.format(name=name) for name in ("magtwin.cli", "cyclopts", "magtwin.io.formats")),
        IN_A_DESTRUCTOR,
        IN_AN_IMPORT_OF_OPENUSD,
        AS_ANOTHER_ERROR,
    ],
)
def test_an_interrupt_at_any_moment_gives_130_and_no_traceback(script, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 130
    assert "Traceback" not in done.stderr
    assert "Error" not in done.stderr


def test_an_ignored_interrupt_stays_ignored(tmp_path):
    """A shell starts background jobs so."""
    done = subprocess.run(
        [sys.executable, "-c", WHILE_IMPORTING.format(name="magtwin.cli")],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )
    assert done.returncode == 1
    assert "missing.parquet: no such file" in done.stderr


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="Linux ends the children of a killed process"
)
def test_a_killed_process_takes_its_viewer_along(tmp_path):
    script = (
        "import os, signal, subprocess, sys\n"
        "from magtwin.parallel.machine import ends_with_parent\n"
        "child = subprocess.Popen(['sleep', '60'], preexec_fn=ends_with_parent(), start_new_session=True)\n"
        "print(child.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == -signal.SIGKILL
    child = int(done.stdout)
    for _ in range(200):
        state = subprocess.run(
            ["ps", "-o", "stat=", "-p", str(child)], capture_output=True, text=True, check=False
        )
        if not state.stdout.strip() or state.stdout.startswith("Z"):
            return
        os.sched_yield()
    pytest.fail(f"process {child} lives on")
