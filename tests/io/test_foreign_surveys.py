"""Surveys as other programs write them: phones, vehicles, spreadsheets, words of five languages."""

import csv
import io
import itertools
import struct
import zipfile

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_allclose

from magtwin.errors import InputError
from magtwin.field.survey.readings import taken_of
from magtwin.io.formats import read_run
from magtwin.io.info import info_of
from magtwin.io.surveys.columns import Columns
from magtwin.io.surveys.doctor import examine
from magtwin.io.surveys.maps import import_survey
from magtwin.io.surveys.places import on_tangent_plane
from magtwin.io.surveys.readings import read_readings
from magtwin.path.points import read_path_csv
from magtwin.usd.maps.layer import load_map

START_NS = 1_760_000_000_000_000_000
EARTH = np.array([20_500.0, 2_400.0, -41_000.0])
CORNERS = np.array([[0, 0], [4, 0], [4, 1], [0, 1], [0, 2], [4, 2]], float)


def walk(rate=20.0, speed=0.5, pause_s=0.0):
    """Times, places, vectors [nT] and marks (t, x, y) of a walk past corners, with a pause within a leg."""
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(CORNERS, axis=0), axis=1))])
    times = way / speed + pause_s * (np.arange(len(way)) > 2)
    t = np.arange(0, times[-1], 1 / rate)
    middle = (times[2] + times[3] - pause_s) / 2
    moved = t - np.clip(t - middle, 0, pause_s)
    p = np.column_stack([np.interp(moved, way / speed, part) for part in CORNERS.T])
    r = np.column_stack([p, np.zeros(len(p))]) - [1.7, 0.6, -1.0]
    d = np.linalg.norm(r, axis=1, keepdims=True)
    m = np.array([5.0, -3.0, 12.0])
    b = EARTH + 100 * (
        3 * r * (r @ m)[:, None] / d**5 - m / d**3
    )  # a dipole: mu0 / 4 pi = 100 nT m^3/(A m^2)
    return t, p, b, np.column_stack([times, CORNERS])


def text(header, rows, between=",", decimal="."):
    cells = [[c if isinstance(c, str) else repr(c).replace(".", decimal) for c in row] for row in rows]
    out = io.StringIO()
    csv.writer(out, delimiter=between, lineterminator="\n").writerows([header, *cells])
    return out.getvalue()


def number(array, digits=9):
    return [[round(float(v), digits) for v in row] for row in array]


def phyphox(folder, t, b, marks):
    size = np.linalg.norm(b, axis=1) / 1e3
    names = [*(f"Magnetic Field {a} (\u00b5T)" for a in "xyz"), "Absolute field (\u00b5T)"]
    folder.mkdir(exist_ok=True)
    (folder / "Raw Data.csv").write_text(
        text(["Time (s)", *names], number(np.column_stack([t, b / 1e3, size])))
    )
    (folder / "marks.csv").write_text(text(["t", "x", "y"], number(marks)))
    return folder / "Raw Data.csv", folder / "marks.csv"


def sensor_logger(folder, t, b, marks):
    folder.mkdir(exist_ok=True)
    stamp = [START_NS + round(s * 1e9) for s in t]
    rows = [[ns, s, *v] for ns, s, v in zip(stamp, t.tolist(), number(b[:, ::-1] / 1e3), strict=True)]
    (folder / "Magnetometer.csv").write_text(text(["time", "seconds_elapsed", "z", "y", "x"], rows))
    (folder / "MagnetometerUncalibrated.csv").write_text(
        text(["time", "seconds_elapsed", "z", "y", "x"], [[*row[:2], 0.1, 0.2, 0.3] for row in rows])
    )
    notes = [[START_NS + round(s * 1e9), s, f"{x:g}, {y:g}"] for s, x, y in marks.tolist()]
    (folder / "Annotation.csv").write_text(text(["time", "seconds_elapsed", "text"], notes))
    return folder


def android(file, t, b, marks):
    lines = ["#\tstartTime:1760000000000"]
    lines += [f"{1_760_000_000_000 + 1e3 * s:.0f}\tTYPE_MAGNETIC_FIELD\t{x}\t{y}\t{z}\t3" for s, (x, y, z) in
              zip(t, number(b / 1e3), strict=True)]  # fmt: skip
    lines += [f"{1_760_000_000_000 + 1e3 * s:.0f}\tTYPE_WAYPOINT\t{x}\t{y}" for s, x, y in marks]
    file.write_text("\n".join(lines))
    return file


def rows_of_marks(file, t, b, marks):
    rows = [[s, *v, "", ""] for s, v in zip(t.tolist(), number(b / 1e3), strict=True)]
    rows += [[s, "", "", "", x, y] for s, x, y in marks.tolist()]
    file.write_text(text(["time", "mag_x", "mag_y", "mag_z", "x", "y"], sorted(rows, key=lambda row: row[0])))
    return file


def read_as(dialect, tmp_path, **kind):
    """Readings of a walk in a dialect, with its true times, places and vectors."""
    t, p, b, marks = walk(**kind)
    options = {}
    match dialect:
        case "phyphox":
            source, options["waypoints"] = phyphox(tmp_path / "a", t, b, marks)
        case "sensor logger":
            source = sensor_logger(tmp_path / "a", t, b, marks)
        case "zip":
            source = tmp_path / "walk.zip"
            with zipfile.ZipFile(source, "w") as archive:
                for file in sensor_logger(tmp_path / "a", t, b, marks).iterdir():
                    archive.write(file, f"2026-03-01/{file.name}")
                archive.writestr("meta/device.csv", "property,value\nbrand,acme\n")
        case "android":
            source = android(tmp_path / "trace.txt", t, b, marks)
        case "rows":
            source = rows_of_marks(tmp_path / "one.csv", t, b, marks)
    return read_readings(source, **options), t, p, b


@pytest.mark.parametrize("dialect", ["phyphox", "sensor logger", "zip", "android", "rows"])
def test_the_walk_of_a_phone_is_placed_by_its_marks(tmp_path, dialect):
    readings, t, p, b = read_as(dialect, tmp_path)
    at = readings.t - readings.t[0] + t[0]
    assert len(readings) >= len(t) - 1
    assert_allclose(readings.p_xy, np.column_stack([np.interp(at, t, part) for part in p.T]), atol=1e-3)
    assert_allclose(readings.b_nt, np.interp(at, t, np.linalg.norm(b, axis=1)), atol=1.0)
    assert readings.by_hand
    assert readings.b_body_nt is None
    assert any("6 marks" in note for note in taken_of(readings))


def test_a_walker_who_stood_still_is_placed_where_he_stood(tmp_path):
    rng = np.random.default_rng(2)
    t, p, b, marks = walk(pause_s=6.0)
    folder = sensor_logger(tmp_path / "a", t, b, marks)
    still = np.linalg.norm(np.gradient(p, t, axis=0), axis=1) < 0.1
    shake = rng.normal(0, 1, (len(t), 3)) * np.where(still, 0.05, 2.0)[:, None]
    rows = [[START_NS + round(s * 1e9), s, *v] for s, v in zip(t.tolist(), number(shake), strict=True)]
    (folder / "Accelerometer.csv").write_text(text(["time", "seconds_elapsed", "z", "y", "x"], rows))
    known = read_readings(folder)
    (folder / "Accelerometer.csv").unlink()
    unknown = read_readings(folder)
    for readings, by in ((known, "by the acceleration"), (unknown, "by a field that did not change")):
        assert any("1 pauses" in note and by in note for note in taken_of(readings))
        assert np.linalg.norm(readings.p_xy - p[: len(readings)], axis=1).max() < 0.5  # 1.5 without pauses


def test_a_walk_of_a_phone_becomes_a_map_at_the_first_command(tmp_path):
    t, p, b, marks = walk(rate=4.0)
    source, waypoints = phyphox(tmp_path / "a", t, b, marks)
    report = import_survey([source], tmp_path / "m.usdc", waypoints=waypoints)
    field = load_map(tmp_path / "m.usdc")
    error = field.lookup(p, np.zeros(len(p))) - np.linalg.norm(b, axis=1)
    assert np.sqrt(np.nanmean(error**2)) < 60
    assert "offset sd [nT]" not in field.parameters
    assert any("carried by hand" in note for note in report.metadata["taken"])


NAMES = [
    ("Easting (m)", "Northing (m)", "TMI (nT)"),
    ("Rechtswert [m]", "Hochwert [m]", "Feldst\u00e4rke [\u00b5T]"),
    ("Ost [m]", "Nord [m]", "Totalintensit\u00e4t [nT]"),
    ("abscisse (m)", "ordonn\u00e9e (m)", "Champ magn\u00e9tique total (nT)"),
    ("Este (m)", "Norte (m)", "Campo magn\u00e9tico total (\u00b5T)"),
    ("Est", "Nord", "Intensit\u00e0 totale (nT)"),
    ("UTM_E", "UTM_N", "nT"),
    ("Pos X [cm]", "Pos Y [cm]", "|B| [uT]"),
]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_names_encodings_separators_and_decimals_are_found(tmp_path, encoding):
    x, y, b = 0.5 * np.arange(12), 0.25 * np.arange(12) % 1, 48_000.0 + np.arange(12)
    for names, between, decimal in itertools.product(NAMES, ",;\t", ".,"):
        if between == decimal:
            continue
        factor = 1e-3 if ("T]" in names[2] and "n" not in names[2][-4:]) or "\u00b5" in names[2] else 1.0
        metre = 100.0 if "cm" in names[0] else 1.0
        rows = number(np.column_stack([metre * x, metre * y, factor * b]), 6)
        (tmp_path / "a.csv").write_bytes(text(names, rows, between, decimal).encode(encoding))
        readings = read_readings(tmp_path / "a.csv")
        assert_allclose(readings.p_xy, np.column_stack([x, y]), err_msg=str(names))
        assert_allclose(readings.b_nt, b, err_msg=str(names))
        said = any("text in" in note for note in taken_of(readings))
        assert said == (
            encoding.startswith("utf-16") or (encoding == "cp1252" and not "".join(names).isascii())
        )


def test_latitude_and_longitude_become_metres_on_a_plane_that_is_named(tmp_path):
    """One minute of latitude at 45 deg is 1,852.2 m on WGS 84, and one of longitude 1,314.2 m."""
    lat, lon = 45 + np.array([-0.5, 0.5, 0, 0]) / 60, 11 + np.array([0, 0, -0.5, 0.5]) / 60
    p, origin = on_tangent_plane(lat, lon)
    assert_allclose(p, [[0, -926.1], [0, 926.1], [-657.1, 0], [657.1, 0]], atol=0.3)
    assert origin == "tangent plane of WGS 84 at 45, 11 deg"
    rows = number(np.column_stack([lat, lon, [48_000, 48_100, 48_200, 48_300]]), 12)
    (tmp_path / "a.csv").write_text(text(["Latitude", "Longitude", "mag_tmi"], rows))
    readings = read_readings(tmp_path / "a.csv")
    assert_allclose(readings.p_xy, p, atol=1e-6)
    assert (readings.frame, readings.datum) == ("world: x east, y north", origin)


def test_a_grid_in_a_table_keeps_its_values(tmp_path):
    x, y = (a.ravel() for a in np.meshgrid(np.arange(9) * 50.0, np.arange(7) * 40.0))
    b = 48_000 + 120 * np.sin(x / 160) * np.cos(y / 210)
    (tmp_path / "a.csv").write_text(text(["x", "y", "b_total"], number(np.column_stack([x, y, b]), 4)))
    import_survey([tmp_path / "a.csv"], tmp_path / "m.usdc")
    field = load_map(tmp_path / "m.usdc")
    assert field.cell_m == (50.0, 40.0)
    assert_allclose(field.values_nt[0].ravel(), b, atol=1e-4)


def ulog(path, t, p, b_nt, yaw):
    """A ULog of the three topics that are read; the body turns about the vertical."""
    formats = {
        "vehicle_magnetometer": "uint64_t timestamp;float[3] magnetometer_ga;",
        "vehicle_local_position": "uint64_t timestamp;float x;float y;",
        "vehicle_attitude": "uint64_t timestamp;float[4] q;",
    }

    def message(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    out = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + message("B", bytes(40))
    out += b"".join(message("F", f"{name}:{fields}".encode()) for name, fields in formats.items())
    out += b"".join(message("A", struct.pack("<BH", 0, k) + name.encode()) for k, name in enumerate(formats))
    for s, (x, y), v, angle in zip(t, p, b_nt, yaw, strict=True):
        us = round(1e6 * s)
        half = (np.pi / 2 - angle) / 2
        body = (
            v[0] * np.cos(angle) + v[1] * np.sin(angle),
            v[0] * np.sin(angle) - v[1] * np.cos(angle),
            -v[2],
        )
        contents = (
            struct.pack("<Q3f", us, *(c / 1e5 for c in body)),
            struct.pack("<Q2f", us, y, x),
            struct.pack("<Q4f", us, np.cos(half), 0, 0, np.sin(half)),
        )
        for k, content in enumerate(contents):
            out += message("D", struct.pack("<H", k) + content)
    path.write_bytes(out)


def dataflash(path, t, lat, lon, b_nt, yaw):
    """A DataFlash log of MAG, POS and ATT."""
    kinds = {"MAG": (130, "Qfff", "TimeUS,MagX,MagY,MagZ"), "POS": (131, "QLL", "TimeUS,Lat,Lng"),
             "ATT": (132, "Qfff", "TimeUS,Roll,Pitch,Yaw")}  # fmt: skip
    sizes = {"Q": 8, "f": 4, "L": 4, "B": 1}
    formats = {"FMT": (128, "BBnNZ", "Type,Length,Name,Format,Columns"), **kinds}
    out = b""
    for name, (number_, form, labels) in formats.items():
        length = 89 if name == "FMT" else 3 + sum(sizes[c] for c in form)
        head = struct.pack("<BB4s16s64s", number_, length, name.encode(), form.encode(), labels.encode())
        out += b"\xa3\x95\x80" + head
    for s, la, lo, v, angle in zip(t, lat, lon, b_nt, yaw, strict=True):
        us = round(1e6 * s)
        forward, left = (
            v[0] * np.cos(angle) + v[1] * np.sin(angle),
            v[1] * np.cos(angle) - v[0] * np.sin(angle),
        )
        out += b"\xa3\x95\x82" + struct.pack("<Qfff", us, forward / 100, -left / 100, -v[2] / 100)
        out += b"\xa3\x95\x83" + struct.pack("<Qii", us, round(la * 1e7), round(lo * 1e7))
        out += b"\xa3\x95\x84" + struct.pack("<Qfff", us, 0, 0, np.degrees(np.pi / 2 - angle) % 360)
    path.write_bytes(out)


@pytest.mark.parametrize("kind", ["ulg", "bin", "h5"])
def test_the_log_of_a_vehicle_becomes_readings(tmp_path, kind):
    pytest.importorskip({"ulg": "pyulog", "bin": "pymavlink", "h5": "h5py"}[kind])
    t, p, b, _ = walk()
    yaw = np.linspace(0, 5, len(t))
    path, where = tmp_path / f"log.{kind}", p
    if kind == "ulg":
        ulog(path, t, p, b, yaw)
    elif kind == "bin":
        lat, lon = 47 + p[:, 1] / 111_200, 8 + p[:, 0] / 75_900
        dataflash(path, t, lat, lon, b, yaw)
        where, _ = on_tangent_plane(lat, lon)
    else:
        import h5py

        with h5py.File(path, "w") as file:
            for name, values in {
                "tt": t,
                "utm_x": p[:, 0],
                "utm_y": p[:, 1],
                "mag_1_uc": np.linalg.norm(b, axis=1),
            }.items():
                file[name] = values
    readings = read_readings(path)
    assert_allclose(readings.p_xy, where, atol=0.02)
    assert_allclose(readings.b_nt, np.linalg.norm(b, axis=1), atol=2.0)
    assert readings.by_hand == (kind == "h5")
    if kind != "h5":
        assert_allclose(np.exp(1j * readings.yaw), np.exp(1j * yaw), atol=1e-3)
        c, s = np.cos(yaw), np.sin(yaw)
        level = np.column_stack([c * b[:, 0] + s * b[:, 1], c * b[:, 1] - s * b[:, 0], b[:, 2]])
        assert_allclose(readings.b_body_nt, level, atol=2.0)


def test_a_spreadsheet_is_read_like_its_csv(tmp_path):
    pytest.importorskip("python_calamine")
    xlsxwriter = pytest.importorskip("xlsxwriter")
    book = xlsxwriter.Workbook(tmp_path / "a.xlsx")
    book.add_worksheet("About").write(0, 0, "Hall 3, March")
    sheet = book.add_worksheet("Data")
    for k, row in enumerate(
        [["Easting (m)", "Northing (m)", "TMI (nT)"], [0, 0, 48_000.5], [1, 0, 48_100], [0, 1, 48_200]]
    ):
        sheet.write_row(k, 0, row)
    book.close()
    assert_allclose(read_readings(tmp_path / "a.xlsx").b_nt, [48_000.5, 48_100, 48_200])


def test_a_trajectory_of_euroc_is_a_path(tmp_path):
    header = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
    )
    rows = [f"{START_NS + k},{x},{y},0.5,1,0,0,0" for k, (x, y) in enumerate(CORNERS.tolist())]
    (tmp_path / "a.csv").write_text("\n".join([header, *rows]))
    with pytest.warns(match="p_RS_R_x"):
        assert_allclose(read_path_csv(tmp_path / "a.csv").p_xy, CORNERS)


@pytest.mark.parametrize("step_m", [None, 0.5])
def test_marks_without_times_are_passed_at_a_steady_pace_or_by_steps(tmp_path, step_m):
    t, p, b, marks = walk(rate=50.0)
    folder = sensor_logger(tmp_path / "a", t, b, marks)
    (folder / "Annotation.csv").unlink()
    falls = 9.81 + 5 * np.clip(np.sin(2 * np.pi * t), -0.6, 1)  # one step a second, at 0.5 m/s
    rows = [
        [START_NS + round(s * 1e9), s, a, 0.0, 0.0] for s, a in zip(t.tolist(), falls.tolist(), strict=True)
    ]
    (folder / "Accelerometer.csv").write_text(text(["time", "seconds_elapsed", "z", "y", "x"], rows))
    (tmp_path / "marks.csv").write_text(text(["x", "y"], number(CORNERS)))
    readings = read_readings(folder, waypoints=tmp_path / "marks.csv", step_m=step_m)
    at = np.column_stack([np.interp(readings.t - readings.t[0], t, part) for part in p.T])
    assert len(readings) > 0.95 * len(t)
    assert np.linalg.norm(readings.p_xy - at, axis=1).max() < (0.05 if step_m is None else 1.0)
    assert any("steps of 0.5 m" in note for note in taken_of(readings)) == (step_m is not None)
    with pytest.raises(InputError, match="drop --step-m"):
        read_readings(folder, waypoints=tmp_path / "marks.csv", step_m=-1.0)


@pytest.mark.filterwarnings("ignore:.* read :magtwin.errors.RepairWarning")
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_row_for_each_value_and_whole_numbers_are_read(tmp_path, suffix):
    t, file = np.arange(150), tmp_path / f"a{suffix}"
    x, b = t // 10, 48_000 + t
    names, cells = np.tile(["x", "y", "field"], len(t)), np.stack([x, 2 * x + t % 2, b], axis=1).ravel()
    if suffix == ".csv":
        rows = zip(np.repeat(t, 3).tolist(), names.tolist(), cells.tolist(), strict=True)
        file.write_text(text(["time", "variable", "value"], rows))
    else:
        pq.write_table(pa.table({"time": np.repeat(t, 3), "variable": names, "value": cells}), file)
    readings, run = read_readings(file), read_run(file)
    assert_allclose(readings.b_nt, b)
    assert_allclose(readings.p_xy, np.column_stack([x, 2 * x + t % 2]))
    assert_allclose(run["p_world_base"][:, :2], readings.p_xy)
    assert_allclose(run["b_measured_nt"], b)


REFUSED = [
    ("t,bx,by,bz\n0,1,2,40\n1,1,2,40\n", "t,x,y\n100,0,0\n200,1,1\n", "have no time in common"),
    ("t,bx,by,bz\n0,1,2,40\n1,1,2,40\n", "t,x,y\n0,0,0\n", "1 mark; a walk needs two"),
    ("t,bx,by,bz\n0,1,2,40\n1,1,2,40\n", "t,x,y\n0,0,0\n0,1,1\n", "two marks at 0 s"),
    ("t,bx,by,bz\n0,1,2,40\n1,1,2,40\n", "a,b\n0,0\n1,1\n", "no marks; a row is t,x,y"),
    ("bx,by,bz\n1,2,40\n1,2,40\n", "t,x,y\n0,0,0\n1,1,1\n", "no column of time"),
    ("t,bx,by,bz\n0,1,2,40\n1,1,2,40\n", None, "--waypoints FILE"),
]


@pytest.mark.parametrize(("log", "marks", "words"), REFUSED, ids=range(len(REFUSED)))
def test_a_walk_without_places_is_refused_with_the_way_on(tmp_path, log, marks, words):
    (tmp_path / "log.csv").write_text(log)
    if marks:
        (tmp_path / "marks.csv").write_text(marks)
    with pytest.raises(InputError, match=words):
        read_readings(tmp_path / "log.csv", waypoints=tmp_path / "marks.csv" if marks else None)


@pytest.mark.parametrize("content", [b"PK\x03\x04 not an archive", b""], ids=["damaged", "empty"])
def test_a_damaged_archive_is_refused(tmp_path, content):
    (tmp_path / "a.zip").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.zip"):
        read_readings(tmp_path / "a.zip")


def test_an_archive_without_a_field_is_refused_by_what_it_holds(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("Location.csv", "time,latitude,longitude\n0,1,2\n1,1,2\n")
    with pytest.raises(InputError, match="no table of a magnetic field in it; it holds Location"):
        read_readings(tmp_path / "a.zip")


def test_the_doctor_finds_step_hard_iron_and_a_stuck_sensor():
    rng = np.random.default_rng(1)
    yaw = np.cumsum(rng.normal(0, 0.05, 4000))
    iron = np.array([900.0, -400.0])
    b = np.column_stack(
        [20_000 * np.cos(yaw) + iron[0], -20_000 * np.sin(yaw) + iron[1], np.full(4000, -41_000.0)]
    )
    b = np.round((b + rng.normal(0, 60, b.shape)) / 150) * 150
    b[1000:1400] = b[1000]
    report = examine(vector_nt=b, t=np.arange(4000) / 50, yaw=yaw, roles=("odometry",))
    value = {figure.name: figure.value for figure in report.figures}
    assert value["sensor's step"] == 150
    assert value["stuck readings"] == pytest.approx(400, abs=2)
    assert_allclose([float(v.replace(",", "")) for v in value["hard iron"].split(", ")], iron, atol=30)
    assert value["rate"] == 50
    assert report.metadata["fit for localization"] == "yes"
    assert report.metadata["fit for a map"] == "no, because it has no pose"


def test_info_of_a_log_says_what_it_is_fit_for_and_what_to_type(tmp_path):
    t, _, b, marks = walk()
    source, waypoints = phyphox(tmp_path / "a", t, b, marks)
    report = info_of(source)
    assert report.metadata["fit for a map"].startswith("no, because it has no pose")
    assert report.metadata["next"].endswith("--waypoints MARKS.csv")
    assert info_of(source, waypoints=waypoints).metadata["fit for a map"] == "yes"
    told = info_of(source, columns=Columns(unit="nT"))
    assert "--unit nT --waypoints" in told.metadata["next"]
    assert next(f.value for f in told.figures if f.name == "range") == "45 to 46"
    holes = source.read_text().splitlines()
    source.write_text(
        "\n".join(line.rpartition(",")[0] + "," if k % 10 == 3 else line for k, line in enumerate(holes))
    )
    values = {f.name: f.value for f in info_of(source, waypoints=waypoints).figures}
    assert values["finite readings"] == pytest.approx(90, abs=0.5)
    with pytest.raises(InputError, match="no bag; drop --field-topic"):
        info_of(source, topics={"/robot/enu/pose": "/a"})
    waypoints.unlink()
    folder = sensor_logger(tmp_path / "b", t, b, marks)
    assert info_of(folder).metadata["fit for a map"] == "yes"
