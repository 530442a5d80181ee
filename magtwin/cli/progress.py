"""Progress of commands on stderr: one line that disappears on a terminal, else a line now and then.

A thread watches each command. On a terminal it draws the current step with a bar, counts, rate and time left,
and takes the line away at the end. Elsewhere it prints such a line after `FIRST_S` of silence, and then every
`EVERY_S`. So progress appears even while a library reports none.
"""

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from threading import Event, Lock, Thread
from typing import Any, TextIO

from magtwin.report.summary import printable_lines

FIRST_S = 1.5
"""Silence after which the first line is printed [s]."""

EVERY_S = 10.0
"""Time between two lines of progress, at least [s]."""

TICK_S = 0.1
"""Time between two looks at the clock [s]."""

DRAWN_S = 0.4
"""Length of a step after which it is drawn on a terminal [s]."""

BAR = 20
"""Characters of a bar."""

Advance = Callable[..., None]
"""What commands call and hand down to libraries as `progress`: `advance(done, total, what)`."""


@dataclass
class Step:
    """Something that is being done, and how far it has got; times are those of the watch's clock [s]."""

    title: str
    unit: str
    began: float
    done: float = 0
    total: float | None = None
    what: str = ""
    first: tuple[float, float] | None = None
    """Time and count of the first report of this loop: a resumed one does not begin at 0."""

    def advance(self, now: float, done: float, total: float | None, what: str = "") -> None:
        """Take a report at a time `now` [s]; a smaller count than before begins another loop."""
        if self.first is None or done < self.done:
            self.first = now, done
        self.done, self.total, self.what = done, total, what

    def rate(self, now: float) -> float | None:
        """How many were done a second since the first report; None while that is unknown."""
        if self.first is None or self.done <= self.first[1] or now <= self.first[0]:
            return None
        return (self.done - self.first[1]) / (now - self.first[0])

    def speed(self, now: float) -> str:
        """The rate in words, empty while it is unknown."""
        rate = self.rate(now)
        if rate is None:
            return ""
        number = f"{rate:,.0f}" if rate >= 100 else f"{rate:.2g}"
        if self.unit == "s":
            return f"{number} x real time"
        return f"{number} {self.unit}/s" if self.unit else f"{number}/s"

    def bar(self) -> str:
        """How much is done, as a bar; empty while that is unknown."""
        if not self.total:
            return ""
        full = round(BAR * min(1.0, self.done / self.total))
        return f"[{'#' * full}{'.' * (BAR - full)}] "

    def line(self, now: float) -> str:
        """The step in a line, at a time `now` [s]."""
        count = f"{self.done:,.0f}" if self.done or self.total else ""
        count += f" of {self.total:,.0f} {self.unit}" if self.total else f" {self.unit}" if count else ""
        rate, gone = self.rate(now), now - self.began
        spent = f"{in_words(gone)} so far" if gone >= 1 else ""
        if rate and self.total and self.done < self.total:
            spent = f"{in_words((self.total - self.done) / rate)} left"
        text = ", ".join(part for part in (count.strip(), self.speed(now), spent, self.what) if part)
        return f"{self.title}: {text}" if text else f"{self.title} ..."


def in_words(seconds: float) -> str:
    """A time for people: 12 s, 1 min 20 s, 2 h 5 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


class Watch:
    """What one command is doing, and when it last printed a line about it.

    Args:
        stream: Where lines go. Default: stderr.
        clock: Gives the time [s].
        terminal: Whether one line is drawn again and again. Default: whether stderr is a terminal that can.
    """

    def __init__(
        self,
        *,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
        terminal: bool | None = None,
    ) -> None:
        self._stream, self._clock = stream, clock
        able = stream is None and sys.stderr.isatty() and os.environ.get("TERM") != "dumb"
        self._terminal, self._drawn = able if terminal is None else terminal, ""
        self._printed, self._reported = clock(), -float("inf")
        self._steps = [Step("Starting", "", self._printed)]  # innermost last
        self._silent = 0
        self._lock = Lock()
        self.announces, self.mute = True, False
        """Whether steps are announced, and whether nothing at all is printed."""
        self.end = Event()

    def step(self, text: str, *, announced: bool = False) -> None:
        """Name what is done next, whose length is unknown; printed at once if `announced`."""
        with self._lock:
            self._steps[0] = Step(text, "", self._clock())
            if announced and self.announces and not self.mute:
                self._draw("")
                self._print(f"  {text} ...")
                self._printed = self._clock()

    @contextmanager
    def silence(self) -> Iterator[None]:
        """Print no lines while a viewer is shown or the command waits for people."""
        self.clear()
        self._silent += 1
        try:
            yield
        finally:
            self._silent -= 1
            self._printed = self._clock()

    @contextmanager
    def progress(self, title: str, unit: str = "") -> Iterator[Advance]:
        """A step of known length; gives the function that reports how far it is."""
        step = Step(title, unit, self._clock())
        self._steps.append(step)

        def advance(done: float, total: float | None, what: str = "") -> None:
            step.advance(self._clock(), done, total, what)
            self.tick()  # a library that keeps the interpreter to itself starves the thread

        try:
            yield advance
        finally:
            self._steps.remove(step)
            self._steps[0] = Step("Finishing", "", self._clock())

    def tick(self) -> None:
        """Draw the line anew, or print one if it is due."""
        with self._lock:
            now, step = self._clock(), self._steps[-1]
            if self._silent or self.mute or self.end.is_set():
                return
            if self._terminal:
                if now - step.began >= DRAWN_S and now - self._reported >= TICK_S:
                    self._draw(f"  {step.bar()}{step.line(now)}")
                    self._reported = now
            elif now - self._printed >= FIRST_S and now - self._reported >= EVERY_S:
                self._print(f"  {step.line(now)}")
                self._printed = self._reported = now

    def run(self) -> None:
        """Print the lines that are due until `end` is set."""
        while not self.end.wait(TICK_S):
            self.tick()

    def clear(self) -> None:
        """Take a drawn line away, before another is printed."""
        with self._lock:
            self._draw("")

    def _draw(self, line: str) -> None:
        line = line[: shutil.get_terminal_size().columns - 1]
        if line != self._drawn:
            self._print(f"\r\033[2K{printable_lines(line)}", end="")
            self._drawn = line

    def _print(self, line: str, end: str = "\n") -> None:
        with suppress(OSError, ValueError):  # stderr is closed
            text = line if not end else printable_lines(line)
            print(text, file=self._stream or sys.stderr, flush=True, end=end)


_watches: list[Watch] = []
"""Those of the commands that are under way, the innermost last; there is one but for tests."""


@contextmanager
def watched() -> Iterator[Watch]:
    """Watch a command until its end."""
    watch = Watch()
    thread = Thread(target=watch.run, name="magtwin-progress", daemon=True)
    _watches.append(watch)
    thread.start()
    try:
        yield watch
    finally:
        watch.end.set()
        thread.join()
        watch.clear()
        _watches.remove(watch)


def current() -> Watch:
    """The watch of the command that is under way; one that no thread looks at where there is none."""
    return _watches[-1] if _watches else Watch()


def announce(text: str) -> None:
    """Print what a live command does, or a note, on stderr; with --json only if it takes long."""
    current().step(text, announced=True)


def step(text: str) -> None:
    """Name what is done next; it is shown only while it goes on, if it takes long."""
    current().step(text)


def progress(title: str, unit: str = "") -> Any:
    """Report progress, counted in `unit`, with rate and time left; gives `advance(done, total, what)`."""
    return current().progress(title, unit)


def silence() -> Any:
    """Report nothing for a time: a viewer is shown, or the command waits for people."""
    return current().silence()
