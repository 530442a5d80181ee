"""What each command prints, as text and as JSON, and what it does with a name that exists."""

import hashlib
import json
import re
import shlex
import tempfile
from contextlib import suppress
from pathlib import Path

import pytest
from faults.commands import COMMANDS, make_inputs

from magtwin.cli import main
from magtwin.cli.terminal import MOST_LINES, refusal
from magtwin.errors import InputError

ROOT = Path(__file__).parents[2]

TAKEN = (
    *("new", "schema", "robot", "robot to urdf", "scene", "map import", "map fit", "map export", "plot"),
    *("map upward", "map occupancy", "map survey", "convert parquet", "report", "localize", "export layer"),
    *("dataset build", "train linear", "model export", "evaluate", "sweep", "bench", "bench report"),
)
"""Commands that are also typed on full disks, by their names there."""

assert set(TAKEN) <= {command.name for command in COMMANDS}

SHOWN = (
    "run lab --duration-s 2",
    "reproduce IN/run.parquet",
    "compare IN/run.parquet IN/run.parquet",
    "map diff IN/map.usdc IN/map.usdc",
    "map validate IN/survey --method trilinear --method cubic",
    "validate IN/room/room.usda --against core --out found.json",
    "bench compare IN/results IN/results",
    "doctor",
    *("info lab", "info IN/run.parquet", "map info lab", "dataset info IN/set", "completion bash"),
)
"""Other commands."""

WHOLE = ("completion bash", *(words for words in SHOWN if "info" in words))

DATA = {
    "compare": "agreements",
    "completion": "script",
    "convert": "rows",
    "doctor": "extras",
    "map occupancy": "origin_m",
    "schema": "version",
    "validate": "checks",
}
"""A key of the JSON of commands that print no report."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("inputs")
    make_inputs(folder, {"scene", "run", "readings", "dataset", "network", "results"})
    return folder


def tree(folder):
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    return {file.relative_to(folder): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def keys(content, *, by_name=False):
    """Keys of JSON, but for those that are names of the user's."""
    for name, value in content.items() if isinstance(content, dict) else ():
        if not by_name:
            yield name
        yield from keys(value, by_name=by_name or name in ("metadata", "packages", "extras", "agreements"))
    for value in content if isinstance(content, list) else ():
        yield from keys(value, by_name=by_name)


NUMBERS = r"\(?(x )?-?\d[\d,]*(\.\d+)?(([ ,.xyz]|to|of)+-?\d[\d,]*(\.\d+)?)*\)?"  # 10 x 7, (1, 2), 25,000


def for_eyes(content, name=""):
    """Texts of numbers in JSON, by their keys, but for dates and versions; notes are for people."""
    if isinstance(content, dict | list):
        for key, value in content.items() if isinstance(content, dict) else ((name, x) for x in content):
            if key not in ("notes", "wrote", "next", "packages", "version", "magtwin", "created", "numpy"):
                yield from for_eyes(value, key)
    elif isinstance(content, str) and re.fullmatch(rf"(?!\d+\.\d+\.\d+$)({NUMBERS})", content):
        yield f"{name}: {content}"


def typed(words, capsys):
    """Stdout and stderr of a command that ends well, or finds something."""
    capsys.readouterr()
    with suppress(SystemExit):
        main(words)
    return capsys.readouterr()


WALKED = {c.name: c.words for c in COMMANDS if c.name in TAKEN} | {words: words for words in SHOWN}


@pytest.mark.parametrize("name", WALKED)
def test_a_command_prints_few_lines_and_typed_again_it_writes_beside_and_says_so(
    name, inputs, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    words = [word.replace("IN/", f"{inputs}/") for word in WALKED[name].split()]
    out, _ = typed(words, capsys)
    lines = out.splitlines()
    assert lines
    assert len(lines) <= MOST_LINES or name in WHOLE, out
    assert not re.search(r"[0-9a-f]{40}|\('", out) or name in WHOLE, "checksums, or a Python tuple"
    for line in out.partition("Next:  ")[2].splitlines():
        assert shlex.split(line)[0] in ("magtwin", "cd")
    before = tree(tmp_path)
    out, told = typed([*words, "--json"], capsys)
    content = json.loads(out, parse_constant=lambda text: pytest.fail(f"{text} is no JSON"))
    assert all(re.fullmatch(r"[a-z][a-z0-9_]*", found) for found in keys(content)), [*keys(content)]
    assert not [*for_eyes(content)]
    if known := DATA.get(name, DATA.get(words[0], "")):
        assert known in [*keys(content)]
        assert f"`{known}`" in (ROOT / "docs" / "output.md").read_text(encoding="utf-8")
    after = tree(tmp_path)
    if words[0] == "bench" and "--jobs" in words:  # it continues
        return
    assert before.items() <= after.items(), "something was replaced"
    wrote = content.get("wrote", []) if isinstance(content, dict) else []
    if wrote:
        assert after.keys() - before.keys()
        assert re.search(r"magtwin: .* exists?(.*): wrote .*[-_]1", told), told
        assert all(Path(path).exists() and re.search(r"[-_]1\b|[-_]1[/._]", path) for path in wrote)


@pytest.mark.parametrize(
    ("words", "status", "error"),
    [
        ("info no.usda", 1, {"hint": "magtwin run lab makes run/run.parquet, and lab is a stage"}),
        ("run lab --path no", 1, {"hint": "give a name, or a CSV file with x,y in metres"}),
        ("run lab --duration-s x", 2, {"parameter": "--duration-s"}),
        ("new x.txt", 1, {"file": "x.txt"}),
    ],
)
def test_a_refusal_in_json_names_the_file_the_parameter_and_the_way_on(
    words, status, error, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main([*words.split(), "--json"])
    out, told = capsys.readouterr()
    said = json.loads(out)["error"]
    assert end.value.code == status
    assert error.items() <= said.items()
    assert told == f"magtwin: {said['message']}\n"


def test_a_text_before_a_colon_is_a_file_only_if_it_looks_like_one():
    assert refusal("room.toml [lab]: no; do") == {"message": "room.toml [lab]: no; do", "hint": "do"}
    assert refusal("a/b: no")["file"] == "a/b"
    assert "file" not in refusal("seed: no")


def test_a_refusal_names_the_file_that_was_typed_and_not_its_copy(tmp_path, monkeypatch, capsys):
    import magtwin.io.info

    def refuse(file, **_):
        with tempfile.TemporaryDirectory() as folder:
            raise InputError(f"{folder}/part/x.mcap: damaged; not {tmp_path}")

    monkeypatch.setattr(magtwin.io.info, "info_of", refuse)
    (tmp_path / "bag.mcap").touch()
    with pytest.raises(SystemExit):
        main(["info", str(tmp_path / "bag.mcap")])
    assert capsys.readouterr().err == f"magtwin: {tmp_path / 'bag.mcap'}: damaged; not {tmp_path}\n"
