"""The one line with which a command is refused."""

from typing import Any

import pytest

from magtwin.cli import main


def refused(capsys: pytest.CaptureFixture[str], *words: Any) -> str:
    """Run a command that magtwin refuses with status 1 or 2; returns its one line on stderr."""
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if not line.startswith("  ")]  # steps are indented
    assert stop.value.code in (1, 2), error
    assert len(lines) == 1, error
    assert lines[0].startswith("magtwin: "), error
    assert "a fault in magtwin" not in lines[0]
    return lines[0]
