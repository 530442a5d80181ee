"""Viewer: the Rerun viewer that comes with its wheel, on a window or, for pictures, on none.

It is started here rather than through `rerun.spawn`, which listens on every network interface.
"""

import os
import re
import signal
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import rerun_cli  # type: ignore[import-untyped]
from rerun.experimental import Timeline, View, ViewerClient

from magtwin.errors import InputError
from magtwin.files import existing, output
from magtwin.io.rerun.series import TIMELINE

LOCALHOST = "127.0.0.1"

MAGIC = b"RRF"
"""First bytes of a recording, before the number of its format."""

LEAST_SIZE, MOST_SIZE = 200, 8000
"""Sides of a picture between which the viewer still lays out its views, and fits in a texture [pixels]."""

START_S = 60.0
"""How long the viewer may take to start on a busy machine without a graphics card [s]."""

NOTHING_S = 10.0
"""How long a file that was loaded may show nothing [s]."""

TITLE_BAR = 36
"""Height of the bar that the viewer keeps for its window, without anything in it [pixels]."""

TOASTS_S = 6.0
"""How long the viewer's notices about itself stay in the picture [s]."""


def show(rrd: str | os.PathLike[str], *, shown: str | os.PathLike[str] | None = None) -> None:
    """Show a recording in a window; returns when it is closed.

    Args:
        rrd: The recording.
        shown: The file that a refusal names, where `rrd` was made from it for this window alone.

    Raises:
        InputError: The file is missing, or the viewer cannot run here.
    """
    rrd = existing(rrd, "recording")
    command = [_binary(), "--bind", LOCALHOST, "--port", "auto", str(rrd)]
    result = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
    if result.returncode:
        advice = (
            f"use a browser: rerun --web-viewer --bind {LOCALHOST} {rrd}"
            if shown is None
            else "view the .rrd of this run, which a browser shows too"
        )
        raise InputError(
            f"{shown or rrd}: the Rerun viewer opened no window: {_reason(result.stderr)}; "
            f"without a display {advice}"
        )


def screenshot(
    rrd: str | os.PathLike[str],
    png: str | os.PathLike[str],
    *,
    time_s: float | None = None,
    size: tuple[int, int] = (1600, 1000),
    force: bool = False,
) -> list[str]:
    """Draw a recording as the viewer shows it, on a machine with or without a display.

    Args:
        rrd: The recording.
        png: The picture to make.
        time_s: Moment on the timeline `sim_time` [s]. Default: where the viewer starts.
        size: Width and height of the picture [pixels].
        force: Whether a picture that exists is replaced.

    Returns:
        The warnings and errors of the recording's views, a line each; empty when all is well.

    Raises:
        InputError: The recording is missing, cannot be read or has no such moment; the size is out of
            range; the picture exists; or the machine has no Vulkan.
    """
    path = existing(rrd, "recording")
    if path.is_dir():
        raise InputError(f"{rrd}: a folder; name the .rrd file in it")
    if not (min(size) >= LEAST_SIZE and max(size) <= MOST_SIZE):
        limits = f"{LEAST_SIZE}..{MOST_SIZE} pixels each way"
        raise InputError(f"size of a recording's picture must lie in {limits}, got {size[0]} x {size[1]}")
    check_decodes(path, rrd)
    window = (size[0], size[1] + TITLE_BAR)
    with output(png, force=force) as aside, headless_viewer(window) as client:
        try:
            views = _draw(client, path.resolve(), rrd, aside, time_s)
        except (ConnectionError, RuntimeError) as error:
            raise InputError(
                f"{rrd}: the Rerun viewer ended before the picture was drawn ({error})"
            ) from error
    return [
        f"{v.name}: {r.severity}: {r.summary} {r.details or ''}".strip() for v in views for r in v.reports
    ]


def _draw(
    client: ViewerClient, path: Path, said: str | os.PathLike[str], png: Path, time_s: float | None
) -> list[View]:
    """Open a recording, go to a moment, save what is shown; returns the state of the views."""
    client.open(str(path))
    _wait_until(lambda: not client.get_state().loading, f"{said}: the viewer did not load it")
    nothing = f"{said}: holds nothing that the viewer shows; if the recording was cut short, write it again"
    _wait_until(lambda: _timelines(client) != [], nothing, NOTHING_S)
    if time_s is not None:
        timelines = _timelines(client)
        line = next((one for one in timelines if one.name == TIMELINE), None)
        if line is None or line.start is None or line.end is None:
            raise InputError(
                f"{said}: has no timeline {TIMELINE!r} to find a time on; it has "
                f"{', '.join(one.name for one in timelines)}"
            )
        first, last = line.start / 1e9, line.end / 1e9
        if not first <= time_s <= last:
            raise InputError(
                f"{said}: the recording goes from {first:g} to {last:g} s; there is no {time_s:g} s in it"
            )
        client.set_time(TIMELINE, duration=time_s, play_state="paused")
    client.run_command("ui.toggle_top_panel")
    end = time.monotonic() + TOASTS_S
    while time.monotonic() < end:  # its clock goes on only while it draws
        client.take_screenshot(max_size=64)
    client.save_screenshot(str(png))
    _crop(png)
    return client.get_state().views


@contextmanager
def headless_viewer(size: tuple[int, int] = (1600, 1000)) -> Iterator[ViewerClient]:
    """A viewer without a window that listens on this machine only; ended with the block.

    Args:
        size: Width and height of what it draws [pixels].

    Raises:
        InputError: It cannot run here; the text says what it said.
    """
    with _started("--headless", "--window-size", f"{size[0]}x{size[1]}") as (_, client):
        yield client


@contextmanager
def live_viewer(*, headless: bool = False) -> Iterator[tuple[str, ViewerClient]]:
    """A viewer in a window, for what is still going on; ended with the block.

    Args:
        headless: Whether it has no window, but can be asked for pictures.

    Yields:
        The address that recordings connect to, on this machine only, and a client.

    Raises:
        InputError: It cannot run here; the text says what it said.
    """
    with _started(*["--headless"] * headless) as viewer:
        yield viewer


@contextmanager
def _started(*options: str) -> Iterator[tuple[str, ViewerClient]]:
    """A viewer process that listens on this machine only, its address and a client; ended with the block."""
    port = _free_port()
    command = [_binary(), "--bind", LOCALHOST, "--port", str(port), "--hide-welcome-screen", *options]
    process = None
    with tempfile.TemporaryFile("w+") as log:
        try:
            with _interrupt_later():
                process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
            yield f"rerun+http://{LOCALHOST}:{port}/proxy", _connected(process, port, log)
        finally:
            if process is not None:
                _end(process)


@contextmanager
def _interrupt_later() -> Iterator[None]:
    """Delay Ctrl-C to the end of the block, so that no process is started whose handle is lost."""
    if threading.current_thread() is not threading.main_thread():  # Python interrupts the main thread only
        yield
        return
    interrupts: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: interrupts.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if interrupts:
        signal.raise_signal(signal.SIGINT)


def _connected(process: "subprocess.Popen[bytes]", port: int, log: IO[str]) -> ViewerClient:
    """A client of a viewer that was just started, once it draws: it listens before it knows if it can."""
    clients: list[ViewerClient] = []

    def draws() -> bool:
        if process.poll() is not None:
            log.seek(0)
            raise InputError(
                f"the Rerun viewer cannot draw here: {_reason(log.read())}; without a graphics card "
                "it needs Vulkan in software: apt install mesa-vulkan-drivers libvulkan1"
            )
        try:
            clients.append(ViewerClient.connect(f"rerun+http://{LOCALHOST}:{port}/proxy"))
            clients[-1].get_state()
        except (ConnectionError, RuntimeError):
            return False
        return True

    _wait_until(draws, "the Rerun viewer did not start")
    return clients[-1]


def check_decodes(rrd: Path, said: str | os.PathLike[str]) -> None:
    """Refuse a recording that Rerun's own verifier cannot decode.

    It is a process of its own: where bytes were changed, Rerun's decoder may end the process that it is in.
    That a recording has no end is no fault here: one that is still growing has none.

    Args:
        rrd: The recording.
        said: The file that a refusal names.

    Raises:
        InputError: It is no recording, was cut short, or its bytes were changed.
    """
    with rrd.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise InputError(
                f"{said}: not a Rerun recording that can be read (it does not start with RRF); write it again"
            )
    done = subprocess.run([_binary(), "rrd", "verify", str(rrd)], capture_output=True, text=True, check=False)
    told = [line for line in done.stderr.splitlines() if "Missing RRD footer" not in line and line.strip()]
    endless = done.returncode == 1 and [line.rpartition(" with ")[2] for line in told] == ["1 errors"]
    if done.returncode and not endless:
        raise InputError(
            f"{said}: not a Rerun recording that can be read ({_reason(done.stderr)}); write it again"
        )


def _crop(png: Path) -> None:
    """Take the empty title bar off a picture."""
    from matplotlib.image import imread, imsave

    imsave(png, imread(png)[TITLE_BAR:], metadata={"Software": "magtwin"}, pil_kwargs={"optimize": True})


def _binary() -> str:
    """The viewer's program, as its own launcher finds it."""
    name = "rerun.exe" if os.name == "nt" else "rerun"
    return str(existing(Path(rerun_cli.__file__).with_name(name), "Rerun viewer; install rerun-sdk again"))


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOCALHOST, 0))
        return int(probe.getsockname()[1])


def _timelines(client: ViewerClient) -> list[Timeline]:
    """The timelines of what a viewer has open."""
    return [line for recording in client.get_state().recordings for line in recording.timelines]


def _wait_until(done: Callable[[], bool], refusal: str, limit_s: float = START_S) -> None:
    """Ask again and again; refuse after some time."""
    end = time.monotonic() + limit_s
    while not done():
        if time.monotonic() > end:
            raise InputError(f"{refusal} (waited {limit_s:g} s)")
        time.sleep(0.1)


def _reason(log: str) -> str:
    """What a log says of the end of its program: its panic, its error, or else its last line."""
    found = re.search(r"panicked at '(.+?)'|^Error: (.+)$", log, re.MULTILINE)
    lines = [line.strip() for line in log.splitlines() if line.strip()] or ["it gave no reason"]
    text = next(group for group in found.groups() if group) if found else lines[-1]
    return re.sub(r"\S+ at /\S+ ", "", text).rstrip(".")  # the viewer's own file names help nobody


def _end(process: "subprocess.Popen[bytes]") -> None:
    """End a process and what it started."""
    for sign in (signal.SIGTERM, signal.SIGKILL):
        if process.poll() is None:
            os.killpg(process.pid, sign)
            try:
                process.wait(5)
            except subprocess.TimeoutExpired:
                continue
