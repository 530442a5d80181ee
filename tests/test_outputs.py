"""Outputs of a command appear all at once or not at all, whatever fails or fills the disk."""

import errno
import os
import signal
from contextlib import suppress
from pathlib import Path

import pytest

from magtwin.errors import InputError
from magtwin.files import outputs
from magtwin.files.outputs import afterwards, check_free, free, not_read, output, reading, transaction

EVENTS = (
    (os, "fsync"),
    (os, "link"),
    (Path, "rename"),
    (Path, "replace"),
    (Path, "mkdir"),
)
"""Calls that reach the disk."""


def write_three(folder):
    """Replace a file and a folder, and make a new file, in one transaction."""
    with transaction():
        with output(folder / "a.txt", force=True) as aside:
            aside.write_text("new")
        with output(folder / "b", force=True) as aside:
            aside.mkdir()
            (aside / "new").write_text("new")
        with output(folder / "sub" / "c.txt", force=True) as aside:
            aside.write_text("new")


def fill(folder):
    folder.mkdir()
    (folder / "a.txt").write_text("old")
    (folder / "b").mkdir()
    (folder / "b" / "old").write_text("old")
    (folder / "sub").mkdir()
    return folder


def content(folder):
    """Every file below a folder, with its text; none of hidden folders."""
    files = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    return {name: p.read_text() for name, p in files.items() if outputs.HIDDEN not in name}


OLD = {"a.txt": "old", "b/old": "old"}
NEW = {"a.txt": "new", "b/new": "new", "sub/c.txt": "new"}


def at_event(monkeypatch, number, then):
    """Call `then` in place of the `number`-th call that reaches the disk; returns the calls so far."""
    calls = []

    def counted(function):
        def call(*args, **options):
            calls.append(function)
            return then() if len(calls) == number else function(*args, **options)

        return call

    for owner, name in EVENTS:
        monkeypatch.setattr(owner, name, counted(getattr(owner, name)))
    return calls


def killed(number, work):
    """Kill a forked process at its `number`-th call that reaches the disk; whether it came so far."""
    child = os.fork()
    if child == 0:
        with suppress(BaseException), pytest.MonkeyPatch.context() as patch:
            at_event(patch, number, lambda: os.kill(os.getpid(), signal.SIGKILL))
            work()
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def test_a_kill_at_any_write_sync_or_rename_leaves_each_output_old_or_new(tmp_path):
    number, seen, alive = 0, [], True
    while alive:
        number += 1
        folder = fill(tmp_path / f"{number}")
        alive = killed(number, lambda folder=folder: write_three(folder))
        found = content(folder)
        assert all(found[name] in (OLD.get(name), NEW.get(name)) for name in found), number
        assert "a.txt" in found, number
        assert ("b/old" in found) != ("b/new" in found), number
        seen.append(found)
    assert seen[0] == OLD
    assert seen[-1] == NEW
    assert number > 12


@pytest.mark.parametrize("exchange", [True, False])
def test_a_disk_that_refuses_any_write_sync_or_rename_leaves_the_old_outputs(tmp_path, monkeypatch, exchange):
    """Also where two folders cannot change places at one moment."""
    if not exchange:
        monkeypatch.setattr(outputs, "exchanged", lambda one, other: False)
    number, fault = 0, errno.ENOSPC
    while True:
        number += 1
        folder = fill(tmp_path / f"{number}")

        def refuse():
            raise OSError(fault, os.strerror(fault))

        refusals = []
        with monkeypatch.context() as patch:
            calls = at_event(patch, number, refuse)
            try:
                write_three(folder)
            except InputError as error:
                refusals.append(str(error))
        if len(calls) < number:
            break
        assert content(folder) == (OLD if refusals else NEW), number
        assert all("cannot be written" in text for text in refusals)
        assert not list(folder.rglob(".*"))
    assert content(folder) == NEW
    assert number > 12


def test_ctrl_c_while_outputs_are_renamed_leaves_the_old_ones(tmp_path, monkeypatch):
    folder, replace = fill(tmp_path / "out"), Path.replace

    def interrupted(self, to):
        replace(self, to)
        if self.name == "c.txt":  # the last one
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_three(folder)
    assert content(folder) == OLD


def write_and_fail(folder, called):
    with transaction():
        with output(folder / "a.txt", force=True) as aside:
            aside.write_text("new")
        with output(folder / "log.txt", at_once=True) as aside:
            aside.write_text("kept")
        afterwards(lambda: called.append(1))
        assert (folder / "a.txt").read_text() == "old"
        raise KeyError


def test_nothing_appears_before_the_end_and_nothing_at_all_after_an_error(tmp_path):
    folder, called = fill(tmp_path / "out"), []
    with pytest.raises(KeyError):
        write_and_fail(folder, called)
    assert content(folder) == {**OLD, "log.txt": "kept"}
    assert not called
    with transaction():
        afterwards(lambda: called.append((folder / "a.txt").read_text()))
        write_three(folder)  # a part of the outer transaction
        assert (folder / "a.txt").read_text() == "old"
    assert called == ["new"]


def test_a_part_of_an_output_is_there_at_once(tmp_path):
    with transaction(), output(tmp_path / "run") as folder:
        folder.mkdir()
        with output(folder / "part.txt") as aside:
            aside.write_text("x")
        assert (folder / "part.txt").read_text() == "x"
    assert content(tmp_path) == {"run/part.txt": "x"}


def write(folder, texts, *, force=False):
    """Make a folder of texts by name."""
    with output(folder, force=force) as aside:
        aside.mkdir()
        for name, text in texts.items():
            (aside / name).parent.mkdir(exist_ok=True)
            (aside / name).write_text(text)


def test_a_folder_that_holds_an_input_is_not_replaced_unless_the_output_has_a_copy(tmp_path):
    (tmp_path / "room" / "b").mkdir(parents=True)
    (tmp_path / "room" / "b" / "in.csv").write_text("old")
    with reading([*map(Path, ("", "x\0", "n" * 5000)), tmp_path / "room" / "b" / "in.csv"]):
        for others in ({}, {"b/in.csv": "new"}):
            with pytest.raises(InputError, match=r"b/in\.csv, which is read"):
                write(tmp_path / "room", others, force=True)
        write(tmp_path / "room", {"b/in.csv": "old", "more.csv": "new"}, force=True)
    assert content(tmp_path / "room") == {"b/in.csv": "old", "more.csv": "new"}


def test_an_input_is_not_replaced_unless_it_is_changed_in_place(tmp_path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "map.csv").write_text("old")
    with reading([tmp_path / "runs", tmp_path / "map.csv"]):
        for name in ("runs", "map.csv", "runs/../map.csv"):
            with pytest.raises(InputError, match="is read by this command and would be replaced"):
                check_free(tmp_path / name, force=True)
        with output(tmp_path / "map.csv", force=True, in_place=True) as aside:
            aside.write_text("new")
        not_read(tmp_path / "runs")  # it was a name that ships
        check_free(tmp_path / "runs", force=True)
    check_free(tmp_path / "map.csv", force=True)
    assert content(tmp_path) == {"map.csv": "new"}


def test_what_another_process_made_in_the_meantime_is_not_replaced(tmp_path):
    with pytest.raises(InputError, match="another process has made it in the meantime"):
        write(tmp_path / "a", {"x.txt": "mine", "../../a/x.txt": "theirs"})
    assert content(tmp_path) == {"a/x.txt": "theirs"}


@pytest.mark.parametrize("target", ["a.txt", "missing", "../other/a.txt"])
def test_a_link_is_replaced_itself_and_only_by_force(target, tmp_path):
    for folder in ("here", "other"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.txt").write_text("old")
    link = tmp_path / "here" / "link.txt"
    link.symlink_to(target)
    with pytest.raises(InputError, match="exists already as a link"), output(link) as aside:
        aside.write_text("new")
    assert link.readlink() == Path(target)
    with output(link, force=True) as aside:
        aside.write_text("new")
    assert not link.is_symlink()
    assert content(tmp_path) == {"here/a.txt": "old", "here/link.txt": "new", "other/a.txt": "old"}


def test_a_link_to_a_folder_is_replaced_itself_whatever_the_folder_holds(tmp_path):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "thesis.tex").write_text("mine")
    (tmp_path / "out").symlink_to("data")
    check_free(tmp_path / "out", force=True)
    write(tmp_path / "out", {"x.txt": "new"}, force=True)
    assert not (tmp_path / "out").is_symlink()
    assert content(tmp_path) == {"data/thesis.tex": "mine", "out/x.txt": "new"}


def test_a_file_that_is_rewritten_in_its_place_is_found_through_a_link(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    with output(tmp_path / "link.txt", force=True, in_place=True) as aside:
        aside.write_text("new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


def test_links_are_put_back_if_a_later_output_of_the_command_fails(tmp_path, monkeypatch):
    (tmp_path / "data").mkdir()
    (tmp_path / "a.txt").write_text("old")
    links = {"file": Path("a.txt"), "folder": Path("data"), "missing": Path("nowhere")}
    for name, target in links.items():
        (tmp_path / name).symlink_to(target)
    with suppress(InputError), transaction():
        for name in ("file", "missing"):
            with output(tmp_path / name, force=True) as aside:
                aside.write_text("new")
        write(tmp_path / "folder", {"x.txt": "new"}, force=True)
        write(tmp_path / "last", {"x.txt": "mine", "../../last/x.txt": "theirs"})
    assert content(tmp_path)["last/x.txt"] == "theirs", "the command did not fail"
    assert {name: (tmp_path / name).readlink() for name in links} == links


def test_an_output_that_exists_gets_the_next_number_with_all_that_lies_beside_it(tmp_path):
    for name in ("run", "a.md", "b-1.png", "b.rrd", "c.scans.parquet"):
        (tmp_path / name).touch()
    for asked, beside, found in (
        (("run",), (), ("run-1",)),
        (("a.safetensors",), (".md", ".png"), ("a-1.safetensors",)),
        (("b.rrd", "b.png", "d"), (), ("b-2.rrd", "b-2.png", "d-2")),
        (("c.parquet",), (".scans.parquet",), ("c-1.parquet",)),
        (("new/e",), (), ("new/e",)),
    ):
        with reading([]):
            names = free(*(tmp_path / name for name in asked), beside=beside)
            assert names == [tmp_path / name for name in found]
            told = zip(asked, found, strict=True)
            assert outputs.instead() == {tmp_path / a: tmp_path / b for a, b in told if a != b}
    assert free(tmp_path / "run", force=True) == [tmp_path / "run"]
    assert not (tmp_path / "new").exists()  # nothing was written there
    assert not [*tmp_path.glob(".*")]


def test_commands_at_the_same_time_get_names_of_their_own_and_a_killed_one_leaves_none(tmp_path):
    """Twelve processes ask at once; some are killed while they hold a name."""
    gate, children = os.pipe(), []
    for k in range(12):
        children.append(os.fork())
        if children[-1] == 0:
            os.read(gate[0], 1)
            with reading([]):
                (name,) = free(tmp_path / "run")
                if k % 4 == 0:
                    os.kill(os.getpid(), signal.SIGKILL)
                with output(name) as aside:
                    aside.write_text(str(k))
            os._exit(0)
    os.write(gate[1], b"x" * len(children))
    ends = [os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]
    assert ends == [-signal.SIGKILL, 0, 0, 0] * 3
    texts = [file.read_text() for file in tmp_path.iterdir() if not file.name.startswith(".")]
    assert sorted(map(int, texts)) == [k for k in range(12) if k % 4]
    for _ in range(3):  # later commands take over what the killed ones left
        with reading([]):
            free(tmp_path / "run")[0].touch()
    with reading([]):
        free(tmp_path / "run")
    assert len([*tmp_path.glob("run*")]) == 12


@pytest.mark.skipif(os.name != "posix" or os.getuid() != 0, reason="needs a second user")
def test_a_folder_that_cannot_be_written_is_refused_at_once(tmp_path):
    folder = tmp_path / "theirs"
    folder.mkdir()
    tmp_path.parent.chmod(0o755)
    child = os.fork()
    if child == 0:
        os.chdir(folder)
        os.setuid(65534)
        said = ""
        with suppress(BaseException), reading([]):
            try:
                free(Path("run"))
            except InputError as error:
                said = str(error)
        os._exit(not ("run: cannot be written" in said and "read-only; give a name elsewhere" in said))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
