"""CSV -> USD -> CSV: a survey comes back from its map's layer number by number."""

from dataclasses import fields, replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Usd, Vt

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.survey.nodes import read_survey, write_survey
from magtwin.usd.maps.layer import load_map, save_map


def survey(seed=0, **given):
    """A map of readings that no single precision holds, at headings a little off the nominal ones."""
    rng = np.random.default_rng(seed)
    shape = (4, 3, 5)
    headings = np.radians([0.0, 90.0, 180.0, 270.0])
    about = {
        "values_nt": rng.uniform(3e4, 5e4, shape),
        "recorded_yaw": headings[:, None, None] + rng.normal(0, 0.1, shape),
        "origin_m": (-1.0, 0.25),
        "cell_m": (0.25, 0.25),
        "headings_rad": headings,
        "name": "made",
    }
    return AnomalyMap(**about | given)


def rows(folder):
    """The rows of each file, with its first line, without the comment lines between."""
    lines = {file.name: file.read_text().splitlines() for file in sorted(folder.iterdir())}
    return {name: [x[0], *(y for y in x[1:] if not y.startswith("#"))] for name, x in lines.items()}


FITTED = {
    "recorded_yaw": None,
    "variance_nt2": np.full((4, 3, 5), 81.0),
    "valid": np.arange(60).reshape(4, 3, 5) % 7 > 0,
    "method": "gp",
    "parameters": {"kernel": "matern", "length_m": 0.75, "lengths": [1, 2.5]},
    "licence": "MIT",
    "created": "2024-05-01",
    "frame": "world: x east, y north",
    "datum": 'origin\u2028amid "the" floor # not: a comment',
    "height_m": 0.3,
}


def test_a_fitted_map_comes_back_from_its_csvs_with_all_that_it_knew(tmp_path):
    made = survey(3, **FITTED)
    write_survey(made, tmp_path / "csv")
    back = read_survey(tmp_path / "csv")[0]
    for name in (f.name for f in fields(AnomalyMap) if f.name not in ("source", "harmonic")):
        assert np.array_equal(getattr(back, name), getattr(made, name)), name
    assert "0_map.csv sha256:" in back.source
    write_survey(replace(back, source=made.source), tmp_path / "again")
    for file in sorted((tmp_path / "csv").iterdir()):
        assert (tmp_path / "again" / file.name).read_bytes() == file.read_bytes()


def test_other_programs_read_our_csvs(tmp_path):
    made = survey(3, **FITTED)
    write_survey(made, tmp_path / "csv")
    file = tmp_path / "csv" / "90_map.csv"
    plain = np.loadtxt(file, delimiter=",")
    assert np.array_equal(plain[:, 3].reshape(3, 5), made.values_nt[1])
    names = ["x", "y", "theta", "scalar_mag"]
    assert np.array_equal(pd.read_csv(file, comment="#", names=names, float_precision="round_trip"), plain)
    named = np.genfromtxt(file, delimiter=",", names=True)
    assert named.dtype.names == tuple(names)
    assert np.array_equal(named["scalar_mag"], plain[:, 3])


@pytest.mark.parametrize(
    ("line", "extra", "said"),
    [
        ("# height_m: tall", [], "0_map.csv:2: height_m must be JSON, got 'tall'"),
        ("# height_m: NaN", [], "0_map.csv:2: height_m must be JSON, got 'NaN'"),
        ("# height_m: -1", [], "0_map.csv:2: height_m cannot be '-1'"),
        ("# parameters: [1]", [], r"0_map.csv:2: parameters cannot be '\[1\]'"),
        ("# created: 1 May", [], "0_map.csv:2: created must be a day YYYY-MM-DD, got '1 May'"),
        ("# masked_rows: [15]", [], "0_map.csv: masked_rows names row 15, and it has 15"),
        ("# licence: MIT", [], "licence is 'CC0-1.0', but 'MIT' in 0_map.csv; they are of two maps"),
        ("# name: a", ["# name: b"], r"0_map.csv:\d+: name is given a second time"),
    ],
)
def test_a_header_that_cannot_be_is_refused_by_file_and_line(tmp_path, line, extra, said):
    write_survey(survey(3, **FITTED | {"licence": "CC0-1.0"}), tmp_path / "csv")
    file = tmp_path / "csv" / "0_map.csv"
    first, *rest = [x for x in file.read_text().splitlines() if not x.startswith(line.split(":")[0])]
    file.write_text("\n".join([first, line, *rest, *extra]) + "\n")
    with pytest.raises(InputError, match=said):
        read_survey(tmp_path / "csv")[0]


def test_the_real_survey_comes_back_from_usd_row_by_row(real_data, tmp_path, capfd):
    source = real_data / "aprilab" / "maps"
    main(["map", "import", str(source), "--out", str(tmp_path / "a.usdc"), "--json"])
    main(["map", "export", str(tmp_path / "a.usdc"), "--out", str(tmp_path / "csv")])
    assert "270_map.csv" in capfd.readouterr().out
    before, after = rows(source), rows(tmp_path / "csv")
    assert before.keys() == after.keys()
    for name, lines in before.items():
        assert after[name] == [line.rstrip() for line in lines], name
    assert '# method: "survey' in (tmp_path / "csv" / "0_map.csv").read_text()


@settings(max_examples=4, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_any_survey_comes_back_from_csv_and_from_usd_to_the_bit(tmp_path_factory, seed):
    folder, made = tmp_path_factory.mktemp("trip"), survey(seed)
    save_map(made, folder / "a.usdc")
    write_survey(load_map(folder / "a.usdc"), folder / "csv")
    back = read_survey(folder / "csv", keep_stuck=True)[0]
    for name in ("values_nt", "recorded_yaw", "headings_rad", "origin_m", "cell_m"):
        assert np.array_equal(getattr(back, name), getattr(made, name)), name
    save_map(replace(back, name="made"), folder / "b.usdc")
    write_survey(load_map(folder / "b.usdc"), folder / "again")
    assert rows(folder / "csv") == rows(folder / "again")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("recordedNt", [45_000.0] * 60, "not those that were recorded"),
        ("recordedNt", [45_000.0] * 3, "recordedNt has 3 numbers for 60 values"),
        ("recordedYawRad", [0.0] * 3, "recordedYawRad has 3 numbers for 60 values"),
    ],
)
def test_readings_that_do_not_fit_the_map_are_refused_by_prim(tmp_path, name, value, said):
    save_map(survey(), tmp_path / "a.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    stage.GetPrimAtPath("/World/AnomalyMap").GetAttribute(f"magtwin:anomalyMap:{name}").Set(
        Vt.DoubleArray(value)
    )
    stage.Save()
    with pytest.raises(InputError, match=f"</World/AnomalyMap>: .*{said}"):
        load_map(tmp_path / "a.usdc")


def test_a_map_with_a_node_without_a_value_is_not_written_as_a_survey(tmp_path):
    values = np.full((4, 3, 5), 45_000.0)
    values[0, 1, 2] = np.nan
    made = survey(values_nt=values, recorded_yaw=None, valid=np.isfinite(values))
    with pytest.raises(InputError, match="has no value at 1 of its nodes"):
        write_survey(made, tmp_path / "csv")
    assert not (tmp_path / "csv").exists()
