"""Registry: built-in, registered and installed entries by name."""

import importlib.metadata
import sys
from importlib.metadata import EntryPoint

import pytest

from magtwin.errors import InputError, UnknownNameError
from magtwin.extend import Registry


def things(monkeypatch, **installed):
    def entry_points(*, group):
        assert group == "magtwin.things"
        return [EntryPoint(name, value, group) for name, value in installed.items()]

    monkeypatch.setattr(importlib.metadata, "entry_points", entry_points)
    return Registry("thing", "things", {"decoder": "json:JSONDecoder"})


def test_entries_are_built_in_registered_or_installed(monkeypatch):
    table = things(monkeypatch, dumps="json:dumps")

    @table.register("mine")
    def mine():
        return 1

    json = sys.modules["json"]
    assert list(table) == ["decoder", "mine", "dumps"]
    assert len(table) == 3
    assert (table["decoder"], table["mine"], table["dumps"]) == (json.JSONDecoder, mine, json.dumps)
    assert "mine" in table
    assert "other" not in table


def test_a_missing_name_is_refused_with_the_nearest_one(monkeypatch):
    with pytest.raises(UnknownNameError, match=r"no thing 'decodr'; did you mean 'decoder'\?"):
        things(monkeypatch, dumps="json:dumps")["decodr"]
    with pytest.raises(UnknownNameError, match="no thing 'x'; known: decoder, dumps"):
        things(monkeypatch, dumps="json:dumps")["x"]


def test_a_name_is_not_taken_twice(monkeypatch):
    table = things(monkeypatch)
    table.register("mine")(len)
    assert table.register("mine")(len) is len
    for name in ("mine", "decoder"):
        with pytest.raises(InputError, match=f"thing '{name}' exists already"):
            table.register(name)(repr)


def test_an_installed_entry_that_does_not_load_is_refused_with_its_place(monkeypatch):
    with pytest.raises(InputError, match=r"thing 'gone': json:gone of group magtwin.things does not load"):
        things(monkeypatch, gone="json:gone")["gone"]
