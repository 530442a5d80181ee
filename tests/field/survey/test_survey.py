import math
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.field.survey.folder import read_grid
from magtwin.field.survey.nodes import node_map, read_survey
from magtwin.field.survey.readings import Readings, taken_of
from magtwin.files.file import sha256

HEADER = "# x,y,theta,scalar_mag \n"
ROWS = {0: (41_000, 41_200, 40_900, 41_100), 90: (41_010, 41_210, 40_910, 41_110)}
NODES = ((0.0, 0.0), (0.5, 0.0), (0.0, 0.5), (0.5, 0.5))


def layer_text(heading_deg, values=(41_000, 41_200, 40_900, 41_100)):
    theta = np.radians(heading_deg)
    rows = [f"{x},{y},{theta},{v}\n" for (x, y), v in zip(NODES, values, strict=True)]
    return HEADER + "".join(rows)


def write_survey(folder, headings=(0, 90, 180, 270), **changed):
    """A whole survey of 2 x 2 nodes; `changed` gives other text, or None, for files by name."""
    folder.mkdir(exist_ok=True)
    texts = {f"{h}_map.csv": layer_text(h) for h in headings}
    texts |= {f"{name.removeprefix('h')}_map.csv": text for name, text in changed.items()}
    for name, text in texts.items():
        if isinstance(text, bytes):
            (folder / name).write_bytes(text)
        elif text is not None:
            (folder / name).write_text(text)
    return folder


def figures(report):
    return {f.name: f for f in report.figures}


def test_a_survey_becomes_a_map_with_the_files_as_its_source(tmp_path):
    folder = write_survey(tmp_path / "hall")
    field = read_survey(folder, licence="CC0-1.0")[0]
    assert field.values_nt.shape == (4, 2, 2)
    assert_array_equal(field.values_nt[1], [[41_000, 41_200], [40_900, 41_100]])
    assert_allclose(field.headings_rad, np.radians([0, 90, 180, 270]), atol=0)
    assert (field.origin_m, field.cell_m) == ((0.0, 0.0), (0.5, 0.5))
    assert (field.name, field.licence) == ("hall", "CC0-1.0")
    assert f"90_map.csv sha256:{sha256(folder / '90_map.csv')}" in field.source
    assert field.valid.all()
    assert field.variance_nt2 is None


def test_rows_may_come_in_any_order(tmp_path):
    lines = layer_text(90).splitlines(keepends=True)
    shuffled = lines[0] + "".join(lines[i] for i in (4, 2, 1, 3)) + "\n"
    plain = read_survey(write_survey(tmp_path / "plain"))[0]
    mixed = read_survey(write_survey(tmp_path / "mixed", h90=shuffled))[0]
    assert_array_equal(plain.values_nt, mixed.values_nt)


def test_headings_need_not_be_four_when_they_are_even_or_named(tmp_path):
    eight = write_survey(tmp_path / "eight", headings=[45 * k for k in range(8)])
    assert len(read_survey(eight)[0].headings_rad) == 8
    two = write_survey(tmp_path / "two", headings=(0, 180))
    assert len(read_survey(two, headings_deg=(0, 180))[0].headings_rad) == 2
    with pytest.raises(InputError, match="heading 90, 270 deg missing, found 0, 180"):
        read_survey(two)[0]


def test_the_report_tells_the_worst_heading_and_repeated_readings(tmp_path):
    stuck = layer_text(90, (35_600, 35_600, 40_000, 41_000))
    lines = stuck.splitlines(keepends=True)
    lines[3] = f"0.0,0.5,{np.radians(90 - 20)},40000\n"
    got = figures(read_survey(write_survey(tmp_path, h90="".join(lines)))[1])
    assert got["largest heading deviation"].value == pytest.approx(20, abs=1e-3)
    assert got["largest heading deviation"].note == "90_map.csv:4, at (0, 0.5) m"
    assert got["median heading deviation"].value == 0
    assert got["repeated readings"].value == 1


def test_the_real_survey_has_the_published_figures(real_data):
    folder = real_data / "aprilab/maps"
    field, report = read_survey(folder, name="aprilab", licence="MIT", keep_stuck=True)
    assert field.valid.all()
    assert field.values_nt.shape == (4, 15, 25)
    assert field.extent == (-3.0, 3.0, -1.75, 1.75)
    table = np.loadtxt(folder / "270_map.csv", delimiter=",")
    assert_array_equal(field.values_nt[3].ravel(), table[:, 3])  # x fastest
    assert "05d12029c4703c9aa83eb0b25b394356c9f64c08ebf513a07a99e847ec969b56" in field.source

    got = figures(report)
    assert got["mean"].value == pytest.approx(40_943, abs=1)
    assert got["heading amplitude"].value == pytest.approx(482, abs=1)
    assert 4.1 < got["median gradient"].value < 4.4
    assert got["mean gradient"].value == pytest.approx(5.75, abs=0.05)
    assert got["greatest gradient"].value == pytest.approx(36, abs=0.5)
    assert 5 < got["median heading deviation"].value < 11
    assert got["largest heading deviation"].value == pytest.approx(53, abs=0.5)
    assert got["largest heading deviation"].note.startswith("90_map.csv:")
    assert got["repeated readings"].value > 10


def test_a_surveys_stuck_nodes_are_not_valid_unless_they_are_to_be_kept(real_data):
    folder = real_data / "aprilab/maps"
    field, report = read_survey(folder)
    assert np.count_nonzero(~field.valid.any(axis=0)) == 17
    assert np.isnan(field.lookup([-1.25, 1.5], [0, np.pi / 2, np.pi])).all()
    kept, again = read_survey(folder, keep_stuck=True)
    assert kept.valid.all()
    assert_array_equal(kept.values_nt, field.values_nt)
    assert figures(report)["stuck readings"] == figures(again)["stuck readings"]


def test_readings_of_a_grid_stand_on_its_nodes_with_recorded_headings_one_run_a_file(tmp_path):
    turned = layer_text(90).replace(str(np.radians(90)), "1.5")
    readings = read_grid(write_survey(tmp_path, h90=turned), created="2024-05-01", height_m=0.3)
    assert readings.runs == ("0_map.csv", "90_map.csv", "180_map.csv", "270_map.csv")
    assert_array_equal(readings.yaw[readings.run == 1], 1.5)
    assert_array_equal(readings.node[5], [1, 0, 1])
    assert_array_equal(readings.p_xy[5], [0.5, 0.0])
    assert (readings.created, readings.height_m) == ("2024-05-01", 0.3)
    assert readings.good.all()
    field = node_map(readings)
    assert (field.created, field.height_m, field.source) == ("2024-05-01", 0.3, readings.source)


def test_a_node_is_the_mean_of_its_good_readings_and_not_valid_without_any(tmp_path):
    readings = read_grid(write_survey(tmp_path))
    twice = readings.take([*range(16), 0, 1]).with_(b_nt=[*readings.b_nt, 41_100, 43_000])
    good = np.ones(18, bool)
    good[[17, 3]] = False
    field = node_map(twice.with_(good=good))
    assert field.values_nt[0, 0].tolist() == [41_050, 41_200]
    assert np.flatnonzero(~field.valid.ravel()).tolist() == [3]
    assert field.values_nt[0, 1, 1] == 41_100
    gone = node_map(readings.take(np.arange(16) != 3))
    assert np.flatnonzero(~gone.valid.ravel()).tolist() == [3]


def test_readings_that_stand_on_no_grid_make_no_nodes():
    with pytest.raises(InputError, match=r"survey 'mow' is not gridded.*fit_map"):
        node_map(Readings(p_xy=[[0, 0]], yaw=[0], b_nt=[41_000], name="mow"))


ROW2 = "0.5,0.0,1.5707963267948966,41200\n"  # line 3 of 90_map.csv

REFUSALS = {
    "missing folder": (None, r"maps: no such survey folder"),
    "file for a folder": ("a file", r"not a folder; give the one that holds 0_map\.csv"),
    "no csv": ({}, r"no survey file in it, such as 0_map\.csv; it is empty"),
    "other csv only": (
        {"north.csv": "x,y\n"},
        r"no survey file in it, such as 0_map\.csv; it holds north\.csv",
    ),
    "heading missing": (
        {"90_map.csv": None},
        r"heading 90 deg missing, found 0, 180, 270; expected 90_map\.csv",
    ),
    "headings uneven": (
        {"90_map.csv": None, "100_map.csv": ""},
        r"headings 0, 100, 180, 270 deg are not even",
    ),
    "heading unnamed": (
        {"west_map.csv": ""},
        r"west_map\.csv: named after its heading.*'west'",
    ),
    "heading of a full turn": (
        {"360_map.csv": ""},
        r"360_map\.csv: named after its heading.*got '360'",
    ),
    "heading twice": ({"90.0_map.csv": ""}, r"heading 90 has two files, the other is 90\.0_map\.csv"),
    "empty file": ({"90_map.csv": " \n"}, r"90_map\.csv: empty; expected the line '# x,y,theta,scalar_mag'"),
    "header only": ({"90_map.csv": HEADER}, r"90_map\.csv: empty; expected the line"),
    "no header": (
        {"90_map.csv": ROW2},
        r"90_map\.csv: must have the columns x,y,theta,scalar_mag, got '1,2,3,4'",
    ),
    "not text": ({"90_map.csv": b"\x89PNG\r\n\x1a\n\xff\xfe"}, r"90_map\.csv: not a text file"),
    "ragged row": ((ROW2, "0.5,0.0,41200\n"), r"90_map\.csv:3: 4 values expected, got 3$"),
    "non-numeric row": (
        (ROW2, "0.5,0.0,east,41200\n"),
        r"90_map\.csv:3: theta must be a finite number, got 'east'$",
    ),
    "nan": (
        (ROW2, "0.5,0.0,1.57,nan\n"),
        r"90_map\.csv:3: scalar_mag is missing, got 'nan'; every node needs",
    ),
    "infinite": ((ROW2, "inf,0.0,1.57,41200\n"), r"90_map\.csv:3: x must be a finite number"),
    "negative magnitude": ((ROW2, "0.5,0.0,1.57,-41200\n"), r"90_map\.csv:3: scalar_mag is a magnitude"),
    "hole": ((ROW2, ""), r"90_map\.csv: 1 of 4 nodes have no row, the first at \(0\.5, 0\)"),
    "two values for a node": (
        (ROW2, ROW2 + "0.5,0.0,1.57,41201\n"),
        r"90_map\.csv:4: node \(0\.5, 0\) has a value already, on line 3",
    ),
    "cut short": (
        {"90_map.csv": HEADER + "".join(f"{k},0,1.57,4100{k}.5\n" for k in range(9)) + "9,0,1.57,41"},
        r"90_map\.csv:11: scalar_mag is missing, .* its 41 is far below all other values",
    ),
    "another grid": (
        ("0.5,", "0.6,"),
        r"90_map\.csv: its grid differs from 0_map\.csv's: x has 0\.\.0\.6 m in 2 nodes, there 0\.\.0\.5 m",
    ),
    "uneven grid": (
        (ROW2, ROW2 + "0.9,0.0,1.57,41201\n"),
        r"90_map\.csv: x steps by .* m, but from 0(\.5)? to 0\.[59]; a line of nodes is missing",
    ),
    "a line instead of a grid": (
        {"90_map.csv": HEADER + "0,0,1.57,41000\n0.5,0,1.57,41000\n"},
        r"90_map\.csv: all rows have y = 0; a map needs two rows",
    ),
    "tesla": ("scaled", 1e-9, r"median of scalar_mag is 4\.105e-05 nT.*in T it would be 41,050 nT"),
    "uT": ("scaled", 1e-3, r"median of scalar_mag is 41\.05.*in uT it would be 41,050 nT"),
    "mG": ("scaled", 1e-2, r"median of scalar_mag is 410\.5.*in mG it would be 41,050 nT"),
    "pT": ("scaled", 1e3, r"median of scalar_mag is 4\.105e\+07 nT, outside .* no usual unit"),
}


def write_refused(folder, case):
    change = REFUSALS[case][0]
    if change is None:
        return
    if change == "a file":
        folder.write_text("x")
        return
    if case in ("no csv", "other csv only"):
        folder.mkdir()
    else:
        write_survey(folder)
    if change == "scaled":
        values = [v * REFUSALS[case][1] for v in (41_000, 41_200, 40_900, 41_100)]
        change = {"90_map.csv": layer_text(90, values)}
    if isinstance(change, tuple):
        text = (folder / "90_map.csv").read_text()
        assert change[0] in text
        change = {"90_map.csv": text.replace(*change)}
    for name, text in change.items():
        if text is None:
            (folder / name).unlink()
        elif isinstance(text, bytes):
            (folder / name).write_bytes(text)
        else:
            (folder / name).write_text(text)


@pytest.mark.parametrize("case", REFUSALS)
def test_a_survey_is_refused_in_one_line_that_says_where(tmp_path, case):
    folder = tmp_path / "maps"
    write_refused(folder, case)
    with pytest.raises(InputError) as refusal:
        read_survey(folder)
    text = str(refusal.value)
    assert re.search(REFUSALS[case][-1], text), text
    assert text.startswith(str(folder))
    assert "\n" not in text


def in_degrees(text):
    """A file of a survey with its headings in degrees."""
    rows = (line.split(",") for line in text.splitlines()[1:])
    return HEADER + "".join(f"{x},{y},{math.degrees(float(theta))!r},{b}\n" for x, y, theta, b in rows)


def test_headings_in_degrees_are_told_by_the_names_of_the_files(tmp_path):
    plain = read_grid(write_survey(tmp_path / "plain"))
    texts = {f"h{h}": in_degrees(layer_text(h)) for h in (0, 90, 180, 270)}
    readings = read_grid(write_survey(tmp_path / "degrees", **texts))
    assert_allclose(readings.yaw, plain.yaw)
    assert taken_of(readings) == ["theta in deg, by its size and the names of the files"]
    assert not taken_of(plain)
    wrong = in_degrees(layer_text(143))
    with pytest.raises(
        InputError, match=r"0_map\.csv:2: theta 143 is beyond a full turn in radians, and in deg"
    ):
        read_grid(write_survey(tmp_path / "wrong", **dict.fromkeys(texts, wrong)))
    turns = layer_text(90 + 720)
    assert_allclose(read_grid(write_survey(tmp_path / "turns", h90=turns)).yaw[4:8], np.radians(810))


def test_headings_far_from_the_names_of_the_files_are_a_doubt(tmp_path):
    swapped = {f"h{h}": layer_text((90 - h) % 360) for h in (0, 90, 180, 270)}
    report = read_survey(write_survey(tmp_path, **swapped))[1]
    (doubt,) = report.metadata["doubts"]
    assert doubt.startswith("4 of 4 headings are recorded otherwise than their files are named")
    assert "doubts" not in read_survey(write_survey(tmp_path))[1].metadata
