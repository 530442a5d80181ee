"""What tests of nodes share: domains of their own on loopback, and spinning until something holds."""

import itertools
import os
import time
from collections.abc import Callable

from magtwin.ros.bus import Bus

SLOWEST_S = 15.0

DOMAINS = itertools.count(1 + os.getpid() % 200)


def spin(until: Callable[[], object], *nodes: Bus) -> None:
    """Spin nodes until something holds, or too long."""
    last = time.monotonic() + SLOWEST_S
    while not until():
        assert time.monotonic() < last, "it never came"
        for node in nodes:
            node.spin_once(0.005)
