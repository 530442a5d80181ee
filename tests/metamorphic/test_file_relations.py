"""Relations between files: a survey or a run that is written otherwise is the same."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from relations import permuted
from synthetic import drive, wavy_map
from test_survey_relations import drive as survey_drive

from magtwin.io.formats import read_run, write_run
from magtwin.io.surveys.survey import read_survey


def table(survey):
    columns = {"t [s]": survey.t, "x [m]": survey.p_xy[:, 0], "y [m]": survey.p_xy[:, 1]}
    return columns | {"yaw [rad]": survey.yaw, "b [nT]": survey.b_nt}


def written(path, columns, *, separator=",", decimal="."):
    rows = zip(*columns.values(), strict=True)
    lines = [separator.join(columns)]
    lines += [separator.join(repr(float(v)).replace(".", decimal) for v in row) for row in rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.fixture(scope="session")
def survey(tmp_path_factory):
    return read_survey(written(tmp_path_factory.mktemp("survey") / "a.csv", table(survey_drive())))


def as_micro_tesla(columns):
    return {
        ("b [uT]" if name == "b [nT]" else name): v / (1e3 if name == "b [nT]" else 1)
        for name, v in columns.items()
    }


def in_degrees(columns):
    return {
        ("yaw [deg]" if name == "yaw [rad]" else name): np.degrees(v) if name == "yaw [rad]" else v
        for name, v in columns.items()
    }


def in_centimetres(columns):
    return {name.replace("[m]", "[cm]"): 100 * v if "[m]" in name else v for name, v in columns.items()}


@pytest.mark.parametrize(
    ("change", "options"),
    [
        (as_micro_tesla, {}),
        (in_degrees, {}),
        (in_centimetres, {}),
        (lambda columns: dict(reversed(columns.items())), {}),
        (dict, {"separator": ";"}),
        (dict, {"separator": "\t"}),
        (dict, {"separator": ";", "decimal": ","}),
    ],
    ids=["uT", "degrees", "cm", "columns reversed", "semicolons", "tabs", "decimal commas"],
)
def test_a_survey_in_other_units_or_words_has_the_same_readings(survey, tmp_path, change, options):
    again = read_survey(written(tmp_path / "a.csv", change(table(survey_drive())), **options))
    assert_allclose(again.p_xy, survey.p_xy, atol=1e-9)
    assert_allclose(np.exp(1j * again.yaw), np.exp(1j * survey.yaw), atol=1e-9)
    assert_allclose(again.b_nt, survey.b_nt, rtol=1e-12)
    assert_allclose(np.diff(again.t), np.diff(survey.t), atol=1e-9)


def test_the_order_of_a_surveys_rows_changes_their_order_alone(survey, tmp_path):
    again = read_survey(written(tmp_path / "a.csv", table(permuted(survey_drive()))))
    order = np.argsort(again.t)
    assert_allclose(again.take(order).p_xy, survey.p_xy, atol=1e-12)
    assert_allclose(again.take(order).b_nt, survey.b_nt, rtol=1e-12)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet", ".mcap"])
def test_a_run_survives_another_format_and_back(tmp_path, suffix):
    run = drive(wavy_map(0), 3, seconds=4.0).readings
    write_run(run, tmp_path / f"run{suffix}")
    write_run(read_run(tmp_path / f"run{suffix}"), tmp_path / "again.npz")
    again = read_run(tmp_path / "again.npz")
    for name in run:
        assert_allclose(again[name], run[name], rtol=1e-9, atol=1e-9)
