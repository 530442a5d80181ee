"""What tests of files share."""

import pytest

from magtwin.errors import InputError
from magtwin.io.rerun.viewer import live_viewer


@pytest.fixture(scope="session")
def drawable() -> None:
    """Skips where the Rerun viewer cannot draw."""
    try:
        with live_viewer(headless=True):
            pass
    except InputError as error:
        if "cannot draw here" not in str(error):
            raise
        pytest.skip(str(error))
