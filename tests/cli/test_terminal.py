"""Reports for files and other programs."""

from magtwin.cli import terminal
from magtwin.report.report import Figure, Report


def test_a_report_has_a_line_a_figure_and_escapes_what_could_act_on_a_terminal(capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    figures = (
        Figure("mass", 12_345.5, "kg", 0.1, "[bold]a note[/]"),
        Figure("\u5e45", 1),
        Figure("word", "a\x1b[31m"),
    )
    report = Report(
        "title", figures, {"source": "s" * 200, "lines": ["a", "b"], "pairs": {"k": "v"}, "none": ""}
    )
    terminal.print_report(report)
    assert capsys.readouterr().out.splitlines() == [
        "title",
        "mass  12,345.5  ± 0.1 kg  [bold]a note[/]",
        "\u5e45           1",
        "word    a\\x1b[31m",
        f"source  {'s' * 200}",
        "lines",
        "  a",
        "  b",
        "pairs",
        "  k  v",
    ]
