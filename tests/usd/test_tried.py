"""A stage that passed its trial costs nothing in the next command; a changed one is tried again."""

import os

import pytest

from magtwin.files.folders import allow
from magtwin.usd import trial, tried

ROOT = '#usda 1.0\n(\n    subLayers = [@./below.usda@]\n)\ndef Xform "World" {}\n'


@pytest.fixture
def stage(tmp_path, monkeypatch):
    """A stage with a sublayer, and a cache of its own in which files of any age are remembered."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(tried, "YOUNGEST_S", 0.0)
    (tmp_path / "stage").mkdir()
    (tmp_path / "stage" / "below.usda").write_text('#usda 1.0\ndef Xform "Below" {}\n')
    (root := tmp_path / "stage" / "root.usda").write_text(ROOT)
    return root


def tries(stage) -> bool:
    """Whether a new command lets its child open the stage."""
    command = trial._Trial()
    try:
        command.check(stage, composed=True)
        return command._child is not None
    finally:
        command.stop()


def test_a_stage_is_tried_by_the_first_command_only(stage, tmp_path):
    assert [tries(stage) for _ in range(3)] == [True, False, False]
    folder = tmp_path / "cache" / "magtwin" / "trials"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert [file.stat().st_mode & 0o777 for file in folder.iterdir()] == [0o600]


@pytest.mark.parametrize("name", ["root.usda", "below.usda"])
@pytest.mark.parametrize("change", ["edited", "replaced by one of its size and time", "gone and back"])
def test_a_stage_is_tried_again_if_one_of_its_files_changes(name, change, stage):
    assert tries(stage)
    file = stage.with_name(name)
    text, times = file.read_text(), (file.stat().st_atime_ns, file.stat().st_mtime_ns)
    if change == "edited":
        file.write_text(text + "\n")
    else:
        file.unlink()
        file.write_text(text.replace("Xform", "Scope"))
        os.utime(file, ns=times)
    assert tries(stage)


def test_a_missing_file_that_appears_and_other_circumstances_are_tried(stage, tmp_path, monkeypatch):
    stage.with_name("below.usda").unlink()
    assert tries(stage)
    stage.with_name("below.usda").write_text("#usda 1.0\n")
    assert tries(stage)
    with allow(tmp_path):
        assert tries(stage)
    (other := tmp_path / "program.py").write_text(trial.PROGRAM.read_text() + "\n")
    monkeypatch.setattr(trial, "PROGRAM", other)
    assert tries(stage)
    monkeypatch.setattr(tried.Usd, "GetVersion", lambda: (0, 1, 2))
    assert tries(stage)


def test_a_memory_that_others_can_change_or_that_cannot_be_written_is_ignored(stage, tmp_path, monkeypatch):
    assert tries(stage)
    folder = tmp_path / "cache" / "magtwin" / "trials"
    folder.chmod(0o777)
    assert tries(stage)
    folder.chmod(0o700)
    assert not tries(stage)
    with monkeypatch.context() as other_user:
        other_user.setattr(os, "getuid", lambda: 4321)
        assert tries(stage)
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    assert tries(stage)
    monkeypatch.setenv("XDG_CACHE_HOME", str(stage))  # a file
    assert [tries(stage), tries(stage)] == [True, True]
