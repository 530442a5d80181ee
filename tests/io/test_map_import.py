"""`magtwin map import`, `fit` and `check`: any survey in, what is broken in it said and masked."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusing import refused
from test_stuck import gridded

from magtwin.author.earth import earth_of
from magtwin.cli import main
from magtwin.field.sources.earth import earth_field_nt
from magtwin.field.survey.saved import load_readings, save_readings
from magtwin.io.map_files import open_map
from magtwin.io.surveys.axes import vector_doubts
from magtwin.usd.maps.layer import load_map
from magtwin.usd.scene import read_scene


def run(*arguments):
    main([str(a) for a in arguments])


def test_latched_nodes_leave_the_layers_valid_ones_and_can_be_kept(tmp_path, capsys, real_data):
    maps = real_data / "aprilab/maps"
    run("map", "import", maps, "--out", tmp_path / "a.usdc", "--licence", "MIT", "--json")
    report = json.loads(capsys.readouterr().out)
    field = load_map(tmp_path / "a.usdc")
    assert report["figures"]["stuck_at_every_heading_nodes"] == 17
    assert report["figures"]["masked_nodes"] == np.count_nonzero(~field.valid) > 68
    assert np.isnan(field.lookup([-1.25, 0.75], 0.0))
    assert_array_equal(field.valid, open_map(maps).valid)
    run("map", "import", maps, "--out", tmp_path / "b.usdc", "--keep-stuck", "--json")
    whole = load_map(tmp_path / "b.usdc")
    assert whole.valid.all()
    assert whole.lookup([-1.25, 0.75], 0.0) == pytest.approx(35_602.1, abs=0.1)
    report = json.loads(capsys.readouterr().out)
    assert report["figures"]["stuck_at_every_heading_nodes"] == 17


def test_readings_kept_as_parquet_make_the_same_layer_as_the_folder_and_keep_what_was_said(
    tmp_path, capsys, real_data
):
    maps = real_data / "aprilab/maps"
    about = ("--created", "2024-05-01", "--height-m", "0.35", "--licence", "MIT")
    about += ("--frame", "world: x east, y north, z up", "--datum", "the door")
    run("map", "import", maps, "--out", tmp_path / "a.parquet", *about)
    run("map", "import", tmp_path / "a.parquet", "--out", tmp_path / "b.usdc", "--name", "lab")
    run("map", "import", maps, "--out", tmp_path / "c.usdc", "--name", "lab", *about)
    run("map", "fit", tmp_path / "a.parquet", "--method", "trilinear", "--out", tmp_path / "d.usdc")
    capsys.readouterr()
    fields = [load_map(tmp_path / f"{name}.usdc") for name in "bcd"]
    assert load_readings(tmp_path / "a.parquet").good.sum() == np.count_nonzero(fields[0].valid)
    assert fields[0] == fields[1]
    for field in fields:
        said = (field.created, field.licence, field.frame, field.datum)
        assert said == ("2024-05-01", "MIT", about[7], "the door")
        assert field.height_m == pytest.approx(0.35)
    run("map", "validate", tmp_path / "a.parquet", "--method", "trilinear", "--json")
    report = json.loads(capsys.readouterr().out)
    assert report["figures"]["readings_predicted"] == np.count_nonzero(fields[0].valid)


def test_a_table_becomes_a_file_of_readings_by_its_column_names(tmp_path, capsys):
    (tmp_path / "a.csv").write_text("px,py,deg,b\n0,0,10,41\n1,0,20,42\n")
    columns = ["--x", "px", "--y", "py", "--heading", "deg", "--heading-unit", "deg"]
    columns += ["--field", "b", "--unit", "uT"]
    run("map", "import", tmp_path / "a.csv", "--out", tmp_path / "a.parquet", *columns, "--json")
    figures = json.loads(capsys.readouterr().out)["figures"]
    assert figures["readings"] == 2
    readings = load_readings(tmp_path / "a.parquet")
    assert_array_equal(readings.b_nt, [41_000, 42_000])
    assert_allclose(readings.yaw, np.radians([10, 20]))


REFUSED = [
    ("import a.csv --x px", "no column 'px'; did you mean 'x'"),
    ("import a.csv --vector a,b", "vector takes 3 columns"),
    ("import a.csv --unit uT", "give --unit nT"),
    ("import m.usdc", "m.usdc: is a USD file, not a source of readings"),
    ("import b.csv", "b.csv: no such source of readings"),
    ("import a.csv+b.csv", "b.csv: no such file of readings"),
    ("import a.csv --out a.txt", "ends in .usdc"),
    ("import a.csv --out a.usdc", "2 of 2 readings are good", "a map needs 8 at least"),
    ("import a.csv --created yesterday", "--created must be a day YYYY-MM-DD"),
    ("import a.csv --height-m -1", "--height-m", "0 m or more, got -1"),
    ("import a.csv --height-m nan", "--height-m", "got nan"),
    ("fit a.csv", "2 of 2 readings are good", "needs 8"),
    ("fit a.csv --headings-deg north", "headings are degrees"),
    ("fit a.csv --headings-deg 0,nan", "headings are degrees"),
    ("fit a.csv --method cubic --kernel matern", "--kernel is for --method gp; drop it"),
    ("fit a.csv --method gp --earth 20000,0,-40000", "--earth is for --method harmonic; drop it"),
    ("fit a.csv --earth 1,2,south", "--earth is a scene; latitude"),
    ("fit a.csv --earth 0,0,0", "earth_nt must be three numbers"),
    ("fit a.csv --earth 29.65,-82.35,50", "is a field of 100.8 nT"),
    ("fit a.csv --earth 29,-82,50,2050-01-01", "lies beyond the IGRF-14"),
    ("fit a.csv --earth lab.usda", "no file 'lab.usda'"),
    ("fit deg.csv", "--heading-unit deg"),
    ("fit uv.csv", "--x NAME --y NAME"),
    ("fit strength.csv", "--field NAME", "magtwin map import strength.csv"),
]
"""Commands below `magtwin map`, and words of their refusals."""

SOURCES = {
    "a.csv": "x,y,yaw,field\n0,0,0,41000\n1,0,0,41500\n",
    "deg.csv": "x,y,yaw,field\n0,0,90,41000\n",
    "uv.csv": "u,v,yaw,field\n0,0,0,41000\n",
    "strength.csv": "x,y,yaw,qq\n0,0,0,41000\n",
    "m.usdc": "PXR-USDC",
}


@pytest.mark.parametrize(("command", "words"), [(c, w) for c, *w in REFUSED], ids=lambda x: str(x)[:50])
def test_what_makes_no_readings_or_map_is_refused_in_one_line(tmp_path, monkeypatch, capsys, command, words):
    monkeypatch.chdir(tmp_path)
    for name, text in SOURCES.items():
        (tmp_path / name).write_text(text)
    arguments = command.split()
    if "--out" not in arguments:
        arguments += ["--out", "new.parquet" if arguments[0] == "import" else "new.usdc"]
    line = refused(capsys, "map", *arguments)
    assert all(word in line for word in words), line
    assert {p.name for p in tmp_path.iterdir()} == SOURCES.keys()


def test_a_survey_whose_sensor_was_stuck_throughout_is_refused_unless_it_is_to_be_kept(tmp_path, capsys):
    readings = gridded(0)
    save_readings(readings.with_(b_nt=np.full(len(readings), 41_000.0)), tmp_path / "a.parquet")
    arguments = ("map", "import", tmp_path / "a.parquet", "--out", tmp_path / "a.usdc")
    line = refused(capsys, *arguments)
    assert f"all {len(readings)} readings come from a sensor that was stuck" in line
    assert "--keep-stuck" in line
    run(*arguments, "--keep-stuck")
    assert load_map(tmp_path / "a.usdc").valid.all()


def test_a_sensor_whose_vector_turns_is_not_stuck_though_its_magnitude_stays_to_the_last_digit(tmp_path):
    (tmp_path / "a.csv").write_text(
        "t,x,y,yaw,b_nt,bx,by,bz\n"
        + "".join(
            f"{k},{k % 15 / 5},{k // 15 / 5},{k % 4 * np.pi / 2},50000,"
            f"{30_000 * np.cos(k % 4 * np.pi / 2)},{-30_000 * np.sin(k % 4 * np.pi / 2)},-40000\n"
            for k in range(150)
        )
    )
    options = ("--field", "b_nt", "--vector", "bx,by,bz")
    run("map", "import", tmp_path / "a.csv", "--out", tmp_path / "a.parquet", *options)
    run("map", "fit", tmp_path / "a.parquet", "--method", "trilinear", "--out", tmp_path / "a.usdc")
    assert_allclose(load_map(tmp_path / "a.usdc").lookup([1.0, 1.0], 0.0), 50_000, rtol=1e-9)


def test_repeats_of_a_fast_logger_are_counted_and_a_fit_that_lacks_readings_names_the_masked(
    tmp_path, capsys
):
    b = np.repeat(np.random.default_rng(0).normal(45_000, 500, 30), 2)
    rows = [f"{k / 10},{k % 7 / 5},0,{k / 10},{v:.1f}" for k, v in enumerate(b)]
    (tmp_path / "a.csv").write_text("\n".join(["x,y,yaw,t,field", *rows]))
    run("map", "import", tmp_path / "a.csv", "--out", tmp_path / "a.parquet", "--json")
    report = json.loads(capsys.readouterr().out)
    assert "one reading of each value, 30 of 60" in report["metadata"]["taken"][-1]
    assert len(load_readings(tmp_path / "a.parquet")) == 30
    run("map", "import", tmp_path / "a.csv", "--out", tmp_path / "b.parquet", "--keep-stuck")
    assert len(load_readings(tmp_path / "b.parquet")) == 60
    few = load_readings(tmp_path / "b.parquet").with_(good=np.arange(60) < 5)
    save_readings(few, tmp_path / "few.parquet")
    line = refused(capsys, "map", "fit", tmp_path / "few.parquet", "--out", tmp_path / "c.usdc")
    assert "5 of 60 readings are good, 55 are masked as stuck (--keep-stuck keeps them)" in line


def test_the_earths_field_is_taken_from_a_place_and_day_as_numbers_or_from_a_scene(lab_scene):
    place = earth_of("29.64, -82.35, 50, 2024-06-01")
    assert place == earth_field_nt(29.64, -82.35, 50.0, "2024-06-01")
    assert earth_of("-2700,24000,-38400") == (-2700.0, 24000.0, -38400.0)
    assert earth_of(str(lab_scene)) == read_scene(lab_scene, check_network=False).earth.b_world_nt


def test_a_survey_of_a_twin_knows_the_earths_field_and_keeps_it(tmp_path, capsys, lab_scene):
    out = tmp_path / "a.parquet"
    run("map", "survey", lab_scene, "--out", out, "--spacing-m", "1", "--readings", "1")
    assert load_readings(out).earth_nt == read_scene(lab_scene, check_network=False).earth.b_world_nt


def test_vectors_and_headings_that_contradict_each_other_are_a_doubt(tmp_path, capsys):
    rng = np.random.default_rng(0)
    yaw, b = rng.uniform(-3, 3, 40), 20 * np.exp(1j * rng.uniform(-3, 3, 40))
    rows = "".join(
        f"{k},0,{a},{c.real},{c.imag},{-40 - k / 9}\n" for k, (a, c) in enumerate(zip(yaw, b, strict=True))
    )
    (tmp_path / "hall.csv").write_text("x,y,heading,bx,by,bz\n" + rows)
    run("map", "import", tmp_path / "hall.csv", "--out", tmp_path / "a.parquet", "--json")
    (doubt,) = json.loads(capsys.readouterr().out)["metadata"]["doubts"]
    assert doubt.startswith("vectors keep no direction in world axes (")
    (fitted,) = vector_doubts(load_readings(tmp_path / "a.parquet"))
    assert fitted == doubt
