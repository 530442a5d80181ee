"""What every command has: help, --json, --quiet, old names, flags in refusals, completion and doctor."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from magtwin.cli import MODULES, load, main
from magtwin.cli.app import app
from magtwin.cli.settings import is_setting
from magtwin.errors import InputError


def commands(group=app, words=()):
    """The words of every command, with its app."""
    if group.default_command is not None and words:
        yield words, group
    for name in group:
        if not name.startswith("-"):
            yield from commands(group[name], (*words, name))


load()
ALL = dict(commands())


def test_each_command_is_loaded_by_its_name():
    assert {words[0] for words in ALL} == set(MODULES)


@pytest.mark.parametrize("words", ALL, ids=" ".join)
def test_help_is_complete(words, capsys):
    main([*words, "--help"])
    text = capsys.readouterr().out
    assert text.startswith(f"Usage: magtwin {' '.join(words)}")
    assert "--empty-" not in text
    assert "[ARGS" not in text
    assert "--json:" in text
    assert "--quiet, -q:" in text
    assert "Examples:" in text
    lines = [line.partition(":")[2] for line in text.splitlines() if line.startswith("  --")]
    assert len(set(lines)) == len(lines)
    summary = ALL[words].help.splitlines()[0]
    assert summary.endswith((".", ":")) or len(words) == 1
    for argument in ALL[words].assemble_argument_collection(parse_docstring=True):
        if argument.parameter.show is not False and argument.parse:
            assert argument.parameter.help or argument.children, (words, argument.names)


def _names(command):
    shown = (argument for argument in command.assemble_argument_collection() if argument.show)
    return {name for argument in shown for name in argument.names}


@pytest.mark.parametrize(("command", "most"), [("run", 20), ("sweep", 18)])
def test_help_is_short_and_docs_list_the_settings_that_it_leaves_out(command, most, capsys):
    main([command, "--help"])
    options = re.findall(r"^  (?:SCENE|--[a-z-]+)", capsys.readouterr().out, re.M)
    assert len(options) <= most
    docs = (Path(__file__).parents[2] / "docs" / "runs.md").read_text(encoding="utf-8")
    for argument in ALL[command,].assemble_argument_collection():
        if is_setting(argument) and argument.name.startswith("--"):
            key = argument.name[2:].replace("-", "_")
            assert re.search(rf"^\| `{key}` \| .*{command}", docs, re.M), key


def test_a_command_that_writes_prints_its_files_as_json_and_nothing_when_quiet(tmp_path, capfd):
    out = tmp_path / "room.toml"
    main(["new", str(out), "--json"])
    output = capfd.readouterr()
    assert json.loads(output.out)["wrote"] == [str(out)]
    assert all(line.endswith("s so far") for line in output.err.splitlines())  # on a slow machine
    main(["new", str(out), "--force", "--quiet"])
    assert capfd.readouterr() == ("", "")
    main(["new", str(out), "--quiet"])
    assert capfd.readouterr() == ("", f"magtwin: {out} exists: wrote {tmp_path / 'room-1.toml'}\n")


def test_a_refusal_names_flags_in_place_of_parameters(monkeypatch, tmp_path, capsys):
    import magtwin.twin

    def refuse(*args, **options):
        raise InputError("give `force=True`, or another `map_layer`; `other=1` stays", parameter="force")

    monkeypatch.setattr(magtwin.twin, "scene_from_toml", refuse)
    with pytest.raises(SystemExit):
        main(["scene", "lab", "--out", str(tmp_path / "x"), "--quiet"])
    assert capsys.readouterr().err == "magtwin: give --force, or another --map; `other=1` stays\n"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_is_a_script_of_all_commands(shell, capsys):
    main(["completion", shell])
    script = capsys.readouterr().out
    assert all(words[-1] in script for words in ALL)
    if shell == "bash":
        subprocess.run(["bash", "-n"], input=script, text=True, check=True)


def test_doctor_lists_extras_and_how_to_install_them(capsys):
    main(["doctor", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["extras"]["physics"]["install"] == "pip install 'magtwin[physics]'"
    assert {"rerun_viewer", "vulkan", "newton", "nvidia_validator"} <= found["tools"].keys()
    main(["doctor"])
    assert "pip install" in capsys.readouterr().out


def test_help_imports_nothing_but_what_prints_it():
    code = (
        "import atexit, sys; from magtwin.cli import main; "
        "atexit.register(lambda: print(*{m.partition('.')[0] for m in sys.modules}, file=sys.stderr)); "
        "main(['--help'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    printers = {"attr", "attrs", "cyclopts", "docstring_parser", "markdown_it", "mdurl", "pygments", "rich"}
    others = set(done.stderr.split()) - sys.stdlib_module_names - printers
    assert {name for name in others if not name.startswith("_")} == {"magtwin"}


def test_an_output_may_have_the_name_of_a_choice(lab_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run = ["run", str(lab_scene), "--path", "sine", "--duration-s", "0.5", "--out", "sine", "--quiet"]
    localize = ["localize", "sine/run.parquet", "--map", "lab", "--method", "odometry", "--quiet"]
    localize += ["--out", "odometry"]
    for words in (run, localize, [*run, "--force"], [*localize, "--force"]):
        main(words)
    shutil.copytree(lab_scene.parent, "room")
    room = lab_scene.name
    for words in (
        ["run", f"room/{room}", "--path", "sine", "--duration-s", "0.5", "--out", "room"],
        ["localize", "sine/run.parquet", "--map", "room", "--method", "odometry", "--out", "room"],
        ["run", str(lab_scene), "--path", "room/" + room, "--duration-s", "0.5", "--out", "room/" + room],
    ):
        with pytest.raises(SystemExit):
            main([*words, "--force"])
        assert re.search("is read|would be removed|plays no run", capsys.readouterr().err), words
        assert (tmp_path / "room" / room).is_file()
