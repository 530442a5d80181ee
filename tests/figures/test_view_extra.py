"""Drawing without the extra `view`."""

import importlib.util

import pytest

from magtwin.errors import InputError
from magtwin.figures.pictures import plotter_of


def test_a_missing_extra_is_named(monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr(
        "magtwin.figures.pictures.find_spec", lambda name: None if name == "pyvista" else found(name)
    )
    with pytest.raises(InputError, match=r"need pyvista: pip install 'magtwin\[view\]'"):
        plotter_of((64, 64))
