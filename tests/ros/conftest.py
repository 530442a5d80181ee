"""What tests of nodes share."""

from collections.abc import Callable, Iterator

import pytest
from nodes import in_a_domain

from magtwin.ros.bus import Bus
from magtwin.twin import Twin, open_twin


@pytest.fixture
def nodes() -> Iterator[Callable[..., Bus]]:
    """Makes nodes in a domain of the test's own, on loopback only."""
    with in_a_domain() as node:
        yield node


@pytest.fixture(scope="session")
def twin() -> Twin:
    """The lab that ships with magtwin, whose magnetometer reads the map."""
    return open_twin("lab", magnetometer="map-only")
