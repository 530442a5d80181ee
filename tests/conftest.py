"""What tests share: the real data beside the checkout, and scratch folders."""

from pathlib import Path

import pytest

REAL = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def real_data() -> Path:
    """The real survey, network, paths and robot; a test that needs them is skipped where they are absent."""
    if not REAL.is_dir():
        pytest.skip(f"the real data are not at {REAL}; `magtwin fetch` gets them for use by hand")
    return REAL
