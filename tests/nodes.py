"""What tests of nodes share: domains of their own on loopback, and spinning until something holds."""

import itertools
import os
import time
from collections.abc import Callable

from magtwin.ros.bus import Bus

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
