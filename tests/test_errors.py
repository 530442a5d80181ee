"""Refusals: the text names a parameter as in Python, the command line as a flag."""

import pytest

from magtwin.errors import InputError, UnknownNameError, find, hint, near

FLAGS = {"force": "--force", "magnetometer": "--magnetometer"}


def test_a_parameter_in_backticks_becomes_its_flag_and_other_words_stay():
    error = InputError(
        "a.csv: exists; give `force=True`, `map`, or `magnetometer='neural'`; see `magtwin run`"
    )
    assert error.in_flags(FLAGS) == (
        "a.csv: exists; give --force, `map`, or --magnetometer neural; see `magtwin run`"
    )


def test_a_parameter_that_begins_a_text_or_that_an_error_is_about_becomes_its_flag():
    flags = {"rate_hz": "--rate-hz", "seed": "--seed", "map": "--map"}
    for text, shown in (
        ("rate_hz of a controller must be above 0", "--rate-hz of a controller must be above 0"),
        ("rate_hz 3 is too low", "--rate-hz 3 is too low"),
        ("seed must be 0 or more", "--seed must be 0 or more"),
        ("map has no variance; seed must be 0", "map has no variance; seed must be 0"),
        ("a.csv: seed must be 0", "a.csv: seed must be 0"),
    ):
        assert InputError(text).in_flags(flags) == shown
    assert InputError("a date, got 'x'", parameter="map").in_flags(flags) == "--map: a date, got 'x'"
    assert InputError("give `map`", parameter="map").in_flags(flags) == "give --map"
    assert InputError("a date, got 'x'", parameter="day").in_flags(flags) == "a date, got 'x'"


def test_a_text_of_a_file_that_looks_like_a_call_stays():
    for text in ("name `force(__import__)` is unknown", "name `force(1 +)`", "name `force((((`"):
        assert InputError(text).in_flags(FLAGS) == text


def test_a_name_of_a_file_that_is_no_text_is_unknown():
    with pytest.raises(UnknownNameError, match="no path 5; known: a, b"):
        find("path", 5, {"a": 1, "b": 2})
    assert hint(True, ["a"]) == "known: a"
    assert near(5, ["a"]) == ""
