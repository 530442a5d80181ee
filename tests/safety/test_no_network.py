"""No command asks a host, listens for others, or writes into the user's home folder."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

COMMANDS = """
new room.toml
scene lab --out lab
info lab/lab.usda
run lab/lab.usda --duration-s 2 --out run
plot run/run.rrd --out recording.png
plot lab/lab.usda --out lab.png
view run/run.rrd
convert run/run.parquet drive.mcap
convert run/run.parquet drive.usdc
report run/run.parquet --out run.html
localize run/run.parquet --map lab --method odometry --out localized
export lab/lab.usda --out handed_on --target isaac
validate handed_on/lab.usda
map info lab
doctor
view --help
"""
"""README's commands that need no network, with short runs. Pictures and windows may fail."""

ALL = """
import sys
from magtwin.cli import main
for line in sys.argv[1].splitlines():
    try:
        status = main(line.split())
    except SystemExit as end:
        status = end.code
    print("ended:", status or 0, line, flush=True)
"""


@pytest.fixture(scope="module")
def watched(tmp_path_factory) -> tuple[dict[str, str], Path]:
    """Environment in which programs note what leaves the machine, and the file of the notes."""
    compiler = shutil.which("cc")
    if compiler is None or not sys.platform.startswith("linux"):
        pytest.skip("needs Linux and a C compiler, cc")
    folder = tmp_path_factory.mktemp("watched")
    source, library = Path(__file__).with_name("no_network.c"), folder / "no_network.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    (home := folder / "home").mkdir(mode=0o500)
    private = ("XDG_", "DISPLAY", "WAYLAND_DISPLAY", "NETWORK_NOTES", "MPLCONFIGDIR", "CI")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(private)}
    notes = folder / "notes.txt"
    trap = {"LD_PRELOAD": str(library), "NETWORK_NOTES": str(notes), "HOME": str(home)}
    return {**kept, **trap}, notes


def test_what_leaves_the_machine_is_noted_also_from_a_child(watched, tmp_path):
    environment, notes = watched
    ask = "import socket\nfor host in ('192.0.2.1', 'nowhere.invalid', '127.0.0.1'):\n try:"
    ask += "  socket.create_connection((host, 1))\n except OSError:  pass"
    child = f"import subprocess, sys\nsubprocess.run([sys.executable, '-c', {ask!r}], check=True)"
    subprocess.run([sys.executable, "-c", child], env=environment, check=True)
    assert [line.partition(" by ")[0] for line in notes.read_text().splitlines()] == [
        "connect to 192.0.2.1",
        "look-up of nowhere.invalid",
    ]
    notes.unlink()


@pytest.mark.slow
def test_commands_ask_no_host_and_write_nothing_into_a_home_folder_but_caches(watched, tmp_path):
    environment, notes = watched
    command = [sys.executable, "-c", ALL, COMMANDS.strip()]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    ends = [line.split(maxsplit=2) for line in done.stdout.splitlines() if line.startswith("ended:")]
    assert len(ends) == len(COMMANDS.strip().splitlines())
    failed = {line for _, status, line in ends if status != "0"}
    assert failed <= {line for line in COMMANDS.splitlines() if line.startswith(("plot", "view run"))}
    assert not notes.exists(), notes.read_text()
    home = Path(environment["HOME"])  # read-only, but not for the superuser
    files = [path.relative_to(home) for path in home.rglob("*") if path.is_file()]
    assert {path.parent.as_posix() for path in files} <= {".cache/matplotlib", ".cache/magtwin/trials"}
