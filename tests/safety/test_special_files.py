"""Pipes, devices, sockets and circles of links are refused at once, by every command that takes a file."""

import os
import socket
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files.file import existing, existing_file, read_text, sha256

COMMANDS = (
    "info F.npz",
    "info F.parquet",
    "info F.csv",
    "info F.rrd",
    "info F.mcap",
    "info F.db3",
    "info F.json",
    "info F.usda",
    "info F.usdz",
    "info F.safetensors",
    "info F.pth",
    "info F.onnx",
    "convert F.parquet --out o.csv",
    "compare F.npz F.csv",
    "reproduce F.parquet",
    "report F.parquet --out o.html",
    "localize F.parquet --map F.usdc --out o.parquet",
    "plot F.parquet --out o.gif",
    "plot F.usda --out o.png",
    "view F.rrd",
    "run F.usda --out o",
    "run lab --path F.csv --out o",
    "run lab --network F.safetensors --out o",
    "sweep F.usda --out o",
    "scene F.toml --out o",
    "robot F.urdf --out o",
    "robot F.xacro --out o",
    "robot F.usda --out o.urdf",
    "export F.usda --out o",
    "validate F.usda",
    "map fit F.csv --out o.usdc",
    "plot F.usdc --out o.png",
    "map validate F.usdc",
    "dataset build F.parquet --map F.usdc --out o",
    "train F --out o.safetensors",
    "evaluate F.safetensors --runs F.parquet --map F.usdc --out o",
    "model calibrate F.safetensors F.parquet --map F.usdc --out o.safetensors",
    "model compensate fit F.parquet --out o.json",
    "model export F.safetensors --out o.onnx",
    "bench F.toml --out o",
)


@pytest.mark.parametrize("command", COMMANDS)
def test_no_command_waits_for_a_pipe(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    words = command.split()
    for name in {word for word in words if word.partition(".")[0] == "F"}:
        os.mkfifo(name)
    # Whoever opens a pipe to read it waits for a writer: one that comes after 60 s ends a test that fails.
    late = threading.Timer(60, lambda: [os.close(os.open(p, os.O_RDWR)) for p in tmp_path.glob("F*")])
    late.start()
    with suppress(SystemExit):
        main(words)
    assert not late.finished.is_set(), "waited for the pipe"
    late.cancel()
    error = capsys.readouterr().err
    assert "a fault in magtwin" not in error
    assert "a pipe" in error


@pytest.mark.parametrize("make", ["pipe", "socket", "device", "circle"])
def test_special_files_are_refused_in_one_line(make, tmp_path, monkeypatch):
    path = tmp_path / "f.csv"
    held = socket.socket(socket.AF_UNIX)
    if make == "pipe":
        os.mkfifo(path)
    elif make == "socket":
        monkeypatch.chdir(tmp_path)  # names of sockets are short
        held.bind("f.csv")
    elif make == "device":
        path = Path("/dev/zero")
    else:
        path.symlink_to(tmp_path / "g.csv")
        (tmp_path / "g.csv").symlink_to(path)
    words = {"circle": "its links form a circle"}.get(make, f"a {make}, not a ")
    for read in (
        lambda p: existing(p, "path file"),
        lambda p: existing_file(p, "path file", "text"),
        lambda p: read_text(p, "path file", "text"),
        sha256,
    ):
        with pytest.raises(InputError, match=words) as refusal:
            read(path)
        assert "\n" not in str(refusal.value)
    held.close()


@pytest.mark.parametrize("name", ["a\0b", "n" * 300, "no/such/folder.csv", "f.csv/below"])
def test_names_that_no_file_can_have_are_refused(name, tmp_path):
    (tmp_path / "f.csv").touch()
    with pytest.raises(InputError):
        existing(tmp_path / name, "path file")


def test_a_pipe_as_a_layer_or_as_a_part_of_a_run_is_refused(tmp_path):
    from magtwin.usd.layers import open_stage

    os.mkfifo(tmp_path / "below.usda")
    (tmp_path / "stage.usda").write_text('#usda 1.0\n(subLayers = [@./below.usda@])\ndef "World" {}\n')
    with pytest.raises(InputError, match=r"names .*below\.usda, which is no regular file"):
        open_stage(tmp_path / "stage.usda")
    from magtwin.io.tables import read_parquet
    from magtwin.tables.parquet import load_parquet

    os.mkfifo(tmp_path / "part-000000.parquet")
    for read, path in ((read_parquet, tmp_path), (load_parquet, tmp_path / "part-000000.parquet")):
        with pytest.raises(InputError, match="a pipe, not a Parquet file"):
            read(path)
