"""Names from files reach the terminal and pages without control characters."""

import json
from contextlib import suppress

import numpy as np
import pytest

from magtwin.cli import main
from magtwin.run.run import Column, Run

EVIL = "a\x1b]0;owned\x07\x1b[31mb\u202ec\x9b2Jd\x7f<script>alert(1)</script>"
"""Sets the title and the colour of a terminal, reverses the direction of text, erases the screen; HTML."""

HARMFUL = "\x1b\x07\u202e\x9b\x7f"


def printed(capsys, *command):
    """Stdout and stderr of a command."""
    with suppress(SystemExit):
        main([str(word) for word in command])
    captured = capsys.readouterr()
    return captured.out + captured.err


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A file of each kind whose names are hostile."""
    folder = tmp_path_factory.mktemp("evil")
    columns = {"t": np.arange(20) * 0.1, "b_total_nt": np.full(20, 5e4), EVIL: np.zeros(20)}
    metadata = {"scene": EVIL, "seed": 1}
    run = Run(columns, metadata, {EVIL: Column("V", EVIL, EVIL)})
    run.save(folder / "run.npz")
    run.save(folder / "run.parquet")
    (folder / "stage.usda").write_text(
        '#usda 1.0\n(\n  defaultPrim = "World"\n  metersPerUnit = 1\n  upAxis = "Z"\n)\n'
        f'def Xform "World" {{ def "x" (prepend references = @./{EVIL}.usda@) {{}} }}\n',
        encoding="utf-8",
    )
    (folder / "robot.urdf").write_bytes(
        b'<robot name="r"><link name="a&#x9b;2J&#x202e;b"/><link name="c\x7f"/></robot>'
    )
    (folder / "room.toml").write_text('"a\\u001B[31m\\u202Eb" = 1\n', encoding="utf-8")
    (folder / "survey.csv").write_text(f"x,y,theta,{EVIL}\n0,0,0,1\n1,0,0,bad\n", encoding="utf-8")
    return folder


COMMANDS = (
    ("info", "run.npz"),
    ("info", "run.npz", "--json"),
    ("info", "run.parquet"),
    ("info", "stage.usda"),
    ("compare", "run.npz", "run.parquet"),
    ("convert", "run.npz", "--out", "o.csv"),
    ("reproduce", "run.npz"),
    ("localize", "run.npz"),
    ("report", "run.npz", "--out", "o.html"),
    ("run", "stage.usda", "--out", "o"),
    ("export", "stage.usda", "--out", "o"),
    ("robot", "robot.urdf", "--out", "o"),
    ("scene", "room.toml", "--out", "o"),
    ("map", "fit", "survey.csv", "--out", "o.usdc"),
)


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_no_command_prints_a_control_character_of_a_file(command, files, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [files / word if (files / word).exists() else word for word in command]
    text = printed(capsys, *words)
    assert text.strip()
    assert not set(text) & set(HARMFUL), ascii(text)
    assert "a fault in magtwin" not in text


def test_a_name_is_still_recognised_and_json_gives_it_back(files, capsys):
    assert r"a\x1b]0;owned\x07\x1b[31mb\u202ec\x9b2Jd\x7f" in printed(capsys, "info", files / "run.npz")
    said = json.loads(printed(capsys, "info", files / "run.npz", "--json"))
    assert (
        EVIL in str(said) or EVIL in json.dumps(said, ensure_ascii=False) or EVIL in said["metadata"]["scene"]
    )
