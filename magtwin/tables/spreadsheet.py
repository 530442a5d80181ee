"""Spreadsheets of Excel and LibreOffice, as text (pip install 'magtwin[tables]')."""

import csv
import io
import math
from pathlib import Path

from magtwin.errors import InputError
from magtwin.files.budget import check_size
from magtwin.tables.delimited import number_of


def text_of_spreadsheet(path: Path) -> bytes:
    """The first sheet that has rows of numbers, as CSV in UTF-8."""
    check_size(path, "readings")
    try:
        from python_calamine import CalamineError, CalamineWorkbook
    except ImportError:
        advice = "pip install 'magtwin[tables]', or save it as CSV"
        raise InputError(f"{path}: a spreadsheet needs python-calamine: {advice}") from None
    try:
        book = CalamineWorkbook.from_path(path)
        sheets = [book.get_sheet_by_name(name).to_python() for name in book.sheet_names]
    except (CalamineError, OSError) as error:
        raise InputError(f"{path}: no spreadsheet, or damaged ({str(error)[:120]})") from None
    rows = next((rows for rows in sheets if sum(map(_has_number, rows)) > 1), None)
    if rows is None:
        raise InputError(f"{path}: no sheet has rows of numbers")
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


def _has_number(row: list[object]) -> bool:
    return any(math.isfinite(number_of(str(cell))) for cell in row)
