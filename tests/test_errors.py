"""Refusals: the text names a parameter as in Python, the command line as a flag."""

import pickle

from magtwin.errors import InputError, UnknownNameError

FLAGS = {"force": "--force", "magnetometer": "--magnetometer"}


def test_a_parameter_in_backticks_becomes_its_flag_and_other_words_stay():
    error = InputError(
        "a.csv: exists; give `force=True`, `map`, or `magnetometer='neural'`; see `magtwin run`"
    )
    assert error.in_flags(FLAGS) == (
        "a.csv: exists; give --force, `map`, or --magnetometer neural; see `magtwin run`"
    )


def test_a_parameter_survives_pickling_and_is_none_by_default():
    assert pickle.loads(pickle.dumps(InputError("give `force=True`", parameter="force"))).parameter == "force"
    assert UnknownNameError("no path").parameter is None
