"""The twin that most files of this folder drive and none changes."""

import pytest

from magtwin.twin import Twin, open_twin


@pytest.fixture(scope="session")
def twin(lab_scene) -> Twin:
    """The default lab, with the exact field at its magnetometer."""
    return open_twin(lab_scene, magnetometer="physical")
