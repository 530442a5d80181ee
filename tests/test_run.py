"""The table of a Run."""

import json

import numpy as np
import pytest

import magtwin
from magtwin.names import RefusedError, UnknownNameError
from magtwin.run import COLUMNS, Run


def test_columns_come_back_by_name_and_a_misspelt_one_names_the_near():
    run = Run({"t": [0, 1], "b_total_nt": [4e4, 4.1e4]})
    assert run["b_total_nt"].dtype == float
    assert run.rows == 2
    assert run.duration_s == 1.0
    with pytest.raises(UnknownNameError, match="no column 'b_totl_nt'; did you mean 'b_total_nt'"):
        run["b_totl_nt"]
    assert run.get("nothing") is None  # a Mapping's own behaviour, since the refusal is a KeyError


def test_unequal_columns_and_wrong_shapes_are_refused():
    with pytest.raises(RefusedError, match=r"equally long, got {'t': 2, 'yaw': 3}"):
        Run({"t": [0, 1], "yaw": [0, 1, 2]})
    with pytest.raises(RefusedError, match=r"'odom_p' must have shape \(2, 3\), got \(2, 2\)"):
        Run({"odom_p": np.zeros((2, 2))})


def test_a_run_is_not_changed_in_place():
    run = Run({"t": [0.0]}, {"seed": 1})
    other = run.with_columns(yaw=np.array([1.0])).with_facts(path="sine")
    assert "yaw" not in run
    assert list(other) == ["t", "yaw"]
    assert dict(other.facts) == {"seed": 1, "path": "sine"}
    with pytest.raises(TypeError):
        run.columns["t"] = np.zeros(1)


def test_every_column_has_a_name_for_each_of_its_numbers():
    for name, column in COLUMNS.items():
        assert len(column.parts) == (column.width if column.width > 1 else 0), name
        assert column.doc
        assert name.endswith("_nt") == (column.unit == "nT"), name


def test_the_report_counts_what_happened():
    run = Run(
        {
            "t": [0, 1, 2],
            "p_world_base": [[0, 0, 0], [3, 4, 0], [3, 4, 0]],
            "b_total_nt": [40, 50, np.nan],
            "b_truth_nt": [41, 53, np.nan],
            "flag_bump": [False, True, False],
        }
    )
    figures = {f.name: f for f in run.report().figures}
    assert figures["distance driven"].value == 5
    assert figures["b_total_nt"].value == 45
    assert figures["b_total_nt"].spread == 5
    assert figures["error"].value == 2
    assert figures["flag_bump"].value == 1
    assert json.loads(run.report("x").to_json())["figures"]["duration"] == {"value": 2.0, "unit": "s"}


def test_public_names_resolve_and_others_are_refused():
    for name in magtwin.__all__:
        assert getattr(magtwin, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'simulat'"):
        _ = magtwin.simulat
