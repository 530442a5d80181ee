"""Progress of commands on stderr: a bar on a terminal, else a line now and then.

A thread watches each command. After `FIRST_S` of silence, and then every `EVERY_S`, it prints the current
step with counts, rate and time left. So progress appears even while a library reports none.
"""

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from threading import Event, Lock, Thread
from typing import Any, TextIO

from magtwin.report.summary import printable_lines

FIRST_S = 1.5
"""Silence after which the first line is printed [s]."""

EVERY_S = 10.0
"""Time between two lines of progress, at least [s]."""

TICK_S = 0.1
"""Time between two looks at the clock [s]."""

WINDOW_S, FEWEST = 30.0, 8
"""Rates are means over this time [s] and over this many reports: long runs can end several at once."""

LATE_S = 5.0
"""Time without a report after which the rate counts as unknown [s], at least ..."""

LATE = 3.0
"""... and so many times the usual time between reports."""


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
    seen: deque[tuple[float, float]] = field(default_factory=deque)

    def advance(self, now: float, done: float, total: float | None, what: str = "") -> None:
        """Take a report at a time `now` [s]."""
        seen = self.seen
        if done < self.done:
            seen.clear()  # another loop has begun
        self.done, self.total, self.what = done, total, what
        if not seen or now - seen[-1][0] > TICK_S or len(seen) == 1:
            seen.append((now, done))
        else:
            seen[-1] = (now, done)
        while len(seen) > FEWEST and now - seen[1][0] > WINDOW_S:
            seen.popleft()

    def rate(self, now: float) -> float | None:
        """How many are done a second; None while that is unknown, or no report came for long."""
        if len(self.seen) < 2:
            return None
        (first, before), (last, after) = self.seen[0], self.seen[-1]
        if after <= before or last <= first:
            return None
        rate = (after - before) / (last - first)
        return rate if now - last < max(LATE_S, LATE * (last - first) / (len(self.seen) - 1)) else None

    def left_s(self, now: float) -> float | None:
        """Time left at a time `now` [s], None while that is unknown."""
        rate = self.rate(now)
        if rate is None or not self.total or self.done >= self.total:
            return None
        left = (self.total - self.done) / rate - (now - self.seen[-1][0])
        return left if left > 0 else None  # later than usual

    def line(self, now: float) -> str:
        """The step in a line, at a time `now` [s]."""
        count = f"{self.done:,.0f}" if self.done or self.total else ""
        count += f" of {self.total:,.0f}" if self.total else ""
        left, gone = self.left_s(now), now - self.began
        time_text = f"{in_words(gone)} so far" if gone >= 1 else ""
        time_text = time_text if left is None else f"{in_words(left)} left"
        counted = f"{count} {self.unit}".strip() if count else ""
        text = ", ".join(part for part in (counted, self.speed(now), time_text, self.what) if part)
        return f"{self.title}: {text}" if text else f"{self.title} ..."

    def speed(self, now: float) -> str:
        """The rate in words, empty while it is unknown."""
        rate = self.rate(now)
        if rate is None:
            return ""
        number = f"{rate:,.0f}" if rate >= 100 else f"{rate:.2g}"
        if self.unit == "s":
            return f"{number} x real time"
        return f"{number} {self.unit}/s" if self.unit else f"{number}/s"


def in_words(seconds: float) -> str:
    """A time for people: 12 s, 1 min 20 s, 2 h 5 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


class Watch:
    """What one command is doing, and when it last printed a line about it."""

    def __init__(self, *, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin to watch. Lines go to `stream`, by default stderr; bars are drawn if that is a terminal."""
        self._stream, self._clock = stream, clock
        self._terminal = stream is None and sys.stderr.isatty()
        self._printed = clock()
        self._reported = -float("inf")
        self._base = Step("Starting", "", self._printed)
        self._steps: list[Step] = []
        self._bar: Any = None
        self._silent = 0
        self._announces, self._mute = True, False
        self._lock = Lock()
        self.end = Event()

    @contextmanager
    def reduced(self, *, steps: bool, all: bool) -> Iterator[None]:  # noqa: A002
        """Announce no steps, or print nothing at all, until the end of the block."""
        before = self._announces, self._mute
        self._announces, self._mute = not steps, all
        try:
            yield
        finally:
            self._announces, self._mute = before

    def step(self, text: str, *, announced: bool = True) -> None:
        """Name what is done next, whose length is unknown; printed at once if `announced`."""
        now = self._clock()
        with self._lock:
            self._base = Step(text, "", now)
            if announced and self._announces:
                self._print(f"  {text} ...")
                self._printed = now

    @contextmanager
    def silence(self) -> Iterator[None]:
        """Print no lines while a viewer is shown or the command waits for people."""
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
        try:
            with self._drawn(step) if self._terminal and not self._mute else nullcontext() as draw:

                def advance(done: float, total: float | None, what: str = "") -> None:
                    step.advance(self._clock(), done, total, what)
                    if draw is not None:
                        draw()
                    self.tick()  # a library that keeps the interpreter to itself starves the thread

                yield advance
        finally:
            self._steps.remove(step)
            self._base = Step("Finishing", "", self._clock())

    def tick(self) -> None:
        """Print a line if one is due."""
        with self._lock:
            now = self._clock()
            if self._silent or self._mute or self._bar is not None or self.end.is_set():
                return
            if now - self._printed < FIRST_S or now - self._reported < EVERY_S:
                return
            step = self._steps[-1] if self._steps else self._base
            self._print(f"  {step.line(now)}")
            self._printed = self._reported = now

    def run(self) -> None:
        """Print the lines that are due until `end` is set."""
        while not self.end.wait(TICK_S):
            self.tick()

    def _print(self, line: str) -> None:
        with suppress(OSError, ValueError):  # stderr is closed
            print(printable_lines(line), file=self._stream or sys.stderr, flush=True)

    @contextmanager
    def _drawn(self, step: Step) -> Iterator[Callable[[], None]]:
        """A bar for a step, below those that are drawn already; gives what draws it anew."""
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        mine = self._bar is None
        if mine:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"),
                TimeRemainingColumn(),
                TextColumn("{task.fields[what]}"),
            )
            console = Console(file=self._stream, stderr=self._stream is None, force_terminal=True)
            self._bar = Progress(*columns, console=console, redirect_stdout=False)
            self._bar.start()
        bar = self._bar
        task = bar.add_task(f"  {step.title}", total=None, rate="", what="")
        try:
            yield lambda: bar.update(
                task,
                completed=step.done,
                total=step.total or None,
                rate=step.speed(self._clock()),
                what=step.what,
            )
        finally:
            if mine:
                bar.stop()
                self._bar = None
                self._printed = self._clock()
            else:
                bar.remove_task(task)


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
        _watches.remove(watch)


def current() -> Watch:
    """The watch of the command that is under way; one that no thread looks at where there is none."""
    return _watches[-1] if _watches else Watch()


def announce(text: str) -> None:
    """Print what is done next, on stderr; with --json only if it takes long."""
    current().step(text)


def step(text: str) -> None:
    """Name what is done next; it is printed only if it takes long."""
    current().step(text, announced=False)


def progress(title: str, unit: str = "") -> Any:
    """Report progress, counted in `unit`, with rate and time left; gives `advance(done, total, what)`."""
    return current().progress(title, unit)


def silence() -> Any:
    """Report nothing for a time: a viewer is shown, or the command waits for people."""
    return current().silence()
