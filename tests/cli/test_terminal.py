"""Reports on a terminal, and the same text for files and other programs."""

from itertools import product

import pytest

from magtwin.cli import terminal
from magtwin.report.report import Figure, Report

VALUES = (1, 12_345_678, 1.5, 3e-9, float("nan"))
TEXTS = ("", "mass", "[bold]two words[/]", "-" * 60)


def reports():
    """Reports with figures, words and lists, with and without units, spreads and notes."""
    yield Report("empty", ())
    for unit, note, spread in product(("", "kg"), TEXTS, (None, 0.1, 1e10)):
        figures = [Figure(f"n{k}", v, unit, note=note, spread=spread) for k, v in enumerate(VALUES)]
        words = (Figure("name", "text", unit, note=note), Figure("other name", note))
        lists = {"source": note, "empty": "", "lines": [note, "b"], "pairs": {"key": note, "k": "b"}}
        yield Report(note or "title", (*figures, *words), lists, verdict=note)


@pytest.mark.parametrize("report", list(reports()))
def test_a_report_for_a_file_is_the_text_that_rich_prints(report, capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    terminal.print_report(report)
    plain = capsys.readouterr().out
    assert plain == "\n".join(terminal._lines(report)) + "\n"
    monkeypatch.setattr(terminal, "_lines", lambda report: ["\x00"])  # not printable: rich prints it
    terminal.print_report(report)
    assert capsys.readouterr().out == plain


def test_wide_letters_are_left_to_rich(capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    terminal.print_report(Report("t", (Figure("\u5e45", 1, note="x"), Figure("ab", 1, note="x"))))
    assert capsys.readouterr().out == "t\n\u5e45  1    x\nab  1    x\n"
