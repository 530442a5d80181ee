"""Calendar days: dates of surveys and of the Earth's field."""

import datetime
from collections.abc import Sequence

from magtwin.errors import InputError


def parse_day(day: str | datetime.date, what: str = "date") -> datetime.date:
    """Parse a day, YYYY-MM-DD."""
    if isinstance(day, datetime.datetime):
        return day.date()
    if isinstance(day, datetime.date):
        return day
    try:
        parsed = datetime.date.fromisoformat(day)
    except (TypeError, ValueError):
        parsed = None
    if parsed is None or parsed.isoformat() != day:  # 20260102 and 2026-W01-5 are ISO's too
        raise InputError(f"{what} must be a day YYYY-MM-DD, got {day!r}")
    return parsed


def check_day(day: str, what: str) -> None:
    """Raise InputError unless a text is a day YYYY-MM-DD or empty; the text begins with `what`."""
    if day != "":
        parse_day(day, what)


def check_texts(survey: object, names: Sequence[str]) -> None:
    """Refuse metadata of a survey or a map that is not text, and a `created` that is not a day."""
    kind = type(survey).__name__
    for name in names:
        text = getattr(survey, name)
        if not isinstance(text, str):
            raise InputError(f"{name} of {kind} must be a text, got {text!r}")
    check_day(getattr(survey, "created", ""), f"created of {kind}")
