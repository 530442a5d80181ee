"""How long tests wait for other processes: until something holds, on a machine of any speed and load."""

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

PATIENCE_S = 900.0
"""Time after which something never comes [s]; a test that passes does not come near it."""


def wait_until(holds: Callable[[], T]) -> T:
    """The first true value of `holds`."""
    last = time.monotonic() + PATIENCE_S
    while not (value := holds()):
        assert time.monotonic() < last, "it never came"
        time.sleep(0.02)
    return value
