"""What tests of nodes share: domains of their own on loopback, and spinning until something holds."""

import itertools
import os
import time
from collections.abc import Callable

from magtwin.ros.bus import Bus, Message
from magtwin.ros.diagnostics import LEVELS, Status

SLOWEST_S = 15.0

_EACH = 50
_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % 2
_FIRST = os.getpid() % _EACH

DOMAINS = (1 + _EACH * _WORKER + k % _EACH for k in itertools.count(_FIRST))
"""Domains up to 100, whose ports lie below those that systems hand out; those of two workers are apart."""


def spin(until: Callable[[], object], *nodes: Bus) -> None:
    """Spin nodes until something holds, or too long."""
    last = time.monotonic() + SLOWEST_S
    while not until():
        assert time.monotonic() < last, "it never came"
        for node in nodes:
            node.spin_once(0.005)


def from_message(message: Message) -> list[Status]:
    """The statuses of a DiagnosticArray."""
    counts = {"status": 0}
    total = int(message.read(["status"], counts)["status"])
    for k in range(total):
        name = f"status.{k}.values"
        counts |= {"status": k + 1, name: 0}
        counts[name] = int(message.read([name], counts)[name])
    names = list(LEVELS)
    statuses = []
    for k in range(total):
        keys = [f"status.{k}.values.{n}" for n in range(counts[f"status.{k}.values"])]
        parts = [f"status.{k}.{part}" for part in ("level", "name", "message")]
        read = message.read([*parts, *(f"{key}.{part}" for key in keys for part in ("key", "value"))], counts)
        level = names[int(read[parts[0]])]
        values = {read[f"{key}.key"]: read[f"{key}.value"] for key in keys}
        statuses.append(Status(read[parts[1]], level, read[parts[2]], values))
    return statuses
