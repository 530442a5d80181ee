"""Refusals of the command line: one line that names what is wrong and what to do, before any work begins."""

import os
import shlex

import numpy as np
import pytest

HUGE = "1000000000000"
LONG, BYTES = "n" * 300, os.fsdecode(b"b\xff\xfe")
MANY = ",".join(map(str, np.arange(0, 360, 0.1)))

REFUSALS = [
    # names of files
    (f"new {LONG}.toml", "305 characters is too long"),
    (f"convert run.npz {LONG}.csv", "too long for a file; shorten it"),
    (f"run {LONG}", "too long for a file; shorten it"),
    (f"info {LONG}.usda", "File name too long"),
    (f"new {BYTES}.toml", "its name is not UTF-8"),
    (f"convert run.npz {BYTES}.parquet", "its name is not UTF-8"),
    ("convert loop a.csv", "links form a circle"),
    ("run lab --out loop/x.csv", "links form a circle"),
    ("info a.txt", "a.txt: empty; expected one row of numbers per reading"),
    ("map import nowhere --out new.usdc", "nowhere: no such"),
    ("drive lab --gamepad js0 --out new", "no such gamepad"),
    ("drive lab --gamepad room --out new", "room: a folder; name a gamepad in it"),
    ("run lab --network room --out new", "a folder; name the weights file in it"),
    ("run lab --network gone.pth --out new", "no such"),
    # outputs
    ("convert run.npz page.html/new.csv", "page.html/new.csv: cannot be written"),
    ("robot robot.urdf --out new.usdc", "a robot is a folder, or one file .usda; give new, or new.usda"),
    ("run lab --out new.json", "new.json: a released package is read, not written"),
    ("convert run.npz new.json", "is read, not written"),
    ("run lab --out new.txt", "unknown format of a run"),
    ("run lab --duration-s 1 --out new.rrd --out page.html/a.rrd", "cannot be written"),
    ("run lab --duration-s 1 --out new.rrd --out page.html/a.usd", "cannot be written"),
    ("run lab --out new.rrd --out new.rrd", "two outputs have one name"),
    ("run lab --duration-s 1 --out pipe.parquet --force", "a device or pipe"),
    ("scene lab --out . --force", "working folder"),
    ("scene lab --out ../here --force", "working folder"),
    ("scene lab --out page.html --force", "is a file"),
    ("plot map.usdc --out taken.png --force", "is a folder"),
    ("map fit gone.csv --out new.csv", "new.csv: a map layer ends in .usdc or .usd or .usda"),
    ("train drives --out new.safetensors", "build one"),
    # what is in files
    ("run empty.toml", "empty"),
    ("run room.toml", "author it first: magtwin scene"),
    ("scene key.toml --out new", "key.toml:", "did you mean 'lab'"),
    ("scene labb --out new", "no scene 'labb'; did you mean 'lab'"),
    ("scene lab --map room/room.usda --out new", "is no map layer"),
    ("model convert evil.pth --out new.safetensors", "evil.pth", "open"),
    ("run lab --path far.csv --out new", "path", "4.75"),
    # options
    ("run lab --path figure9 --out new", "did you mean 'figure8'"),
    ("sweep lab --path figure9 --out new", "did you mean 'figure8'"),
    ("run lab --network none --magnetometer neural", "a neural magnetometer without a network"),
    ("run lab --seed -1 --out new", "seed", "a whole number"),
    ("run lab --seed 1.5 --out new", "--seed", "a whole number"),
    ("run lab --duration-s nan --out new", "--duration-s must be above 0 s and finite"),
    ("run lab --duration-s 1e12 --out new", "or --duration-s to"),
    ("run lab --duration-s 2 --speed 1e300 --out new", "--speed must be above 0 m/s and at most"),
    ("run lab --plant all:nan --out new", "plant"),
    ("RUN_RATE_HZ=nan run lab --out new", "[run] rate_hz of the magnetometer must be above 0"),
    ("RUN_PACE=1e-300 run lab --live --out new", "[run] pace must be at least 0.001"),
    ("RUN_LIDAR=of run lab --out new", "MAGTWIN_RUN_LIDAR"),
    ("sweep lab --count 0 --out new", "--count must be a whole number from 1 up"),
    ("sweep lab --count 1e12 --out new", "a whole number is wanted, got '1e12'"),
    (f"sweep lab --count {HUGE} --out new", "at most 1,000,000"),
    ("sweep lab --sessions 0 --out new", "--sessions must be a whole number from 1 up"),
    ("sweep lab --seed -1 --out new", "--seed must be a whole number from 0 up"),
    ("sweep lab --jobs 0 --out new", "--jobs must be a whole number from 1 up, got 0"),
    ("sweep lab --rate-hz 1e300 --out new", "lower --rate-hz to"),
    ("sweep lab --duration-s nan --out new", "--duration-s must be above 0 s and finite, got nan"),
    ("SWEEP_KEEP=yaww sweep lab --duration-s 1 --count 1 --out new", "did you mean 'yaw'"),
    ("SWEEP_SPEED=0 sweep lab --out new", "[sweep] speed must be above 0"),
    ("plot map.usdc --camera top --size 1000000x1000000 --out new.png", "must lie in 16..16384 pixels"),
    ("plot run.npz --at 1 --size nanx1 --out new.png", "--size is WIDTHxHEIGHT in pixels"),
    ("plot run.npz --size 1x --out new.gif", "--size is WIDTHxHEIGHT"),
    ("map fit points.csv --spacing-m 1e300 --out new.usdc", "--spacing-m 1e+300 leaves no cell"),
    ("map fit points.csv --spacing-m inf --out new.usdc", "--spacing-m must be above 0 m, got inf"),
    (f"map fit points.csv --headings-deg {MANY} --out new.usdc", "--headings-deg names 3,600"),
    (f"map survey lab --readings {HUGE} --out new.usdc", "--readings must be at least 1 and at most 100,000"),
    ("map survey lab --heading-error-deg 1e300 --out new.usdc", "--heading-error-deg must be from 0 to 90"),
    ("map survey lab --spacing-m 0 --out new.usdc", "--spacing-m must be above 0 m"),
    ("map survey lab --spacing-m 9 --out new.usdc", "--spacing-m 9 leaves no cell on 6 x 3.5 m"),
    ("map survey lab --headings-deg north --out new.usdc", "headings are degrees with commas between"),
    ("map survey lab --seed -1 --out new.usdc", "seed must be a whole number from 0 up"),
    ("map survey lab --height-m nan --out new.usdc", "--height-m must be a height above the floor"),
    ("map survey lab --position-error-m -1 --out new.usdc", "--position-error-m must not be below 0"),
    ("map survey lab --out new.csv", "ends in .usdc"),
    ("new random.py", "random"),
    ("new my-filter.py", "my-filter"),
    ("localize run.npz --map lab --rate-hz nan --out new", "--rate-hz must be above 0 Hz, got nan"),
    ("localize run.npz --map lab --seed -1 --out new", "--seed must be a whole number from 0 up"),
    ("localize run.npz --map lab --sensor iron_nt=1e300 --out new", "--sensor iron_nt", "must be finite"),
    ("dataset build run.npz --map lab --latency-s 1e300 --out new", "--latency-s must be within 60 s"),
    ("ros sim lab --duration-s 1e300", "--duration-s is at most 1e+08 s"),
    ("ros sim lab --pace 1e-300", "--pace must be at least 0.001"),
    # flags that have moved
    ("run lab --lidar on", "`lidar = ...` below [run] in magtwin.toml, or set MAGTWIN_RUN_LIDAR"),
    ("run lab --no-model-error", "MAGTWIN_RUN_MODEL_ERROR"),
    ("sweep lab --keep yaw", "MAGTWIN_SWEEP_KEEP"),
    ("sweep lab --session survey", "--session is now --sessions survey"),
    ("run lab --commands=c.csv", "--commands is now --path FILE"),
    ("run lab --replay r.npz", "--replay is now --path FILE"),
]
"""Commands, with settings of the environment before them, and words of their refusals."""


@pytest.mark.parametrize(("command", "words"), [(c, w) for c, *w in REFUSALS], ids=lambda x: str(x)[:50])
def test_a_command_is_refused_in_one_line_and_leaves_nothing(command, words, odd, refusal, monkeypatch):
    monkeypatch.chdir(odd)
    arguments = shlex.split(command)
    while arguments[0].isupper() or "=" in arguments[0]:
        name, _, value = arguments.pop(0).partition("=")
        monkeypatch.setenv(f"MAGTWIN_{name}", value)
    before = sorted(os.listdir())
    line = refusal(*arguments)
    assert all(word in line for word in words), line
    assert ".new" not in line  # the place aside is no concern of the user's
    assert sorted(os.listdir()) == before
