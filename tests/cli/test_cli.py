"""The command line: what it writes, and how it refuses."""

import json
import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from waiting import PATIENCE_S, wait_until

from magtwin.cli import main
from magtwin.cli.maps.map import headings_rad
from magtwin.errors import RepairWarning

HEAVY = ("torch", "pxr", "rerun", "scipy", "numba", "pyarrow", "pyvista", "matplotlib")


def heavy_modules_after(code: str) -> set[str]:
    """Which heavy libraries a fresh Python has loaded after `code`."""
    script = f"import sys\n{code}\nprint(*[m for m in {HEAVY} if m in sys.modules], file=sys.stderr)"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(result.stderr.split())


def test_importing_magtwin_loads_nothing_heavy():
    assert heavy_modules_after("import magtwin, magtwin.spec.scene, magtwin.run.run, magtwin.path") == set()


def test_help_loads_nothing_heavy():
    assert (
        heavy_modules_after("from magtwin.cli import main\nmain(['--help'])\nmain(['run', '--help'])")
        == set()
    )


def test_every_command_of_the_readme_is_a_command(capsys):
    for command in ("demo", "robot", "map import", "map plot", "map info", "scene", "run", "network convert"):
        main([*command.split(), "--help"])
        assert f"Usage: magtwin {command}" in capsys.readouterr().out
    for command in ("info", "view", "fetch"):
        main([command, "--help"])
        assert f"Usage: magtwin {command}" in capsys.readouterr().out


def survey(folder, *, headings=(0, 90, 180, 270), field=41_000.0, edit=lambda heading, lines: lines):
    """A small survey, 3 x 2 nodes a heading, in the form of the released one."""
    folder.mkdir()
    for heading in headings:
        lines = ["# x,y,theta,scalar_mag "]
        for y in (0.0, 0.25):
            lines += [f"{x},{y},{np.radians(heading)},{field + 100 * x + y}" for x in (0.0, 0.25, 0.5)]
        (folder / f"{heading}_map.csv").write_text("\n".join(edit(heading, lines)) + "\n")
    return folder


def replace_line(at, text):
    """An edit of heading 90 that puts `text` in place of line `at`, counted from 1, or drops it for None."""

    def edit(heading, lines):
        if heading != 90:
            return lines
        return [*lines[: at - 1], *([] if text is None else [text]), *lines[at:]]

    return edit


def refused(capsys, *arguments):
    """The one line on stderr with which magtwin refuses `arguments`, with exit status 1."""
    with pytest.raises(SystemExit) as stop:
        main([str(a) for a in arguments])
    captured = capsys.readouterr()
    assert stop.value.code == 1
    lines = [line for line in captured.err.splitlines() if not line.startswith("  ")]  # steps are indented
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("magtwin: ")
    return lines[0]


@pytest.mark.parametrize(
    ("options", "where", "what"),
    [
        ({"headings": (0, 90, 180)}, "survey", "270"),
        ({"edit": replace_line(3, "0.25,0.0,1.57")}, "90_map.csv:3", "4"),
        ({"edit": replace_line(3, "0.25,zero,1.57,41000")}, "90_map.csv:3", "zero"),
        ({"edit": replace_line(3, "0.25,0.0,1.57,nan")}, "90_map.csv:3", "nan"),
        ({"edit": replace_line(3, None)}, "90_map.csv", "0.25"),
        ({"edit": replace_line(3, "0.0,0.0,1.57,41001")}, "90_map.csv:3", "has a value already, on line 2"),
        ({"field": 41.0}, "survey", "uT"),
        ({"edit": lambda heading, lines: []}, "0_map.csv", "empty"),
    ],
    ids=["heading missing", "ragged", "not a number", "nan", "hole", "two values", "wrong unit", "empty"],
)
def test_a_broken_survey_is_refused_in_one_line_and_nothing_is_written(
    tmp_path, capsys, options, where, what
):
    folder = survey(tmp_path / "survey", **options)
    line = refused(capsys, "map", "import", folder, "--out", tmp_path / "map.usdc")
    assert where in line
    assert what in line
    assert sorted(p.name for p in tmp_path.iterdir()) == ["survey"]


def test_a_missing_survey_is_refused(tmp_path, capsys):
    line = refused(capsys, "map", "import", tmp_path / "nowhere", "--out", tmp_path / "map.usdc")
    assert "nowhere" in line
    assert list(tmp_path.iterdir()) == []


def test_a_survey_becomes_a_map_that_info_and_plot_show(tmp_path, capsys):
    folder = survey(tmp_path / "survey")
    layer, picture = tmp_path / "small.usdc", tmp_path / "small.png"
    main(["map", "import", str(folder), "--out", str(layer), "--licence", "CC0-1.0"])
    main(["map", "plot", str(layer), "--out", str(picture)])
    assert picture.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
    capsys.readouterr()
    main(["map", "info", str(layer), "--json"])
    assert "CC0-1.0" in capsys.readouterr().out
    assert "exists already; give --force" in refused(capsys, "map", "import", folder, "--out", layer)
    main(["map", "import", str(folder), "--out", str(layer), "--force"])


def test_a_path_that_leaves_the_floor_is_refused_before_anything_is_written(tmp_path, capsys, lab_scene):
    path = tmp_path / "path.csv"
    path.write_text("0,0\n1,0\n4.75,0\n")
    line = refused(capsys, "run", lab_scene, "--path", path, "--out", tmp_path / "out")
    assert "path" in line
    assert "4.75" in line
    assert sorted(p.name for p in tmp_path.iterdir()) == ["path.csv"]


def test_a_misspelt_path_is_refused_by_the_near_name(capsys, lab_scene, tmp_path):
    line = refused(capsys, "run", lab_scene, "--path", "figure9", "--out", tmp_path / "out")
    assert "did you mean 'figure8'" in line


def test_a_scene_file_with_a_misspelt_key_is_refused_by_the_near_name(tmp_path, capsys):
    from magtwin.files.file import shipped

    text = shipped("scenes", "lab.toml").read_text().replace("[lab]", "[labb]", 1)
    assert "[labb]" in text
    (tmp_path / "my.toml").write_text(text)
    line = refused(capsys, "scene", tmp_path / "my.toml", "--out", tmp_path / "out")
    assert "my.toml:" in line
    assert "did you mean 'lab'" in line
    assert sorted(p.name for p in tmp_path.iterdir()) == ["my.toml"]


def test_a_shipped_scene_is_found_beside_a_folder_of_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lab").mkdir()
    main(["scene", "lab", "--out", "out", "--json"])
    assert (tmp_path / "out" / "lab.usda").is_file()


def test_a_misspelt_scene_is_refused_by_the_near_name(tmp_path, capsys):
    assert "no scene 'labb'; did you mean 'lab'" in refused(
        capsys, "scene", "labb", "--out", tmp_path / "out"
    )


def test_a_checkpoint_with_foreign_types_is_refused_by_name_and_not_run(tmp_path, capsys):
    import pickle
    import zipfile

    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "executed"), "w"))

    with zipfile.ZipFile(tmp_path / "evil.pth", "w") as archive:
        archive.writestr("evil/data.pkl", pickle.dumps(Evil(), protocol=2))
        archive.writestr("evil/version", "3\n")
    line = refused(capsys, "network", "convert", tmp_path / "evil.pth", "--out", tmp_path / "out.safetensors")
    assert "evil.pth" in line
    assert "open" in line
    assert sorted(p.name for p in tmp_path.iterdir()) == ["evil.pth"]


def test_an_output_that_exists_is_refused_before_the_run(tmp_path, capsys, lab_scene):
    (tmp_path / "run.rrd").write_text("mine")
    line = refused(capsys, "run", lab_scene, "--out", tmp_path / "run.rrd")
    assert "run.rrd: exists already; give --force" in line
    assert (tmp_path / "run.rrd").read_text() == "mine"


def test_a_scene_whose_map_was_changed_is_refused(tmp_path, capsys, lab_scene):
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
    line = refused(capsys, "run", folder / lab_scene.name, "--out", tmp_path / "run.parquet")
    assert "</World/AnomalyMap>" in line
    assert "checksum" in line


def test_wrong_usage_exits_with_2(capsys):
    for arguments in (["rnu"], ["run"], ["run", "a.usda", "--sped", "1"], ["run", "a.usda", "--seed", "one"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2, arguments


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


def test_run_takes_the_kind_of_magnetometer(lab_scene, tmp_path, capsys):
    from magtwin.io.tables import read_parquet

    for options, kind in ((["--magnetometer", "map-only"], "map-only"), (["--network", "none"], "physical")):
        out = tmp_path / f"{kind}.parquet"
        main(["run", str(lab_scene), "--duration-s", "1", "--out", str(out), "--json", *options])
        run = read_parquet(out)
        assert run.metadata["magnetometer"] == kind
        assert (run["b_disturbance_nt"] == 0).all() == (kind == "map-only")
    capsys.readouterr()
    line = refused(
        capsys, "run", lab_scene, "--network", "none", "--magnetometer", "neural", "--duration-s", "1"
    )
    assert "a neural magnetometer without a network" in line


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


def test_links_that_form_a_circle_are_refused(tmp_path, capsys):
    (tmp_path / "loop").symlink_to("loop")
    loop = tmp_path / "loop"
    for words in (("convert", loop, "a.csv"), ("run", "lab", "--out", loop / "x.csv")):
        assert "links form a circle" in refused(capsys, *words)


def test_a_map_that_the_scene_reads_is_not_replaced_by_a_survey_of_it(lab_scene, capsys):
    layer = next(lab_scene.parent.glob("map/*.usdc"))
    before = layer.read_bytes()
    words = ("--spacing-m", "2", "--readings", "1", "--out", layer, "--force")
    assert "is a part of the scene" in refused(capsys, "map", "survey", lab_scene, *words)
    assert layer.read_bytes() == before


def test_a_variable_that_names_no_option_of_its_command_is_reported(tmp_path, monkeypatch, capsys, lab_scene):
    for name, value in {"RUN_SED": "1", "MAP_FIT_SEED": "1", "ALLOW_GB": "1", "RUN_OUT": "c.parquet"}.items():
        monkeypatch.setenv(f"MAGTWIN_{name}", value)
    monkeypatch.chdir(tmp_path)
    main(["run", str(lab_scene), "--duration-s", "1"])
    lines = [line for line in capsys.readouterr().err.splitlines() if "MAGTWIN" in line]
    said = "magtwin: warning: MAGTWIN_RUN_SED: magtwin run has no such option, it is ignored; did you mean "
    assert lines == [f"{said}MAGTWIN_RUN_SEED?"]
    monkeypatch.setenv("MAGTWIN_BENCH_REPORT_OUT", "x.html")
    refused(capsys, "bench", tmp_path / "none.toml", "--out", "b")
    assert "MAGTWIN" not in capsys.readouterr().err


def test_headings_that_are_given_twice_are_reported():
    with pytest.warns(RepairWarning, match="--headings-deg 0,360,90: 2 headings, as some are equal"):
        assert headings_rad("0,360,90") == pytest.approx([0, math.pi / 2])


def test_info_tells_of_stages_runs_and_networks(lab_scene, tmp_path, capsys):
    main(["run", str(lab_scene), "--duration-s", "2", "--out", str(tmp_path / "a.parquet")])
    capsys.readouterr()
    main(["info", str(lab_scene)])
    assert "MagtwinMagnetometerAPI" in capsys.readouterr().out
    main(["info", str(tmp_path / "a.parquet"), "--json"])
    assert json.loads(capsys.readouterr().out)["figures"]["duration"]["unit"] == "s"
    (tmp_path / "a.txt").touch()
    assert "unknown kind of file '.txt'" in refused(capsys, "info", tmp_path / "a.txt")


@pytest.mark.parametrize("seed", ["-1", "1.5"])
def test_a_seed_that_is_no_whole_number_from_0_up_is_refused(lab_scene, tmp_path, capsys, seed):
    with pytest.raises(SystemExit) as stop:
        main(["run", str(lab_scene), "--seed", seed, "--out", str(tmp_path / "a.parquet")])
    assert stop.value.code in (1, 2)
    assert "a whole number" in capsys.readouterr().err.replace("seed must be ", "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("net", "said"), [(".", "a folder; name the weights file in it"), ("gone.pth", "no such")]
)
def test_weights_that_are_no_file_are_refused(lab_scene, tmp_path, capsys, net, said):
    with pytest.raises(SystemExit):
        main(
            [
                "run",
                str(lab_scene),
                "--network",
                str(tmp_path / net),
                "--out",
                str(tmp_path / "a.parquet"),
            ]
        )
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_of_several_outputs_all_are_written_or_none(lab_scene, tmp_path, capsys):
    (tmp_path / "file").touch()
    arguments = ("run", lab_scene, "--duration-s", "1", "--out", tmp_path / "a.parquet")
    assert "cannot be written" in refused(capsys, *arguments, "--out", tmp_path / "file" / "a.rrd")
    assert "two outputs have one name" in refused(capsys, *arguments, "--out", tmp_path / "a.parquet")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


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
    assert done.stderr.startswith("magtwin: stdout cannot be written (No space left on device);")
    assert done.stderr.count("\n") == 1


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


def test_names_are_not_markup(lab_scene, tmp_path, capsys):
    import shutil

    folder = shutil.copytree(lab_scene.parent, tmp_path / "br[red]x[")
    main(["info", str(folder / lab_scene.name)])
    assert "br[red]x[" in "".join(capsys.readouterr().out.split())


def test_a_folder_is_not_put_in_place_of_a_file_nor_a_file_of_a_folder(lab_scene, tmp_path, capsys):
    (tmp_path / "a.png").mkdir()
    (tmp_path / "a.png" / "mine").touch()
    from magtwin.files.file import shipped

    layer = shipped("maps", "lab", "lab.usdc")
    assert "is a folder" in refused(capsys, "map", "plot", layer, "--out", tmp_path / "a.png", "--force")
    (tmp_path / "b").write_text("mine")
    assert "is a file" in refused(capsys, "scene", "lab", "--out", tmp_path / "b", "--force")
    assert (tmp_path / "a.png" / "mine").is_file()
    assert (tmp_path / "b").read_text() == "mine"


def test_the_working_folder_and_devices_are_not_replaced(tmp_path, monkeypatch, capsys, lab_scene):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert "working folder" in refused(capsys, "scene", "lab", "--out", ".", "--force")
    assert "working folder" in refused(capsys, "scene", "lab", "--out", "../here", "--force")
    os.mkfifo("pipe.parquet")
    line = refused(capsys, "run", lab_scene, "--duration-s", "1", "--out", "pipe.parquet", "--force")
    assert "a device or pipe" in line
    assert (tmp_path / "here").is_dir()


def test_a_working_folder_that_was_removed_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "here").rmdir()
    assert "the working folder was removed" in refused(capsys, "info", "run.parquet")
