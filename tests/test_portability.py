"""What only Linux has is switched off: commands do the same without it, as they would on macOS or Windows."""

import ctypes
import os
import signal
import subprocess
import sys
import time

import pytest

from magtwin.errors import InputError
from magtwin.files import outputs
from magtwin.parallel import machine

WITHOUT = """
import ctypes, os, signal, sys, time
for module, names in {
    os: "killpg setpgid getuid sched_getaffinity posix_fallocate sysconf",
    signal: "pthread_sigmask setitimer SIGHUP SIGALRM",
}.items():
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)
def _no_hard_links(*args, **options):
    raise NotImplementedError
os.link = _no_hard_links
sys.modules["resource"] = sys.modules["termios"] = sys.modules["fcntl"] = None
load = ctypes.CDLL
def _without_name(name=None, *args, **options):
    if name is None:
        raise OSError("no names without a library")
    return load(name, *args, **options)
ctypes.CDLL = _without_name
"""
"""A `sitecustomize` that every Python below runs at its start."""


@pytest.fixture
def without(tmp_path):
    """Run magtwin where the system offers nothing beyond what Python has everywhere."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(WITHOUT)
    path = os.pathsep.join([str(tmp_path / "site"), *sys.path])

    def run(*arguments, status=0, **options):
        command = [sys.executable, "-m", "magtwin", *map(str, arguments)]
        options |= {"env": {**os.environ, "PYTHONPATH": path}, "capture_output": True, "text": True}
        done = subprocess.run(command, cwd=tmp_path, **options)
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout + done.stderr

    return run


def test_runs_scenes_and_sweeps_have_the_same_bytes_without_what_linux_offers(without, tmp_path, monkeypatch):
    from magtwin.cli import main

    monkeypatch.chdir(tmp_path)
    scene = ["scene", "lab", "--out"]
    sweep = ["sweep", "lab", "--count", "2", "--duration-s", "2", "--jobs", "2", "--out"]
    without(*scene, "lab")
    without(*scene, "lab", "--force")  # replaces a folder, and tries the stage anew
    without(*sweep, "theirs")
    without("run", "lab/lab.usda", "--duration-s", "2", "--out", "theirs.parquet")
    main([*sweep, "ours"])
    main(["run", "lab/lab.usda", "--duration-s", "2", "--out", "ours.parquet"])
    files = [*(tmp_path / "ours").glob("*.parquet"), tmp_path / "ours.parquet"]
    assert len(files) == 3
    for file in files:
        theirs = tmp_path / str(file.relative_to(tmp_path)).replace("ours", "theirs")
        assert theirs.read_bytes() == file.read_bytes()


def test_driving_by_keys_is_refused_in_one_line_where_no_terminal_can_be_read(without):
    said = without("drive", "lab", "--no-live", status=1, input="wwq")
    assert said.strip().splitlines()[-1].startswith("magtwin: ")
    assert "--path commands.csv" in said


def test_folders_change_places_in_two_steps_where_one_is_not_to_be_had(tmp_path, monkeypatch):
    def no_library(*_, **__):
        raise OSError

    monkeypatch.setattr(ctypes, "CDLL", no_library)
    for name in ("new", "old"):
        (tmp_path / name).mkdir()
    assert not outputs.exchanged(tmp_path / "new", tmp_path / "old")
    place = tmp_path / "out"
    for text in ("first", "second"):
        with outputs.output(place, force=True) as aside:
            aside.mkdir()
            (aside / "run.csv").write_text(text)
    assert (place / "run.csv").read_text() == "second"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["new", "old", "out"]


def test_processors_and_memory_are_known_or_not_asked_for(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(machine, "Path", lambda *_: (_ for _ in ()).throw(OSError))
    assert machine.processors() == os.cpu_count()
    assert machine.free_memory() is None
    machine.check_room(1e18, "a map", "a smaller one", "size")  # nothing is known, so nothing is refused
    monkeypatch.setattr(machine, "free_memory", lambda: 10)
    with pytest.raises(InputError, match="a smaller one"):
        machine.check_room(1e18, "a map", "a smaller one", "size")


@pytest.mark.parametrize("groups", [True, False])
def test_a_process_is_ended_with_or_without_groups(groups, monkeypatch):
    if not groups:
        monkeypatch.delattr(os, "killpg", raising=False)
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True)
    start = time.monotonic()
    machine.end_group(child.pid)
    assert child.wait(30) == -(signal.SIGKILL if groups else signal.SIGTERM)
    assert time.monotonic() - start < 30


def test_a_child_asks_for_no_signal_where_there_is_none(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert machine.ends_with_parent() is None
