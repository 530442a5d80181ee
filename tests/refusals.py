"""How a command refuses: one line on stderr, and exit status 1."""

import pytest

from magtwin.cli import main


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line with which magtwin refuses `arguments`."""
    with pytest.raises(SystemExit) as stop:
        main([str(a) for a in arguments])
    error = capsys.readouterr().err
    lines = [line for line in error.splitlines() if not line.startswith("  ")]  # steps are indented
    assert stop.value.code == 1, error
    assert len(lines) == 1, error
    assert lines[0].startswith("magtwin: ")
    return lines[0]
