"""What tests of nodes share."""

from collections.abc import Callable, Iterator

import pytest
from nodes import in_a_domain

from magtwin.ros.bus import Bus


@pytest.fixture
def nodes() -> Iterator[Callable[..., Bus]]:
    """Makes nodes in a domain of the test's own, on loopback only."""
    with in_a_domain() as node:
        yield node
