"""What tests of nodes share: domains of their own on loopback, and spinning until something holds."""

import fcntl
import itertools
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pytest

from magtwin.ros.bus import Bus, Message, open_bus
from magtwin.ros.diagnostics import LEVELS, Status

SLOWEST_S = 120.0

MOST_DOMAINS = 100
"""Domains up to here have ports below those that systems hand out."""

EACH = 48
"""Domains that one process uses in turn; a domain may remember nodes of an earlier test for some seconds."""

LOCKS = Path(tempfile.gettempdir()) / "magtwin-domains"


def _domains() -> Iterator[int]:
    """Domains that no other process of tests uses, also one of another checkout: each is a locked file."""
    LOCKS.mkdir(exist_ok=True)
    held: dict[int, IO[str]] = {}  # the locks last as long as the process
    order = itertools.cycle(range(1, MOST_DOMAINS + 1))
    for _ in range(os.getpid() % MOST_DOMAINS):
        next(order)
    last = time.monotonic() + 10 * SLOWEST_S
    while len(held) < EACH:
        for domain in itertools.islice(order, MOST_DOMAINS):
            lock = (LOCKS / str(domain)).open("w")
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                lock.close()
                continue
            held[domain] = lock
            yield domain
            break
        else:
            if held:
                break
            assert time.monotonic() < last, f"all {MOST_DOMAINS} domains are in use: {LOCKS}"
            time.sleep(0.5)
    yield from itertools.cycle(held)


DOMAINS = _domains()


@contextmanager
def in_a_domain() -> Iterator[Callable[..., Bus]]:
    """Makes nodes in a domain of their own, on loopback only, and closes them."""
    domain, made = next(DOMAINS), list[Bus]()

    def node(name: str, **rest: object) -> Bus:
        made.append(open_bus(name, backend="cyclonedds", domain=domain, **rest))  # type: ignore[arg-type]
        return made[-1]

    node.domain = domain  # type: ignore[attr-defined]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        for name in ("CYCLONEDDS_URI", "ROS_LOCALHOST_ONLY"):
            patch.delenv(name, raising=False)
        try:
            yield node
        finally:
            for bus in made:
                bus.close()


def spin(until: Callable[[], object], *nodes: Bus) -> None:
    """Spin nodes until something holds, or too long."""
    last = time.monotonic() + SLOWEST_S
    while not until():
        assert time.monotonic() < last, "it never came"
        for node in nodes:
            node.spin_once(0.005)


def from_message(message: Message) -> list[Status]:
    """The statuses of a DiagnosticArray."""
    names = list(LEVELS)
    return [
        Status(s.name, names[s.level], s.message, {pair.key: pair.value for pair in s.values})
        for s in message.content.status
    ]
