"""`magtwin drive`."""

import os
import select
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magtwin.cli import options as opt
from magtwin.cli.app import app
from magtwin.cli.runs.run import SHOWN, save_picture
from magtwin.cli.terminal import Done, named, note, silence, step
from magtwin.errors import InputError

if TYPE_CHECKING:
    from magtwin.sim.motion.manual import Hand, Recorder

STATUS_HZ = 10.0
"""Rate of the line about pose and speed [Hz]."""


@app.command
def drive(
    scene: opt.Scene,
    *,
    out: opt.Folder = Path("drive"),
    lab: opt.Lab = "",
    map_layer: opt.MapLayer = None,
    gamepad: opt.Gamepad = None,
    network: opt.Network = None,
    seed: opt.Seed = 0,
    session: opt.Session = None,
    plant: opt.Plant = None,
    live: bool = True,
    force: opt.Force = False,
) -> Done:
    """Drive a scene's robot by hand, in real time, and write the run.

    The kinematic engine moves it from the scene's start. Keys: w/s or up/down for speed, a/d or left/right
    for turning, x to go straight on, space to stop, q to end. It writes run.rrd, run.parquet, run.png and
    commands.csv, which `magtwin run --path` drives again to the last bit.

    Parameters
    ----------
    live
        Show the drive in a Rerun viewer while it goes on, if a window can be opened.
    """
    import numpy as np

    from magtwin.files.file import existing
    from magtwin.files.kinds import scene_file
    from magtwin.files.outputs import output
    from magtwin.io.outputs import Outputs
    from magtwin.io.outputs import drive as drive_again
    from magtwin.sim.motion.closed_loop import Chassis
    from magtwin.sim.motion.commands import read_commands, write_commands
    from magtwin.sim.motion.drive import draw_wheel_errors
    from magtwin.sim.motion.follow import CONTROL_RATE_HZ, STAND, loop_by_commands
    from magtwin.sim.motion.manual import HELP, Gamepad, Keyboard, Recorder
    from magtwin.sim.runs.sensing import streams
    from magtwin.twin import in_session, open_twin, with_plant

    scene = scene_file(scene)
    if gamepad is not None and not gamepad.is_char_device():
        if existing(gamepad, "gamepad").is_dir():
            raise InputError(f"{gamepad}: a folder; name a gamepad in it, such as /dev/input/js0")
        raise InputError(f"{gamepad}: not a gamepad; name one, such as /dev/input/js0")
    out = named(out, force=force)
    with output(out, force=force) as folder:
        opened: Any = {"lab": lab, "map_layer": map_layer, "network": network}
        twin = in_session(with_plant(open_twin(scene, **opened), plant), session, seed=seed)
        robot, dt = twin.scene.robot, 1.0 / CONTROL_RATE_HZ
        errors = draw_wheel_errors(robot.drive, streams(np.random.default_rng(seed))["drive"])
        start: Any = {"start": twin.scene.start, "footprint_radius_m": robot.footprint_radius_m}
        loop = loop_by_commands(STAND, robot.drive, wheel_errors=errors, **start)
        chassis = Chassis(loop, twin.obstacles)
        hand: Hand = Keyboard(robot.drive) if gamepad is None else Gamepad(robot.drive)
        recorder = Recorder(chassis, hand, dt)
        with ExitStack() as stack:
            show = None
            if live:
                from magtwin.io.rerun.live import live_view

                try:
                    show = stack.enter_context(live_view(twin))
                except InputError as error:
                    note(f"no view: {error}")
            source = stack.enter_context(device(gamepad))
            note(f"{HELP if gamepad is None else 'left stick drives, Start ends'}\r")
            with silence():
                _drive(recorder, hand, source, dt, show)
        folder.mkdir()
        write_commands(recorder.commands("commands.csv"), folder / "commands.csv")
        opened |= {"seed": seed, "session": session, "plant": plant, "report": step, "tell": note}
        named_file = {"commands_file": "commands.csv"}
        driven = drive_again(scene, read_commands(folder / "commands.csv"), metadata=named_file, **opened)
        Outputs(folder, picture=save_picture).write(driven)
    again: list[object] = ["magtwin", "run", scene, "--path", out / "commands.csv", "--seed", seed]
    options = {"lab": lab or None, "map": map_layer, "session": session, "plant": plant}
    again += [word for name, value in options.items() if value is not None for word in (f"--{name}", value)]
    following = (("magtwin", "view", out / "run.rrd"), again)
    told = driven.run.report(f"Manual drive in {scene.stem}")
    return Done(told, out, SHOWN, rest=f"magtwin info {out}", next=following)


def _drive(recorder: "Recorder", hand: "Hand", device: int, dt: float, show: object) -> None:
    """Drive in real time until the hand is done; a slow machine drives in slow motion."""
    due, step, told = time.monotonic(), 0, ""
    try:
        while not hand.done:
            due = max(due + dt, time.monotonic())
            while (left := due - time.monotonic()) > 0 and not hand.done:
                if select.select([device], [], [], left)[0]:
                    hand.feed(os.read(device, 1024))
            recorder.step()
            chassis = recorder.chassis
            if callable(show):
                show(chassis.t, chassis.pose)
            if step % round(1 / dt / STATUS_HZ) == 0 and sys.stderr.isatty():
                x, y, yaw = chassis.pose
                v, w = hand.command
                told = f"  {chassis.t:6.1f} s  at {x:+.2f} {y:+.2f} m  yaw {yaw:+.2f}  v {v:+.2f}  w {w:+.2f}"
                print(f"\r{told}{'  BUMP' if chassis.bump else '      '}", end="", file=sys.stderr)  # noqa: T201
            step += 1
    except KeyboardInterrupt:
        pass  # an end like any other: what was driven is kept
    if told:
        print("\r", file=sys.stderr)  # noqa: T201


@contextmanager
def device(gamepad: Path | None) -> Iterator[int]:
    """A gamepad, or the terminal with its keys one by one; the terminal is restored at the end."""
    if find_spec("termios") is None:
        raise InputError(
            "keys and gamepads are read on Linux and macOS only; give commands as a table of t, v and w: "
            "magtwin run SCENE --path commands.csv"
        )
    if gamepad is not None:
        try:
            pad = os.open(gamepad, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise InputError(f"{gamepad}: cannot be read ({error.strerror}); name a gamepad") from error
        try:
            yield pad
        finally:
            os.close(pad)
        return
    keys = sys.stdin.fileno()
    if not os.isatty(keys):
        yield keys  # keys from a pipe
        return
    import termios
    import tty

    before = termios.tcgetattr(keys)
    try:
        tty.setcbreak(keys)
        yield keys
    finally:
        with suppress(termios.error):
            termios.tcsetattr(keys, termios.TCSADRAIN, before)
