"""Names of commands: groups, other words for them, old names, examples, and what is said of a wrong name."""

import ast
import re
import shlex
from pathlib import Path

import pytest
from test_options import _names, commands

import magtwin
from magtwin.cli import MODULES, load, main
from magtwin.cli.app import app
from magtwin.cli.help import _examples, examples, front
from magtwin.cli.words import GROUPS, OLD, as_of_today, guess, option_meant

load()
MEANT = """
run: simulate sim simulation drive-path simulate-robot physics runSim; plot: draw image images charts graph
video movie animate screenshot plot-map plotmap make-video; view: open show visualize visualise gui watch
show-run; info: list ls describe inspect cat metadata; robot: urdf2usd import-urdf urdf-to-usd robot2usd
usd2urdf convert-robot xacro urdftousd; scene: make-scene create-room furniture add-furniture; validate:
test check lint verify usdchecker valdate check-scene; doctor: install setup config env check-install;
bench: benchmark leaderboard bechmark benchmark-localizers; localize: slam localization locate estimate-pose
particle-filter; train: learn train-model trian neural fit-network; evaluate: predict score eval test-model
accuracy; convert: bag2csv to-csv import-bag mcap export-csv; export: usdz glb isaac omniverse package
export-scene; fetch: download get-data; sweep: batch monte-carlo grid-search; drive: teleop joystick
keyboard; demo: example quickstart tutorial; new: init create template; report: html summary dashboard; map
fit: fit map-fit mapfit make-map interpolate kriging fit-map; map survey: survey scan map-survey; map diff:
compare-maps; dataset build: dataset-build build-dataset label preprocess; model calibrate: calibration
hard-iron; model compensate: tolles-lawson tolles_lawson; model export: onnx export-model; reproduce: repeat
reproducibility; ros replay: replay playback; help: man docs help-me
"""
"""Commands, and words that lead to them."""


PAIRS = [line.split(": ") for line in " ".join(MEANT.split()).split("; ")]


@pytest.mark.parametrize(("command", "word"), [(n, w) for n, words in PAIRS for w in words.split()])
def test_an_everyday_word_leads_to_its_command(command, word):
    assert command in guess(word)


@pytest.mark.parametrize("word", ["xyzzy", "a", "-", "2", "mmmmmmmm", "..."])
def test_a_word_that_means_nothing_leads_nowhere(word):
    assert guess(word) == ()


def test_every_command_is_in_a_group_and_the_first_page_fits_a_terminal():
    assert sorted(name for _, names in GROUPS.values() for name in names.split()) == sorted(MODULES)
    lines = front().splitlines()
    assert len(lines) < 24
    assert max(map(len, lines)) <= 80
    assert [line.split()[0] for line in lines[4:11]] == [
        "Start",
        "Build",
        "Run",
        "Look",
        "Learn",
        "Localize",
        "Share",
    ]


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("plot-map", "no command 'plot-map'; did you mean `magtwin plot`: Draw a run"),
        ("create scene", "did you mean `magtwin scene`: Author"),
        ("map draw", "no command 'map draw'; did you mean `magtwin plot`"),
        ("dataset make", "did you mean `magtwin dataset build`"),
        ("rnu", "did you mean `magtwin run`"),
        ("xyzzy", "no command 'xyzzy'; magtwin help lists"),
        ("gone/run.parquet", "no such file"),
        ("run", "magtwin run needs SCENE: USD stage, or the name of a scene that ships"),
        ("scene lab", "needs --out: Folder to make"),
        ("run lab --path", "--path wants a value"),
        ("run lab --controler x", "`controller = ...` below [run] in magtwin.toml"),
        ("run lab --time 3", "did you mean --duration-s?"),
        ("run lab --output x", "did you mean --out?"),
        ("plot lab --time-step 3", "magtwin plot has no option --time-step"),
        ("info a b", "cannot use 'b'"),
    ],
)
def test_what_was_typed_wrong_is_told_with_what_to_type(typed, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(typed.split())
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    for option in re.findall(r"did you mean (--[a-z-]+)\?", line):
        app.parse_args(shlex.split(f"{typed.split(' --')[0]} {option} 1"), exit_on_error=False)


@pytest.mark.parametrize("old", [name for name in OLD if name != "version"])
def test_an_old_name_still_runs(old, capsys):
    new = as_of_today([*old.split(), "a", "--time-s=1", "--quantity", "mask"])
    assert new[:1] in (["plot"], ["model"])
    assert ("--at=1" in new) == ("plot" in new)
    main([*old.split(), "--help"])
    assert capsys.readouterr().out.startswith(f"Usage: magtwin {' '.join(OLD[old].split(' --')[0].split())}")


def told(capsys, *words):
    main(list(words))
    return capsys.readouterr().out


def test_help_is_a_command_too_and_h_is_short(capsys):
    assert told(capsys, "help", "plot") == told(capsys, "plot", "--help")
    assert len(told(capsys, "plot", "-h")) < 0.75 * len(told(capsys, "plot", "--help"))
    assert "Default: the folder run.\n" in told(capsys, "run", "-h")
    assert "[default: False]" not in told(capsys, "run", "--help")
    assert told(capsys, "help", "look") in told(capsys, "help")
    assert told(capsys, "-V") == told(capsys, "version")
    assert told(capsys) == told(capsys, "--help") == told(capsys, "-h")


EACH = [example for made in _examples() for example in made]


@pytest.mark.parametrize("example", EACH)
def test_an_example_can_be_typed(example):
    app.parse_args(shlex.split(example), exit_on_error=False, print_error=False)


def test_each_command_has_two_examples_and_quick_ones_work_in_an_empty_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for example in EACH:
        if re.match("new|doctor|info lab|map (info|export) lab|map import .*usdc|schema|completion", example):
            main([*shlex.split(example), "--quiet"])
    assert (tmp_path / "again.usdc").exists()
    assert option_meant("overwrite") == ["force"]
    assert all(len(examples(command)) == 2 for command in MODULES)


FLAG = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]+")
OTHERS = (
    "--allow --debug --help --version --json-output --output --verify --src --dst --unordered --bind --port "
)
OTHERS += "--web-viewer --hide-welcome-screen --headless --window-size --time-s --quantity"


def test_an_option_that_a_message_names_is_one_of_its_command():
    options = {" ".join(words): _names(group) | set(OTHERS.split()) for words, group in commands()}
    for file in Path(magtwin.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            parts = node.values if isinstance(node, ast.JoinedStr) else [node]
            text = "".join(str(getattr(part, "value", "X")) for part in parts if isinstance(part, ast.expr))
            assert {*FLAG.findall(text)} <= set().union(*options.values()), (file, text)
            for said in (re.split("[`;,)]", part)[0] for part in text.split("magtwin ")[1:]):
                starts = (" ".join(said.split()[:k]) for k in (3, 2, 1))
                known = next((start for start in starts if start in options), None)
                assert known is None or {*FLAG.findall(said)} <= options[known], (file, said)
