import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from magtwin.errors import InputError
from magtwin.field.grid import Grid
from magtwin.field.survey.readings import SHAPES, Readings
from magtwin.field.survey.saved import load_readings, save_readings
from magtwin.files.file import sha256
from magtwin.frames import quat_from_rpy, quat_from_yaw, quat_multiply
from magtwin.io.surveys.columns import Columns
from magtwin.io.surveys.readings import read_readings

ROWS = "x,y,heading,field\n0,0,0.5,41000\n1,0,1.5,41500\n0,1,-3,40500\n"
WORLD = np.array([12_000.0, 20_000.0, -38_000.0])


def file(tmp_path, text, name="a.csv"):
    (tmp_path / name).write_text(text)
    return tmp_path / name


def same(a, b):
    """Whether two Readings are equal to the last bit."""
    arrays = all(
        (getattr(a, k) is None and getattr(b, k) is None)
        or (getattr(a, k).dtype == getattr(b, k).dtype and getattr(a, k).tobytes() == getattr(b, k).tobytes())
        for k in SHAPES
    )
    plain = ("runs", "grid", "height_m", "name", "source", "licence", "created")
    return arrays and all(getattr(a, k) == getattr(b, k) for k in plain)


def test_a_table_becomes_readings_with_file_and_checksum_as_their_source(tmp_path):
    path = file(tmp_path, ROWS)
    readings = read_readings(path, licence="CC0-1.0", created="2026-11-21", height_m=0.4, name="hall")
    assert_array_equal(readings.p_xy, [[0, 0], [1, 0], [0, 1]])
    assert_array_equal(readings.yaw, [0.5, 1.5, -3])
    assert_array_equal(readings.b_nt, [41_000, 41_500, 40_500])
    assert readings.source == f"a.csv sha256:{sha256(path)}"
    assert (readings.licence, readings.created, readings.height_m) == ("CC0-1.0", "2026-11-21", 0.4)
    assert (readings.name, readings.runs) == ("hall", ("a",))
    assert readings.b_body_nt is None
    assert readings.grid is None


def taken(readings):
    """What was repaired or deduced, by the source of readings."""
    return [part.removeprefix("taken ") for part in readings.source.split("; ") if part.startswith("taken ")]


@pytest.mark.parametrize(
    ("text", "notes"),
    [
        (
            "x [cm],y (mm),heading [deg],field [uT]\n0,0,0,41\n100,0,90,41.5\n",
            ["x [cm] and y (mm) by the units in their names", "heading [deg] in deg, by its name"],
        ),
        (
            "X_m;Y_m;YAW_deg;B\n0,0;0,0;0,0;41000,5\n1,0;0,0;90,0;41500,5\n",
            ["numbers with decimal", "YAW_deg"],
        ),
        (",y,x,theta,b_nt\n0,0,0,0,41000\n1,0,1,1.5707963267948966,41500\n", []),
    ],
)
def test_columns_are_read_by_the_names_and_units_of_their_header(tmp_path, text, notes):
    readings = read_readings(file(tmp_path, text))
    assert_allclose(readings.p_xy, [[0, 0], [1, 0]])
    assert_allclose(readings.yaw, [0, np.pi / 2])
    assert_allclose(readings.b_nt, [41_000, 41_500], atol=0.6)
    for note in notes:
        assert any(note in said for said in taken(readings))
    assert bool(notes) == bool(taken(readings))


@pytest.mark.parametrize(
    "header", ["east,north,cap,mag_1\ncm,mm,deg,uT", "east [cm],north (mm),cap [deg],mag_1 [uT]"]
)
@pytest.mark.parametrize("names", [("east", "north", "cap", "mag_1"), ("1", "2", "3", "4")])
def test_units_count_for_columns_that_an_option_names_without_them(tmp_path, header, names):
    path = file(tmp_path, f"{header}\n0,0,0,41\n100,0,90,41.5\n")
    readings = read_readings(
        path, columns=Columns(**dict(zip(("x", "y", "heading", "field"), names, strict=True)))
    )
    assert_allclose(readings.p_xy, [[0, 0], [1, 0]])
    assert_allclose(readings.yaw, [0, np.pi / 2])
    assert_allclose(readings.b_nt, [41_000, 41_500])


def test_a_survey_given_twice_counts_once(tmp_path):
    a, b = file(tmp_path, ROWS), file(tmp_path, ROWS, "b.csv")
    other = file(tmp_path, ROWS.replace("41500", "41600"), "c.csv")
    readings = read_readings(a, b, other)
    assert readings.runs == ("a", "c")
    assert taken(readings) == [f"{b} and {a} as one, since their bytes are equal"]


@pytest.mark.parametrize(
    ("value", "said", "wanted"),
    [("41", "nT", "uT"), ("4.1e-5", "nT", "T"), ("0.41", "nT", "G"), ("41000", "T", "nT")],
)
def test_a_mistaken_unit_is_refused_by_the_one_that_would_fit(tmp_path, value, said, wanted):
    path = file(tmp_path, f"x,y,yaw,field\n0,0,0,{value}\n")
    with pytest.raises(InputError, match=f"--unit {wanted}$"):
        read_readings(path, columns=Columns(unit=said))


@pytest.mark.parametrize(
    ("value", "unit", "factor"),
    [("41000", "nT", 1), ("41", "uT", 1e3), ("4.1e-5", "T", 1e9), ("410", "mG", 1e2), ("0.41", "G", 1e5)],
)
def test_a_unit_that_is_not_given_follows_from_the_size_and_is_told(tmp_path, value, unit, factor):
    readings = read_readings(file(tmp_path, f"x,y,yaw,field\n0,0,0,{value}\n"))
    assert_allclose(readings.b_nt, float(value) * factor)
    told = f"taken field in {unit}, by its size (--unit)"
    assert (told in readings.source) == (unit != "nT")


NAMES = ("b_total", "B", "|B|", "b_uT", "Total_Field", "Absolute field (\N{MICRO SIGN}T)", "TMI [uT]")
HEADERS = [
    *(f"Timestamp,x,y,Yaw,{name}" for name in NAMES),
    "t,p_world_base_x,p_world_base_y,yaw,BT",
    "time_ms,pos_x,pos_y,theta,field_ut",
    "t,pose.x,pose.y,yaw,mag",
    "Time (s);Rechtswert [m];Hochwert [m];heading;Feldst\u00e4rke [\u00b5T]",
    "t,Easting (m),Northing (m),yaw,F",
]


@pytest.mark.parametrize("header", HEADERS)
def test_columns_are_found_by_usual_names_whatever_wrote_them(tmp_path, header):
    separator = ";" if ";" in header else ","
    row = separator.join(["5500", "1", "2", ".25", "41"])
    (tmp_path / "a.csv").write_text(f"{header}\n{row}\n", encoding="cp1252")
    readings = read_readings(tmp_path / "a.csv")
    assert (readings.b_nt[0], readings.yaw[0]) == (41e3, 0.25)
    assert readings.p_xy.tolist() == [[1, 2]]
    assert readings.t[0] == (5.5 if "ms" in header else 5500)
    assert any(note.endswith("(--x, --y)") for note in taken(readings)) == ("x,y" not in header)


@pytest.mark.parametrize(
    ("header", "nt"),
    [
        ("Magnetic field x (\N{MICRO SIGN}T),MAGNETIC FIELD Y (uT),Magnetic field z (uT)", 1e3),
        ("/magnetic_field/x,/magnetic_field/y,/magnetic_field/z", 1e3),
        ("X_uT,Y_uT,Z_uT", 1e3),
        ("b_x_nT,b_y_nT,b_z_nT", 1),
        ("Bx (milligauss),By (milligauss),Bz (milligauss)", 1e2),
        ("Bx (gauss),By (gauss),Bz (gauss)", 1e5),
    ],
)
def test_components_are_found_by_the_names_and_units_of_phone_apps(tmp_path, header, nt):
    values = ",".join(repr(v / nt) for v in WORLD.tolist())
    readings = read_readings(file(tmp_path, f"Time (s),x (m),y (m),yaw,{header}\n0,1,2,0.5,{values}\n"))
    assert_allclose(readings.b_body_nt, [WORLD])
    assert_array_equal(readings.p_xy, [[1, 2]])


def test_components_are_found_by_their_usual_names_where_there_is_no_magnitude(tmp_path):
    rows = "timestamp,x,y,yaw,bx,by,bz\n0,0,0,0,3,4,-40\n"
    readings = read_readings(file(tmp_path, rows))
    assert_allclose(readings.b_body_nt, [[3e3, 4e3, -40e3]])
    assert "taken bx,by,bz as the field in the robot's axes" in readings.source
    both = read_readings(file(tmp_path, "x,y,yaw,field,bx,by,bz\n0,0,0,40000,3,4,-40\n"))
    assert both.b_body_nt is None, "a magnitude that is there is what is read"


NAMED = {"t_ms": 1e3, "time_ns": 1e9, "timestamp_us": 1e6, "Time since start in ms": 1e3, "timestamp": 1}
BY_SIZE = {"ms": 1e3, "us": 1e6, "ns": 1e9}
NOTE = "timestamp in {} since 1970, by its size"


@pytest.mark.parametrize(
    ("name", "ticks", "note"),
    [(name, ticks, None) for name, ticks in NAMED.items()]
    + [("timestamp", ticks, NOTE.format(unit)) for unit, ticks in BY_SIZE.items()],
)
@pytest.mark.parametrize("given", [False, True])
def test_times_are_read_in_the_unit_of_their_name_or_size(tmp_path, name, ticks, note, given):
    rows = "".join(f"{(1763800000 + k) * int(ticks)},0,0,0,41000\n" for k in range(3))
    path = file(tmp_path, f"{name},x,y,yaw,field\n{rows}")
    readings = read_readings(path, columns=Columns(time=name if given else ""))
    assert_allclose(readings.t - 1763800000, [0, 1, 2], atol=1e-6)
    assert taken(readings) == [note] * bool(note)


@pytest.mark.parametrize(("said", "fits"), [(None, "world"), ("body", "world"), ("world", "body")])
def test_vectors_in_other_axes_than_those_that_were_said_are_refused(tmp_path, said, fits):
    yaw = np.linspace(0, 6, 20)
    b = 20.0 * np.exp(1j * (1.2 - yaw * (fits == "body")))
    rows = "".join(f"0,0,{a:.4f},{c.real:.4f},{c.imag:.4f},-40\n" for a, c in zip(yaw, b, strict=True))
    path = file(tmp_path, "x,y,yaw,bx,by,bz\n" + rows)
    with pytest.raises(InputError, match=rf"a\.csv: bx,by,bz .* one direction .*give --axes {fits}"):
        read_readings(path, columns=Columns(axes=said))
    assert len(read_readings(path, columns=Columns(axes=fits))) == 20


@pytest.mark.parametrize("axes", ["body", "world"])
def test_vectors_that_are_mirrored_by_the_headings_are_refused_with_the_remedies(tmp_path, axes):
    yaw = np.linspace(0, 4.7, 20)
    b = 20.0 * np.exp(1j * (1.2 - yaw))
    rows = "".join(
        f"0,0,{90 - a:.3f},{c.real:.4f},{c.imag:.4f},-40\n" for a, c in zip(np.degrees(yaw), b, strict=True)
    )
    path = file(tmp_path, "x,y,heading,bx,by,bz\n" + rows)
    told = "one direction .100 % of them. if headings turn the other way.*forward, right, down: .*{}.*signs"
    with pytest.raises(InputError, match=told.format("give --heading-unit compass")):
        read_readings(path, columns=Columns(axes=axes, heading_unit="deg"))
    assert_allclose(read_readings(path, columns=Columns(heading_unit="compass")).yaw, yaw, atol=1e-4)
    rows = "".join(f"0,0,{a:.4f},{c.real:.4f},{-c.imag:.4f},40\n" for a, c in zip(yaw, b, strict=True))
    with pytest.raises(InputError, match=told.format("give --heading-unit compass")):
        read_readings(file(tmp_path, "x,y,yaw,bx,by,bz\n" + rows, "frd.csv"))


def test_compass_headings_count_clockwise_from_y(tmp_path):
    path = file(tmp_path, "x,y,heading,field\n0,0,0,41000\n1,0,90,41500\n")
    with pytest.raises(
        InputError, match=r"--heading-unit deg \(counter-clockwise .*compass \(clockwise from no"
    ):
        read_readings(path)
    assert_allclose(read_readings(path, columns=Columns(heading_unit="compass")).yaw, [np.pi / 2, 0])


def test_a_quaternion_is_taken_by_the_letters_of_its_names(tmp_path):
    path = file(tmp_path, "x,y,qw,qx,qy,qz,field\n0,0,0.8,0,0,0.6,41000\n")
    readings = read_readings(path, columns=Columns(quaternion="qw,qx,qy,qz"))
    assert_allclose(readings.yaw, [2 * np.arctan2(0.6, 0.8)])
    assert taken(readings) == ["qw,qx,qy,qz as qx,qy,qz,qw, by their names (--quaternion)"]


@settings(max_examples=30, deadline=None)
@given(yaw=st.floats(-3, 3), roll=st.floats(-0.3, 0.3), pitch=st.floats(-0.3, 0.3))
def test_a_vector_in_body_axes_with_a_quaternion_is_the_world_vector_turned_back_by_the_heading(
    tmp_path_factory, yaw, roll, pitch
):
    from magtwin.frames import quat_conjugate, rotate

    q = quat_multiply(quat_from_yaw(yaw), quat_from_rpy([roll, pitch, 0.0]))
    body = rotate(quat_conjugate(q), WORLD)
    folder = tmp_path_factory.mktemp("q")
    row = ",".join(repr(float(v)) for v in (0, 0, *q, *body))
    path = file(folder, f"x,y,qx,qy,qz,qw,bx,by,bz\n{row}\n")
    readings = read_readings(path, columns=Columns(quaternion="qx,qy,qz,qw", vector="bx,by,bz"))
    c, s = np.cos(yaw), np.sin(yaw)
    level = [c * WORLD[0] + s * WORLD[1], -s * WORLD[0] + c * WORLD[1], WORLD[2]]
    assert_allclose(readings.b_body_nt, [level], atol=1e-6)
    assert_allclose(np.cos(readings.yaw - yaw), 1, atol=1e-12)
    assert_allclose(readings.b_nt, np.linalg.norm(WORLD))


def test_a_vector_in_world_axes_needs_no_heading_and_turns_with_one(tmp_path):
    bare = file(tmp_path, "x,y,bx,by,bz\n0,0,12,20,-38\n")
    columns = Columns(vector="bx,by,bz", axes="world", unit="uT")
    assert_allclose(read_readings(bare, columns=columns).b_body_nt, [WORLD])
    turned = file(tmp_path, f"x,y,heading,bx,by,bz\n0,0,{np.pi / 2},12,20,-38\n", "b.csv")
    assert_allclose(read_readings(turned, columns=columns).b_body_nt, [[20_000, -12_000, -38_000]])


def test_magnitudes_of_a_sensor_carried_by_hand_need_no_heading(tmp_path):
    readings = read_readings(file(tmp_path, "x,y,field\n0,0,41\n1,0,42\n"), columns=Columns(heading="none"))
    assert_array_equal(readings.yaw, [0, 0])
    assert_array_equal(readings.b_nt, [41_000, 42_000])
    vectors = file(tmp_path, "x,y,bx,by,bz\n0,0,12,20,-38\n", "c.csv")
    readings = read_readings(vectors, columns=Columns(heading="none"))
    assert_allclose(readings.b_nt, np.linalg.norm(WORLD))
    assert readings.b_body_nt is None
    assert "the magnitude of bx,by,bz, since a sensor carried by hand has no heading" in taken(readings)


def test_rows_without_a_value_are_left_out_and_the_source_tells_how_many(tmp_path):
    path = file(tmp_path, ROWS + "2,2,,41000\n3,nan,0,41000\n4,4,0,\n")
    readings = read_readings(path)
    assert len(readings) == 3
    assert readings.source.endswith("(3 of 6 rows without a value left out)")
    with pytest.raises(InputError, match="no row is complete; all 1 have a cell"):
        read_readings(file(tmp_path, "x,y,heading,field\n0,0,0,nan\n", "b.csv"))


def test_files_joined_by_a_plus_stand_side_by_side(tmp_path):
    for name, text in (
        ("1-t.csv", "5\n6\n"),
        ("1-p.csv", "0,0\n1,0\n"),
        ("1-m.csv", "12,20,-38\n12,21,-38\n"),
    ):
        file(tmp_path, text, name)
    columns = Columns(time="1", x="2", y="3", vector="4,5,6", axes="world", unit="uT")
    readings = read_readings(f"{tmp_path / '1-t.csv'}+1-p.csv+1-m.csv", columns=columns)
    assert_allclose(readings.b_body_nt[1], [12_000, 21_000, -38_000])
    assert_array_equal(readings.t, [5, 6])
    assert readings.source.count("sha256:") == 3
    whole = "+".join(str(tmp_path / name) for name in ("1-t.csv", "1-p.csv", "1-m.csv"))
    assert same(read_readings(whole, columns=columns), readings)
    with pytest.raises(InputError, match=r"1-x\.csv: no such file of readings"):
        read_readings(f"{tmp_path / '1-t.csv'}+1-x.csv", columns=columns)
    file(tmp_path, "0,0\n", "1-q.csv")
    with pytest.raises(InputError, match=r"1-q\.csv: 1 rows, but .*1-t\.csv has 2"):
        read_readings(f"{tmp_path / '1-t.csv'}+1-q.csv", columns=columns)


def test_the_real_vector_survey_is_read_from_its_triples(real_data):
    data = real_data / "magnetic-data"
    sources = [f"{data / f'{k}-time.csv'}+{k}-loc.csv+{k}-mag.csv" for k in range(1, 6)]
    columns = Columns(time="1", x="2", y="3", vector="4,5,6", axes="world", unit="uT")
    readings = read_readings(*sources, columns=columns)
    assert len(readings) == 43_029
    assert np.bincount(readings.run).tolist() == [8_875, 9_105, 9_404, 7_332, 8_313]
    raw = np.loadtxt(data / "3-mag.csv", delimiter=",") * 1e3
    assert_allclose(readings.b_body_nt[readings.run == 2], raw, rtol=1e-15)
    assert_allclose(readings.b_nt[readings.run == 2], np.linalg.norm(raw, axis=1), rtol=1e-15)


def test_a_run_becomes_readings_at_the_true_poses_with_lost_lock_not_good(lab_scene, tmp_path):
    import magtwin
    from magtwin.io.tables import write_parquet

    run = magtwin.simulate(lab_scene, "figure8", seed=1, duration_s=4)
    lost = np.zeros(run.rows, bool)
    lost[10:20] = True
    b = run["b_measured_nt"].copy()
    b[3] = np.nan
    run = run.with_columns(flag_lost_lock=lost, b_measured_nt=b)
    write_parquet(run, tmp_path / "run.parquet")
    readings = read_readings(tmp_path / "run.parquet")
    kept = np.arange(run.rows) != 3
    assert_array_equal(readings.p_xy, run["p_world_base"][kept, :2])
    assert_array_equal(readings.b_nt, b[kept])
    assert_array_equal(readings.good, ~lost[kept])
    assert readings.source.endswith(f"(1 of {run.rows} rows without a value left out)")


@st.composite
def some_readings(draw):
    n = draw(st.integers(1, 6))
    number = st.floats(-1e3, 1e3)
    field = st.floats(1, 1e5)
    rows = lambda strategy, width: np.array(  # noqa: E731
        draw(st.lists(st.lists(strategy, min_size=width, max_size=width), min_size=n, max_size=n))
    )
    grid = draw(st.booleans())
    given = {"p_xy": rows(number, 2), "yaw": rows(number, 1)[:, 0], "b_nt": rows(field, 1)[:, 0]}
    if draw(st.booleans()):
        given["b_body_nt"] = rows(number, 3)
    if draw(st.booleans()):
        given["t"] = rows(number, 1)[:, 0]
    if grid:
        headings = (0.1, 2.5)
        given["grid"] = Grid(
            origin_m=(0.1, -0.3), cell_m=(0.25, 0.3), headings_rad=headings, rows=2, columns=3
        )
        given["node"] = np.column_stack([rows(st.integers(0, 1), 2), rows(st.integers(0, 2), 1)])
    return Readings(
        **given,
        run=rows(st.integers(0, 1), 1)[:, 0],
        runs=("a", draw(st.text(st.characters(codec="utf-8"), max_size=5))),
        good=rows(st.booleans(), 1)[:, 0],
        height_m=draw(st.none() | st.floats(0, 2)),
        name=draw(st.text(st.characters(codec="utf-8"), max_size=5)),
        source="a.csv sha256:0; b",
        licence="MIT",
        created="2026-11-21",
    )


@settings(max_examples=50, deadline=None)
@given(readings=some_readings())
def test_readings_survive_parquet_to_the_last_bit(tmp_path_factory, readings):
    path = tmp_path_factory.mktemp("r") / "a.parquet"
    save_readings(readings, path)
    assert same(load_readings(path), readings)
    assert same(read_readings(path), readings)


def test_the_same_readings_give_the_same_bytes_with_units_on_every_column(tmp_path):
    readings = read_readings(file(tmp_path, ROWS))
    for name in "ab":
        save_readings(readings, tmp_path / f"{name}.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    schema = pq.read_schema(tmp_path / "a.parquet")
    assert schema.field("b_nt").metadata[b"unit"] == b"nT"
    assert schema.field("p_xy_x").metadata[b"unit"] == b"m"
    assert json.loads(schema.metadata[b"magtwin_readings"])["source"] == readings.source
    with pytest.raises(InputError, match=r"a\.parquet: exists already; give `force=True`"):
        save_readings(readings, tmp_path / "a.parquet")


@pytest.mark.parametrize("change", ["{", "[]", "{}", '{"grid": {"rows": "no"}}', "null"])
def test_damaged_metadata_is_refused(tmp_path, change):
    readings = read_readings(file(tmp_path, ROWS))
    save_readings(readings, tmp_path / "a.parquet")
    table = pq.read_table(tmp_path / "a.parquet")
    pq.write_table(table.replace_schema_metadata({"magtwin_readings": change}), tmp_path / "b.parquet")
    with pytest.raises(InputError, match=r"b\.parquet: metadata 'magtwin_readings' is damaged"):
        read_readings(tmp_path / "b.parquet")


YES = "x,y,yaw,field\n0,0,0,41000\n"
BOTH = "x,y,yaw,field,bx,by,bz\n0,0,0,41000,12,20,-33\n1,0,0,41000,12,20,-33\n"
QUATERNION = "x,y,a,b,c,d,field\n0,0,0,0,0,1,41000\n0,0,1,1,0,0,41000\n"
REFUSALS = [
    ("x [px],y,yaw,b\n0,0,0,41000\n", {}, "in no unit of x"),
    ("x,y,yaw,field\n0,0,0,3\n", {}, "median of field is 3 nT"),
    ("u,y,yaw,field\n0,0,0,41000\n", {}, "no column of x .*--x NAME --y NAME"),
    ("x,y,yaw,qq\n0,0,0,41000\n", {}, "no column of the field .*--field NAME.*--vector BX,BY,BZ"),
    ("t,x,y,z,yaw\n0,12,20,-38,0\n", {"vector": "x,y,z"}, "'x' cannot be position and field"),
    ("7,8,0,41\n", {"x": "1", "y": "2", "heading": "3", "field": "1"}, "column '1' cannot be"),
    ("x,y,yaw,bx,by\n0,0,0,12,20\n", {"vector": "bx,by,bx"}, "'bx' cannot be field twice"),
    ("x,y,z,b,px,py,yaw\n12,20,-38,44.59,0,0,0\n", {}, "x, y and z are the components of b"),
    ("x,y,yaw,bx [uT],by [nT],bz [uT]\n0,0,0,12,20000,-38\n", {}, "units of .* differ"),
    (YES + "0,0,0,0\n", {}, "csv:3: a magnitude is above 0, got 0 nT"),
    ("x,y,yaw,field\n0,0,0,-41000\n", {}, "csv:2: a magnitude is above 0, got -41000"),
    (QUATERNION, {"quaternion": "a,b,c,d"}, "csv:3: a quaternion's length is 1, got 1.414"),
    (YES + "1e308,0,0,41000\n", {}, "csv:3: x and y are metres"),
    (BOTH, {"vector": "bx,by,bz", "field": "field"}, "0.000986 times as long as field"),
    ("x,y,yaw,field\n0,0,0,high\n", {}, "csv:2: field must be a finite number, got 'high'"),
    (YES, {"vector": "bx,by"}, "vector takes 3 columns"),
    (YES, {"quaternion": "q"}, "quaternion takes 4 columns"),
    (YES, {"quaternion": "a,b,c,d", "heading": "yaw"}, "either the heading's column or the quaternion's"),
    (YES, {"scale": 3.0, "unit": "uT"}, "the unit of the field or its scale"),
    (YES, {"scale": 0.0}, "scale, .* above 0, got 0"),
    ("x,y,yaw,b\n0,0,0,0.9\n1,0,1,1.1\n", {}, "normalised sensor give --scale"),
    ("x,y,yaw,b\n0,0,0,0.9\n1,0,1,1.1\n", {"scale": 3.0}, "--scale 50000 would make"),
]
"""A table, options, and words of what they are refused with."""


@pytest.mark.parametrize(("text", "options", "words"), REFUSALS, ids=range(len(REFUSALS)))
def test_a_table_that_makes_no_readings_is_refused(tmp_path, text, options, words):
    path = file(tmp_path, text)
    with pytest.raises(InputError, match=words):
        read_readings(path, columns=Columns(**options))


def test_a_gridded_survey_is_not_one_of_several_sources(tmp_path, real_data):
    with pytest.raises(InputError, match="survey 'maps' is gridded and cannot be one of several sources"):
        read_readings(real_data / "aprilab/maps", file(tmp_path, ROWS))


@pytest.mark.parametrize("every", [slice(2, None, 3), slice(25, None)])
def test_rows_of_two_units_are_refused_by_the_first_line_that_is_off_unless_the_unit_is_given(
    tmp_path, every
):
    b = 41_000 + np.arange(39.0)
    b[every] /= 1e3
    path = file(tmp_path, "x,y,yaw,field\n" + "".join(f"{k % 5},{k // 5},0,{v}\n" for k, v in enumerate(b)))
    line, count = every.start + 2, len(b[every]) - 1
    said = rf"a\.csv:{line}: field is 41\.0.* about 41,0.* it and {count} more would fit in uT.*--unit nT"
    with pytest.raises(InputError, match=said):
        read_readings(path)
    assert_allclose(read_readings(path, columns=Columns(unit="nT")).b_nt, b)


@pytest.mark.parametrize("header", ["b [uT]", "b"])
def test_a_path_that_passes_steel_is_read_though_its_readings_would_fit_in_another_unit(tmp_path, header):
    x = np.repeat(np.linspace(-2, 2, 400)[None], 4, axis=0)
    y = np.broadcast_to(np.array([[0.04], [0.4], [0.8], [1.2]]), x.shape)
    b = 45 + 3 / np.hypot(x, y) ** 3  # uT
    odd = np.abs(np.log10(b / 450)) < 0.3
    assert 0.01 < odd.mean() < 0.05
    assert b.mean() > 100 > np.median(b)
    rows = "".join(f"{u},{v},{w!r}\n" for u, v, w in zip(x.flat, y.flat, b.ravel().tolist(), strict=True))
    readings = read_readings(file(tmp_path, f"x,y,{header}\n{rows}"), columns=Columns(heading="none"))
    assert_allclose(readings.b_nt, 1e3 * b.ravel())


@pytest.mark.parametrize(("header", "unit"), [("b [uT]", None), ("b", "uT")])
def test_a_survey_beside_steel_is_read_in_the_unit_that_was_told_with_a_warning(tmp_path, header, unit):
    path = file(tmp_path, f"x,y,yaw,{header}\n0,0,0,247\n1,0,0,410\n1,1,0,230\n")
    readings = read_readings(path, columns=Columns(unit=unit))
    assert_allclose(readings.b_nt, [247_000, 410_000, 230_000])
    assert "is 247000 nT, outside 10,000..100,000 nT, in mG it would be 24,700 nT" in readings.source


def test_a_scale_takes_the_values_of_a_normalised_sensor_to_nt(tmp_path):
    path = file(tmp_path, "x,y,yaw,b,bx,by,bz\n0,0,0,0.9,0.3,0.2,-0.8\n1,0,1,1.1,0.5,0,-1\n")
    scaled = read_readings(path, columns=Columns(field="b", scale=45_000.0))
    assert_allclose(scaled.b_nt, [40_500, 49_500])
    body = read_readings(path, columns=Columns(vector="bx,by,bz", scale=45_000.0)).b_body_nt
    assert_allclose(body, 45_000 * np.array([[0.3, 0.2, -0.8], [0.5, 0, -1]]))


def test_a_pattern_stands_for_the_files_that_match_it_in_the_order_of_their_names(tmp_path, monkeypatch):
    files = [file(tmp_path, ROWS.replace("0,0,0.5", f"{k},0,0.5"), f"drive_{k}.csv") for k in (2, 0, 1)]
    want = read_readings(*sorted(files))
    assert want.runs == ("drive_0", "drive_1", "drive_2")
    assert same(read_readings(tmp_path / "drive_*.csv"), want)
    monkeypatch.chdir(tmp_path)
    assert same(read_readings("drive_?.csv"), want)
    with pytest.raises(InputError, match=r"^no file or folder matches 'nowhere/\*\.csv'; check the pattern$"):
        read_readings("nowhere/*.csv")
