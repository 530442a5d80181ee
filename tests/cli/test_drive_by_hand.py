"""Manual driving: keys and sticks as commands, a terminal left as it was, a drive that is repeated."""

import os
import pty
import struct
import subprocess
import sys
import termios
import time

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from waiting import PATIENCE_S, wait_until

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.io.rerun.live import streamed
from magtwin.io.rerun.viewer import live_viewer
from magtwin.io.tables import read_parquet
from magtwin.sim.motion.closed_loop import Chassis
from magtwin.sim.motion.commands import read_commands
from magtwin.sim.motion.follow import STAND, loop_by_commands, play
from magtwin.sim.motion.manual import Gamepad, Keyboard, Recorder
from magtwin.spec.drive import DriveSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.twin import open_twin

DRIVE = DriveSpec()


def test_keys_change_speeds_by_steps_within_the_drives_limits():
    keys = Keyboard(DRIVE)
    keys.feed(b"ww\x1b[A\x1b[Dz")
    assert_allclose(keys.command, (0.15, 0.25))
    keys.feed(b"\x1b")  # an arrow that comes in two pieces
    keys.feed(b"[Cx")
    assert_allclose(keys.command, (0.15, 0.0))
    keys.feed(b"w" * 50 + b"d" * 50)
    assert keys.command == (DRIVE.v_max, -DRIVE.w_max)
    keys.feed(b" ")
    assert keys.command == (0.0, 0.0)
    assert not keys.done
    keys.feed(b"sq")
    assert keys.command == (0.0, 0.0)
    assert keys.done


def test_a_line_that_closes_ends_the_drive():
    for hand in (Keyboard(DRIVE), Gamepad(DRIVE)):
        hand.feed(b"")
        assert hand.done


def test_a_stick_drives_in_proportion_and_start_ends():
    pad = Gamepad(DRIVE)
    events = [(0, 0, 0x82, 1), (1, -32767, 2, 1), (2, 16384, 2, 0), (3, 1, 1, 0), (4, 1000, 2, 3)]
    data = b"".join(struct.pack("<IhBB", *event) for event in events)
    pad.feed(data[:11])  # events that come in pieces
    pad.feed(data[11:])
    assert_allclose(pad.command, (DRIVE.v_max, -DRIVE.w_max / 2), rtol=1e-4)
    pad.feed(struct.pack("<IhBB", 5, 1000, 2, 1))
    assert pad.command[0] == 0.0  # a stick let go is not quite at rest
    pad.feed(struct.pack("<IhBB", 6, 1, 1, 7))
    assert pad.done
    assert pad.command == (0.0, 0.0)


def test_commands_of_a_manual_drive_drive_it_again_to_the_last_bit():
    keys, errors = Keyboard(DRIVE), (0.002, -0.003)
    wall = Obstacles(("wall",), (np.array([[0.5, -1], [0.6, -1], [0.6, 1], [0.5, 1]]),))
    start = {"start": (0.1, 0.0, 0.3), "footprint_radius_m": 0.171, "wheel_errors": errors}
    chassis = Chassis(loop_by_commands(STAND, DRIVE, **start), wall)
    recorder, poses, bumps = Recorder(chassis, keys, 0.02), [chassis.pose], []
    for k in range(400):
        if k % 10 == 0:
            keys.feed(np.random.default_rng(k).choice([b"w", b"w", b"a", b"d", b"x"]))
        recorder.step()
        poses.append(chassis.pose)
        bumps.append(chassis.bump)
    again = play(recorder.commands("c.csv").rows, DRIVE, obstacles=wall, **start)
    assert any(bumps)
    assert_array_equal(again.poses[: len(poses)], poses)
    assert again.v[-1] == 0.0


def test_a_drive_at_a_terminal_that_ctrl_c_ends_is_recorded_and_leaves_it_as_it_was(tmp_path, lab_scene):
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    command = [sys.executable, "-m", "magtwin", "drive", str(lab_scene), "--out", str(tmp_path / "d")]
    process = subprocess.Popen(
        [*command, "--network", "none", "--no-live", "--json"],
        stdin=theirs,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: (os.setsid(), __import__("fcntl").ioctl(0, termios.TIOCSCTTY, 0)),
    )
    said = b""
    while b"space: stop" not in said:
        said += process.stderr.read1(1024)
    assert not termios.tcgetattr(theirs)[3] & termios.ICANON  # keys come one by one
    for key in (b"w", b"w", b"\x1b[D", b"\x03"):
        os.write(ours, key)
        time.sleep(0.4)  # the loop reads one key after the other also on a busy machine
    _, error = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, error
    assert termios.tcgetattr(theirs) == before
    os.close(ours)
    os.close(theirs)
    run = read_parquet(tmp_path / "d" / "run.parquet")
    assert run["p_world_base"][-1, 0] > 0.01
    assert np.abs(run["w_cmd"]).max() == 0.25
    commands, parquet = tmp_path / "d" / "commands.csv", tmp_path / "again.parquet"
    options = ["--network", "none", "--json", "--path", str(commands), "--out", str(parquet)]
    main(["run", str(lab_scene), *options])
    again = read_parquet(tmp_path / "again.parquet")
    for name in run:
        assert_array_equal(again[name], run[name], err_msg=name)
    assert read_commands(tmp_path / "d" / "commands.csv").rows[-1, 1] == 0.0


def _drawn(client):
    """Let a viewer draw; whether it shows something."""
    client.take_screenshot(max_size=64)
    return any(r.timelines for r in client.get_state().recordings)


def test_a_viewer_that_listens_shows_the_drive_while_it_goes_on(lab_scene):
    twin = open_twin(lab_scene, network="none")
    try:
        with live_viewer(headless=True) as (address, client), streamed(twin, address) as show:
            for k in range(20):
                show(k / 50, (k / 100, 0.0, 0.0))
            wait_until(lambda: _drawn(client))
            state = client.get_state()
            assert [timeline.name for r in state.recordings for timeline in r.timelines if r.timelines]
            assert [report for seen in state.views for report in seen.reports] == []
    except InputError as error:
        if "cannot draw here" not in str(error):
            raise
        pytest.skip(str(error))
