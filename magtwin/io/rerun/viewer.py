"""Viewer: the Rerun viewer of the installed wheel, in a window or, for pictures, without one.

It is not started by `rerun.spawn`, which listens on every network interface.
"""

import os
import re
import signal
import socket
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import rerun_cli  # type: ignore[import-untyped]
from rerun.experimental import Timeline, View, ViewerClient

from magtwin.errors import InputError
from magtwin.files.budget import BUDGETS, check_decoded, check_size
from magtwin.files.children import LATE, own_home, run
from magtwin.files.file import existing
from magtwin.files.outputs import output
from magtwin.files.protobuf import fields
from magtwin.io.rerun.series import TIMELINE
from magtwin.parallel.machine import end_group, ends_with_parent

LOCALHOST = "127.0.0.1"

MAGIC = b"RRF"  # First bytes of a recording, before its format number
HEADER, ARROW = 12, 2  # Bytes before the first message, and the kind of messages that hold chunks
LEAST_SIZE, MOST_SIZE = 200, 8000  # Sides of a picture: room for the views, limit of a texture [pixels]
PATIENCE_S = 600.0  # Time that a living viewer may take for a step, without a graphics card [s]
LATE_S = 5.0  # Time after which no answer is a late one: Rerun's client waits for 15 s [s]
FRAMES = 20  # Frames after which a loaded file shows something, and notices are gone

CANNOT_DRAW = re.compile(r"render context|adapter|graphics|wgpu|surface", re.IGNORECASE)
VULKAN = "without a graphics card it needs Vulkan in software: apt install mesa-vulkan-drivers libvulkan1"
"""Words of a viewer that ended because it cannot draw, and what to do then."""

TITLE_BAR = 36  # Height of the viewer's empty title bar [pixels]
TOASTS_S, NOTHING_S = 6.0, 10.0  # Times until the viewer's notices are gone, and a file shows something [s]


def show(rrd: str | os.PathLike[str], *, source: str | os.PathLike[str] | None = None) -> None:
    """Show a recording in a window; returns when the window is closed.

    Errors name `source`, if `rrd` is a temporary recording of it. They tell why the viewer cannot run here.
    """
    rrd = existing(rrd, "recording")
    command = [_binary(), "--bind", LOCALHOST, "--port", "auto", str(rrd)]
    options: dict[str, Any] = {"capture_output": False, "stderr": subprocess.PIPE}
    result = run(command, preexec_fn=ends_with_parent(), **options)
    if result.returncode:
        advice = f"magtwin report {source or rrd} --out run.html makes a page of it"
        if source is None:
            advice += f"; or in a browser: rerun --web-viewer --bind {LOCALHOST} {rrd}"
        reason = _reason(result.stderr)
        text = f"the Rerun viewer opened no window: {reason}; without a display, {advice}"
        raise InputError(f"{source or rrd}: {text}")


def screenshot(
    rrd: str | os.PathLike[str],
    png: str | os.PathLike[str],
    *,
    time_s: float | None = None,
    size: tuple[int, int] = (1600, 1000),
    force: bool = False,
) -> list[str]:
    """Draw a recording as the viewer shows it, with or without a display.

    `time_s` is on the timeline `sim_time` [s], by default where the viewer starts; `size` is that of the
    picture [pixels]. Returns the warnings and errors of the recording's views, one line each. Refused are a
    recording that cannot be read or has no such moment, a size out of range, and a machine without Vulkan.
    """
    path = existing(rrd, "recording")
    if not (min(size) >= LEAST_SIZE and max(size) <= MOST_SIZE):
        limits = f"{LEAST_SIZE}..{MOST_SIZE} pixels each way"
        raise InputError(f"size of a recording's picture must lie in {limits}, got {size[0]} x {size[1]}")
    check_decodes(path)
    window = (size[0], size[1] + TITLE_BAR)
    with output(png, force=force) as aside, live_viewer(headless=True, size=window) as (_, client):
        views = _draw(client, path.resolve(), rrd, aside, time_s)
    lines = [f"{v.name}: {r.severity}: {r.summary} {r.details or ''}" for v in views for r in v.reports]
    return [line.strip() for line in lines]


def _draw(
    client: ViewerClient, path: Path, source: str | os.PathLike[str], png: Path, time_s: float | None
) -> list[View]:
    """Open a recording, go to a time and save the picture; returns the state of the views."""
    from matplotlib.image import imread, imsave

    client.open(str(path))
    _wait_until(lambda: not client.get_state().loading, f"{source}: the viewer did not load it")
    _show_frames(client, NOTHING_S, lambda: _timelines(client) != [])
    if not (timelines := _timelines(client)):
        text = "holds nothing that the viewer shows; if the recording was cut short, write it again"
        raise InputError(f"{source}: {text}")
    if time_s is not None:
        line = next((timeline for timeline in timelines if timeline.name == TIMELINE), None)
        if line is None or line.start is None or line.end is None:
            names = ", ".join(timeline.name for timeline in timelines)
            raise InputError(f"{source}: has no timeline {TIMELINE!r} to find a time on; it has {names}")
        first, last = line.start / 1e9, line.end / 1e9
        if not first <= time_s <= last:
            span = f"the recording goes from {first:g} to {last:g} s"
            raise InputError(f"{source}: {span}; there is no {time_s:g} s in it")
        client.set_time(TIMELINE, duration=time_s, play_state="paused")
    client.run_command("ui.toggle_top_panel")
    _show_frames(client, TOASTS_S)
    client.save_screenshot(str(png))
    picture = imread(png)[TITLE_BAR:]
    imsave(png, picture, metadata={"Software": "magtwin"}, pil_kwargs={"optimize": True})
    return client.get_state().views


@contextmanager
def live_viewer(
    *, headless: bool = False, size: tuple[int, int] = (1600, 1000)
) -> Iterator[tuple[str, ViewerClient]]:
    """A viewer that listens on localhost only, ended with the block: its address, and a client.

    A `headless` one has no window, and only draws pictures of a size [pixels]. If it cannot run here, the
    error tells its reason.
    """
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        port = int(probe.getsockname()[1])
    window = ["--headless", "--window-size", f"{size[0]}x{size[1]}"] if headless else []
    command = [_binary(), "--bind", LOCALHOST, "--port", str(port), "--hide-welcome-screen", *window]
    process = None
    with own_home() as environment, tempfile.TemporaryFile("w+") as log:
        options: dict[str, Any] = {"start_new_session": True, "preexec_fn": ends_with_parent()}
        options |= {"stdout": log, "stderr": log, "env": environment}
        try:
            with _interrupt_later() as interrupts:
                process = subprocess.Popen(command, **options)
                client = _connected(process, port, log, interrupts, draws=headless)
            assert client is not None  # else the interrupt was raised
            patient = cast(ViewerClient, _Patient(client, process))
            yield f"rerun+http://{LOCALHOST}:{port}/proxy", patient
        except (ConnectionError, RuntimeError) as error:
            if process is not None and _ended(process):
                raise _ending(process, log) from error
            raise
        finally:
            if process is not None:
                _end(process)


class _Patient:
    """A client that asks again when an answer is late, as long as its viewer lives."""

    def __init__(self, client: ViewerClient, process: "subprocess.Popen[bytes]") -> None:
        self._client, self._process = client, process

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            last = time.monotonic() + PATIENCE_S
            while True:
                began = time.monotonic()
                try:
                    return getattr(self._client, name)(*args, **options)
                except (ConnectionError, RuntimeError, TimeoutError):
                    now = time.monotonic()
                    if now - began < LATE_S or now > last or self._process.poll() is not None:
                        raise
                if name == "run_command":  # it was taken; once more could undo it
                    return self.get_state()

        return call


@contextmanager
def _interrupt_later() -> Iterator[list[int]]:
    """Delay Ctrl-C to the end of the block and collect it in a list.

    So the handle of a started process is not lost, and Rerun cannot turn the interrupt into another error.
    """
    interrupts: list[int] = []
    if threading.current_thread() is not threading.main_thread():  # Python interrupts the main thread only
        yield interrupts
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: interrupts.append(number))
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupts:
        signal.raise_signal(signal.SIGINT)


def _connected(
    process: "subprocess.Popen[bytes]", port: int, log: IO[str], interrupts: list[int], *, draws: bool
) -> ViewerClient | None:
    """A client of a started viewer, once it answers, or has drawn; None if the user interrupted."""
    clients: list[ViewerClient] = []

    def ready() -> bool:
        if process.poll() is not None:
            raise _ending(process, log)
        try:
            clients.append(ViewerClient.connect(f"rerun+http://{LOCALHOST}:{port}/proxy"))
            clients[-1].get_state()
            if draws:
                clients[-1].take_screenshot(max_size=64)
        except (ConnectionError, RuntimeError):
            return False
        return True

    _wait_until(lambda: bool(interrupts) or ready(), "the Rerun viewer did not start")
    return None if interrupts else clients[-1]


def _ended(process: "subprocess.Popen[bytes]") -> bool:
    """Whether a viewer that no longer answers has ended in an error; it needs time to write why."""
    try:
        return process.wait(PATIENCE_S / 10) != 0
    except subprocess.TimeoutExpired:
        return False


def _ending(process: "subprocess.Popen[bytes]", log: IO[str]) -> InputError:
    """The error for a viewer that has ended, with the reason in its log."""
    log.seek(0)
    reason = _reason(log.read())
    if process.returncode == -9:  # SIGKILL, which Windows lacks
        reason = "it was killed from outside; if memory ran out, give a smaller `size`"
    if CANNOT_DRAW.search(reason):
        return InputError(f"the Rerun viewer cannot draw here: {reason}; {VULKAN}")
    return InputError(f"the Rerun viewer ended: {reason}")


def check_decodes(rrd: Path) -> None:
    """Refuse a recording that Rerun's own verifier cannot decode.

    The verifier is a separate process, as changed bytes may make Rerun's decoder end its process. A missing
    end is accepted: a recording that still grows has none.
    """
    if rrd.is_dir():
        raise InputError(f"{rrd}: a folder; name the .rrd file in it")
    check_size(rrd, "rrd")
    no_recording = f"{rrd}: not a Rerun recording that can be read"
    with rrd.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InputError(f"{no_recording} (it does not start with RRF); write it again")
        _check_decoded(rrd, file)
    command = [_binary(), "rrd", "verify", str(rrd)]
    patience = BUDGETS["rrd"].seconds + rrd.stat().st_size / 1e6
    done = run(command, limit_s=patience)
    if done.returncode == LATE:
        raise InputError(f"{rrd}: Rerun does not decode it in {patience:.0f} s; write it again")
    lines = [line for line in done.stderr.splitlines() if "Missing RRD footer" not in line and line.strip()]
    endless = done.returncode == 1 and [line.rpartition(" with ")[2] for line in lines] == ["1 errors"]
    if done.returncode and not endless:
        raise InputError(f"{no_recording} ({_reason(done.stderr)}); write it again")


def _check_decoded(rrd: Path, file: BinaryIO) -> None:
    """Refuse a recording whose messages, decompressed, are over the budget, by the sizes that they state.

    A message is kind, length and content; that of a chunk is protobuf (`ArrowMsg` of Rerun's
    log_msg/v1alpha1/log_msg.proto), with the uncompressed size as field 3. LZ4 decodes no more than that.
    """
    size, decoded, at = rrd.stat().st_size, 0, HEADER
    while at + 16 <= size:
        file.seek(at)
        kind, length = struct.unpack("<QQ", file.read(16))
        if kind == ARROW:
            try:
                message = file.read(min(length, size))
                decoded += max((value for field, value, _, _ in fields(message) if field == 3), default=0)
            except ValueError as error:
                raise InputError(f"{rrd}: damaged recording ({error}); write it again") from error
            check_decoded(rrd, size, decoded)
        at += 16 + length


def _binary() -> str:
    """Path of the viewer's program."""
    name = "rerun.exe" if os.name == "nt" else "rerun"
    return str(existing(Path(rerun_cli.__file__).with_name(name), "Rerun viewer; install rerun-sdk again"))


def _timelines(client: ViewerClient) -> list[Timeline]:
    """The timelines of the recordings in a viewer."""
    return [line for recording in client.get_state().recordings for line in recording.timelines]


def _wait_until(done: Callable[[], bool], refusal: str) -> None:
    """Wait for a condition of a viewer that lives; raise an error after a long time."""
    last = time.monotonic() + PATIENCE_S
    while not done():
        if time.monotonic() > last:
            raise InputError(f"{refusal} (waited {PATIENCE_S:g} s)")
        time.sleep(0.1)


def _show_frames(client: ViewerClient, least_s: float, done: Callable[[], bool] = lambda: False) -> None:
    """Let the viewer draw until `done`, or for a time and `FRAMES`; its clock advances while it draws."""
    first, frames = time.monotonic(), 0
    while not done() and (frames < FRAMES or time.monotonic() < first + least_s):
        client.take_screenshot(max_size=64)
        frames += 1


def _reason(log: str) -> str:
    """Why a program ended, by its log: its panic, its error, or else its last line."""
    match = re.search(r"panicked at '(.+?)'|^Error: (.+)$", log, re.MULTILINE)
    lines = [line.strip() for line in log.splitlines() if line.strip()] or ["it gave no reason"]
    text = next(group for group in match.groups() if group) if match else lines[-1]
    return re.sub(r"\S+ at /\S+ ", "", text).rstrip(".")  # without file names of the viewer's source


def _end(process: "subprocess.Popen[bytes]") -> None:
    """End a process and its children."""
    if process.poll() is None:
        end_group(process.pid, ask=True)
        try:
            process.wait(5)
        except subprocess.TimeoutExpired:
            end_group(process.pid)
            process.wait()
