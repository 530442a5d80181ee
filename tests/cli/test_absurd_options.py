"""Huge, tiny and impossible values of options: one line that names the option, before any work begins."""

import os
from pathlib import Path

import numpy as np
import pytest

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.parallel import check_room, machine
from magtwin.run.run import Run

HUGE = "1000000000000"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a survey, a run and a data set that is not opened."""
    made = tmp_path_factory.mktemp("options")
    rows = [f"{x},{y},0,{50000 + 90 * x + 40 * y * y}" for x in range(5) for y in range(5)]
    (made / "survey.csv").write_text("\n".join(["x,y,heading,field", *rows]) + "\n")
    Run({"t": np.arange(20) * 0.1, "b_total_nt": np.full(20, 5e4)}).save(made / "run.npz")
    (made / "set").mkdir()
    (made / "set" / "dataset.json").write_text("{}")
    return made


SWEEP = "sweep lab --out new"
FIT = "map fit survey.csv --method trilinear --out new.usdc"
SURVEY = "map survey lab --out new.usdc"
TRAIN = "train set --out new.safetensors"
LOCALIZE = "localize run.npz --map lab --out new"


@pytest.mark.parametrize(
    ("command", "option", "value", "text"),
    [
        (SWEEP, "--rate-hz", "1e300", "lower --rate-hz to"),
        (SWEEP, "--rate-hz", "nan", "--rate-hz of the magnetometer must be above 0"),
        ("run lab --out new", "--duration-s", "1e12", "or --duration-s to"),
        ("run lab --out new --duration-s 2", "--speed", "1e300", "--speed must be above 0 m/s and at most"),
        ("run lab --out new", "--plant", "all:nan", "plant"),
        (SWEEP, "--duration-s", "nan", "--duration-s must be above 0 s and finite, got nan"),
        (SWEEP, "--sessions", "0", "--sessions must be a whole number from 1 up"),
        (SWEEP, "--count", HUGE, "at most 1,000,000"),
        (SWEEP, "--jobs", "0", "--jobs must be a whole number from 1 up, got 0"),
        (FIT, "--spacing-m", "1e300", "--spacing-m 1e+300 leaves no cell"),
        (FIT, "--spacing-m", "1e-300", "widen --spacing-m"),
        (FIT, "--spacing-m", "inf", "--spacing-m must be above 0 m, got inf"),
        (FIT, "--headings-deg", ",".join(map(str, np.arange(0, 360, 0.1))), "--headings-deg names 3,600"),
        (FIT, "--scale", "-1", "--scale: scale, the factor to nT, must be above 0"),
        (FIT.replace("trilinear", "harmonic"), "--earth", "nan,0,0", "--earth: earth_nt must be three"),
        ("map validate survey.csv", "--within-m", "-1", "--within-m must be 0 m or more"),
        (SURVEY, "--readings", HUGE, "--readings must be at least 1 and at most 100,000"),
        (SURVEY, "--heading-error-deg", "1e300", "--heading-error-deg must be from 0 to 90 deg"),
        (SURVEY, "--spacing-m", "0", "--spacing-m must be above 0 m"),
        (TRAIN, "--epochs", HUGE, "--epochs must be at most 100,000"),
        (TRAIN, "--threads", HUGE, "--threads must be at most 1,024"),
        (TRAIN, "--layers", HUGE, "--layers: layers (1000000000000,) make"),
        (TRAIN, "--batch", "0", "--batch must be above 0, got 0"),
        (LOCALIZE, "--rate-hz", "nan", "--rate-hz must be above 0 Hz, got nan"),
        (LOCALIZE, "--seed", "-1", "--seed must be a whole number from 0 up, got -1"),
        (LOCALIZE, "--sensor", "iron_nt=1e300", "--sensor iron_nt of SensorModel must be finite"),
        ("picture run.npz --out new.png", "--size", "nanx1", "--size is WIDTHxHEIGHT in pixels"),
        ("film run.npz --out new.gif", "--size", "1x", "--size is WIDTHxHEIGHT"),
        (
            "dataset build run.npz --map lab --out new",
            "--latency-s",
            "1e300",
            "--latency-s must be within 60 s",
        ),
        ("ros sim lab", "--duration-s", "1e300", "--duration-s is at most 1e+08 s"),
        ("ros sim lab", "--pace", "1e-300", "--pace must be at least 0.001"),
    ],
)
def test_an_absurd_value_is_refused_in_one_line_that_names_the_option(
    command: str,
    option: str,
    value: str,
    text: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    before = sorted(os.listdir())
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), f"{option}={value}", "--quiet"])
    error = capsys.readouterr().err
    assert stop.value.code in (1, 2), error
    assert len(error.splitlines()) == 1, error
    assert option in error, error
    assert text in error
    assert "fault in magtwin" not in error
    assert sorted(os.listdir()) == before


def test_what_needs_more_memory_than_is_free_is_refused_before_it_is_asked_for(monkeypatch):
    from magtwin.figures.pictures import check_size

    monkeypatch.setattr(machine, "free_memory", lambda: 2 * 10**9)
    check_size((1600, 1000))
    with pytest.raises(InputError, match=r"16384 x 16384 pixels needs about 107 GB of memory, and 2 GB are"):
        check_size((16384, 16384))
    check_room(10**9, "it", "take less", "size")
    with pytest.raises(InputError, match="it needs about 3 GB of memory, and 2 GB are free; take less"):
        check_room(3e9, "it", "take less", "size")


def test_a_limit_of_addresses_counts_as_memory(monkeypatch):
    import resource

    limits = {"soft": resource.RLIM_INFINITY}
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (limits["soft"], resource.RLIM_INFINITY))
    monkeypatch.setattr(machine, "free_memory", lambda: 10**15)
    assert machine.room() == 10**15
    limits["soft"] = 10**12
    assert 0 < machine.room() < 10**12
    limits["soft"] = 1
    assert machine.room() == 0


@pytest.mark.parametrize("error", [MemoryError("Unable to allocate 336. MiB for an array with shape (3,)")])
def test_too_little_memory_is_told_in_one_line(error, monkeypatch, tmp_path, capsys):
    import magtwin.twin

    def fail(*args, **options):
        raise error

    monkeypatch.setattr(magtwin.twin, "scene_from_toml", fail)
    with pytest.raises(SystemExit) as stop:
        main(["scene", "lab", "--out", str(tmp_path / "x"), "--quiet"])
    assert stop.value.code == 1
    assert capsys.readouterr().err == (
        "magtwin: not enough memory (Unable to allocate 336. MiB); give less data or smaller options\n"
    )
