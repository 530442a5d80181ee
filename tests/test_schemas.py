"""JSON schemas of TOML files: they are what the dataclasses give, and find what magtwin would refuse."""

import json
import sys
import tomllib
from pathlib import Path

import jsonschema
import pytest
from places import ROOT

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files.settings import SCHEMAS, copy_schemas
from magtwin.twin import new_scene

TOMLS = {
    "scene": "scenes/*.toml",
    "sources": "maps/*/sources.toml",
    "robot": "robots/*/robot.toml",
    "suite": "magtwin/bench/suites/*.toml",
}
SHIPPED = [(kind, path) for kind, pattern in TOMLS.items() for path in sorted(ROOT.glob(pattern))]


def faults(kind, text):
    schema = json.loads((SCHEMAS / f"{kind}.schema.json").read_text(encoding="utf-8"))
    validator = jsonschema.Draft7Validator(schema)
    validator.check_schema(schema)
    return [error.message for error in validator.iter_errors(tomllib.loads(text))]


def contents(folder):
    return {file.name: file.read_text(encoding="utf-8") for file in folder.iterdir()}


def test_the_schemas_are_what_the_dataclasses_give(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "docs"), *sys.path])
    import schemas

    made = {f"{kind}.schema.json": schemas.schema(kind) for kind in schemas.FILES}
    assert contents(SCHEMAS) == made, "python docs/schemas.py writes them"


@pytest.mark.parametrize(("kind", "path"), SHIPPED, ids=[path.name for _, path in SHIPPED])
def test_every_toml_that_ships_is_valid(kind, path):
    assert faults(kind, path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("name", ["scenes/starter.toml", "robots/turtlebot4/robot.toml"])
def test_a_misspelt_key_is_found_in_every_table(name):
    kind = "scene" if "scenes" in name else "robot"
    lines = (ROOT / name).read_text(encoding="utf-8").splitlines()
    headers = [number for number, line in enumerate(lines) if line.startswith("[")]
    assert len(headers) > 5
    for number in headers:
        text = "\n".join([*lines[: number + 1], "colour_of_the_moon = 1", *lines[number + 1 :]])
        assert faults(kind, text)  # a number is none either of the free texts of [conversion.metadata]


@pytest.mark.parametrize(
    ("kind", "text", "said"),
    [
        ("training", 'model = "hybrid"\nlayers = [64, 64]\n', ""),
        ("training", "epoch = 3\n", "epoch"),
        ("training", 'epochs = "3"\n', "not of type 'integer'"),
        ("training", 'split = "week"\n', "is not one of"),
        ("suite", 'name = "mine"\n[[scenario]]\nname = "a"\nrun = 3\n', "run"),
        ("scene", 'name = "two"\n[[robot]]\nasset = "a"\n[[robot]]\nasset = "b"\n', ""),
        ("scene", 'name = "none"\n', "'robot' is a required property"),
        ("scene", 'name = "a"\n[robot]\nasset = "t"\n[lab]\nfloor_m = [1.0]\n', "too short"),
    ],
)
def test_values_are_checked_as_magtwin_does(kind, text, said):
    found = " ".join(faults(kind, text))
    assert said in found if said else not found


def test_a_new_toml_names_its_schema_and_finds_it(tmp_path):
    text = new_scene(tmp_path / "room.toml").read_text(encoding="utf-8")
    key, _, name = text.splitlines()[0].partition(" ")
    assert key == "#:schema"
    assert (tmp_path / name).read_bytes() == (SCHEMAS / "scene.schema.json").read_bytes()
    assert faults("scene", text) == []


def test_the_command_writes_all_schemas(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main(["schema", "--toml", "mine", "--quiet"])
    assert contents(Path("mine")) == contents(SCHEMAS)
    Path("file").touch()
    with pytest.raises((InputError, FileExistsError)):
        copy_schemas("file")
