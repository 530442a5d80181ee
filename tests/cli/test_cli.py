"""The command line: what it writes, and how it refuses."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from waiting import PATIENCE_S, wait_until

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.parallel import check_room, machine


def survey(folder):
    """A small survey, 3 x 2 nodes a heading, in the form of the released one."""
    folder.mkdir()
    nodes = [(x, y) for y in (0, 0.25) for x in (0, 0.25, 0.5)]
    for heading in (0, 90, 180, 270):
        rows = [f"{x},{y},{np.radians(heading)},{41_000 + 100 * x + y}" for x, y in nodes]
        (folder / f"{heading}_map.csv").write_text("\n".join(["# x,y,theta,scalar_mag ", *rows]) + "\n")
    return folder


def test_a_survey_becomes_a_map_that_info_and_plot_show(tmp_path, capsys):
    folder = survey(tmp_path / "survey")
    layer, picture = tmp_path / "maps" / "small.usdc", tmp_path / "small.png"
    main(["map", "import", str(folder), "--out", str(layer), "--licence", "CC0-1.0"])
    main(["plot", str(layer.parent), "--out", str(picture)])
    assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    capsys.readouterr()
    main(["map", "info", str(layer), "--json"])
    assert "CC0-1.0" in capsys.readouterr().out
    main(["map", "import", str(folder), "--out", str(layer)])
    assert capsys.readouterr().out.startswith(f"{layer} exists: wrote {layer.with_name('small-1.usdc')}; --f")
    main(["map", "import", str(folder), "--out", str(layer), "--force"])


def test_a_scene_whose_map_was_changed_is_refused(tmp_path, refusal, lab_scene):
    import shutil

    from pxr import Sdf

    folder = shutil.copytree(lab_scene.parent, tmp_path / "lab")
    layer = next(
        p for p in folder.rglob("*.usdc") if "AnomalyMap" in (Sdf.Layer.FindOrOpen(str(p)).ExportToString())
    )
    opened = Sdf.Layer.FindOrOpen(str(layer))
    values = opened.GetAttributeAtPath("/World/AnomalyMap.magtwin:anomalyMap:valuesNt")
    changed = np.array(values.default)
    changed[0] += 1
    values.default = type(values.default).FromNumpy(changed)
    opened.Save()
    line = refusal("run", folder / lab_scene.name, "--out", tmp_path / "run.parquet")
    assert "</World/AnomalyMap>" in line
    assert "checksum" in line


def test_debug_lets_the_traceback_through(tmp_path):
    from magtwin.errors import InputError

    with pytest.raises(InputError, match="no such"):
        main(["info", str(tmp_path / "a.usda"), "--debug"])


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a limit on file sizes is of POSIX")
def test_a_full_disk_of_temporary_files_is_named_where_a_library_does_not(tmp_path):
    script = """
import resource
from magtwin.cli import main
import magtwin.io.info

def info_of(*_, **__):
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
    raise RuntimeError("could not close the layer")

magtwin.io.info.info_of = info_of
main(["info", "run.parquet"])
"""
    (tmp_path / "run.parquet").write_bytes(b"")
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"magtwin: {tmp_path}: no room for temporary files (")
    assert [file.name for file in tmp_path.iterdir()] == ["run.parquet"]


def test_options_come_from_the_environment_and_from_magtwin_toml(tmp_path, monkeypatch, capsys, lab_scene):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "magtwin.toml").write_text("[run]\nspeed = 0.15\nseed = 5\n")
    monkeypatch.setenv("MAGTWIN_RUN_SEED", "9")
    main(["run", str(lab_scene), "--duration-s", "2", "--out", "a.parquet", "--json"])
    metadata = json.loads(capsys.readouterr().out)["metadata"]
    assert metadata["seed"] == 9
    assert metadata["speed_m_s"] == 0.15
    (tmp_path / "magtwin.toml").write_text("[run]\nspeeed = 0.15\n")
    with pytest.raises(SystemExit) as stop:
        main(["run", str(lab_scene), "--duration-s", "2", "--out", "b.parquet"])
    assert stop.value.code == 2
    assert "speeed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "a pipe, not a TOML file"),
        ("[run\n", "not TOML: Expected ']'"),
        ('[run]\nseed = "x"\n', "Invalid value for [seed]: a whole number is wanted, got 'x'"),
        ("run = 5\n", "key [run] in"),
    ],
)
def test_a_damaged_magtwin_toml_is_refused_by_its_name(text, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    settings = tmp_path / "magtwin.toml"
    os.mkfifo(settings) if text is None else settings.write_text(text)
    with pytest.raises(SystemExit) as stop:
        main(["run", "lab", "--out", "a"])
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert "magtwin.toml" in line


def test_a_map_that_the_scene_reads_is_not_replaced_by_a_survey_of_it(lab_scene, refusal):
    layer = next(lab_scene.parent.glob("map/*.usdc"))
    before = layer.read_bytes()
    words = ("--spacing-m", "2", "--readings", "1", "--out", layer, "--force")
    assert "is a part of the scene" in refusal("map", "survey", lab_scene, *words)
    assert layer.read_bytes() == before


def test_a_variable_that_names_no_option_is_reported(tmp_path, monkeypatch, capsys, lab_scene, refusal):
    for name, value in {"RUN_SED": "1", "MAP_FIT_SEED": "1", "ALLOW_GB": "1", "RUN_OUT": "c.parquet"}.items():
        monkeypatch.setenv(f"MAGTWIN_{name}", value)
    monkeypatch.chdir(tmp_path)
    main(["run", str(lab_scene), "--duration-s", "1"])
    lines = [line for line in capsys.readouterr().err.splitlines() if "MAGTWIN" in line]
    said = "magtwin: warning: MAGTWIN_RUN_SED: magtwin run has no such option, it is ignored; did you mean "
    assert lines == [f"{said}MAGTWIN_RUN_SEED?"]
    monkeypatch.setenv("MAGTWIN_BENCH_REPORT_OUT", "x.html")
    refusal("bench", tmp_path / "none.toml", "--out", "b")
    assert "MAGTWIN" not in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux has /dev/full")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_stdout_that_is_full_is_named(unbuffered):
    command = [sys.executable, "-c", "from magtwin.cli import main; main()", "--version"]
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            command, check=False, stdout=full, stderr=subprocess.PIPE, text=True, env=environment
        )
    assert done.returncode == 1
    said = [line for line in done.stderr.splitlines() if "s so far" not in line]  # on a slow machine
    assert len(said) == 1
    assert said[0].startswith("magtwin: stdout cannot be written (No space left on device);")


@pytest.mark.parametrize(("sign", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_run_that_is_told_to_end_leaves_nothing(lab_scene, tmp_path, sign, status):
    command = [sys.executable, "-c", "from magtwin.cli import main; main()", "run", str(lab_scene)]
    process = subprocess.Popen(
        [*command, "--duration-s", "20000", "--out", str(tmp_path / "run")],
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # nohup ignores it
    )
    wait_until(lambda: list(tmp_path.iterdir()))
    process.send_signal(sign)
    assert process.wait(PATIENCE_S) == status
    assert not list(tmp_path.iterdir())


def test_what_needs_more_memory_than_is_free_is_refused_before_it_is_asked_for(monkeypatch):
    from magtwin.figures.pictures import check_size

    monkeypatch.setattr(machine, "free_memory", lambda: 2 * 10**9)
    check_size((1600, 1000))
    with pytest.raises(InputError, match=r"16384 x 16384 pixels needs about 107 GB of memory, and 2 GB are"):
        check_size((16384, 16384))
    check_room(10**9, "it", "take less", "size")
    with pytest.raises(InputError, match="it needs about 3 GB of memory, and 2 GB are free; take less"):
        check_room(3e9, "it", "take less", "size")
