"""Surveys below titles and headers, as grids, named arrays and lines of JSON: equal to one plain table."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.io import savemat

from magtwin.errors import InputError
from magtwin.io.surveys.readings import read_readings

N = 60
T = np.arange(N) / 10
P = np.column_stack([np.linspace(0.5, 6.4, N), 1 + 0.01 * np.arange(N)])
B = 49_000 + 300 * np.sin(P[:, 0])
EARTH = np.array([0.1, 0.4, -0.911043357914])  # a unit vector


def dms(degrees, letter):
    minutes, seconds = divmod(3600 * degrees, 60)
    return f"{minutes // 60:.0f}\u00b0{minutes % 60:02.0f}'{seconds:08.5f}\"{letter}"


def lines(rows, header, between):
    return "\n".join([*header, *(between.join(f"{v:.4f}" for v in row) for row in rows), ""])


def labview():
    head = ["LabVIEW Measurement\t", "Separator\tTab", "Date\t2023/10/05", "***End_of_Header***\t", "\t"]
    head += ["Channels\t5\t\t\t\t\t", "Samples" + f"\t{N}" * 5 + "\t"]
    head += ["Y_Unit_Label\tuT\tuT\tuT\tmm\tmm\t", "X_Value\tBx\tBy\tBz\tStage X\tStage Y\tComment"]
    return lines(np.column_stack([T, B[:, None] * EARTH / 1e3, 1e3 * P]), head, "\t")


def dump():
    head = [f"key {k} = {k * k}; of 3" for k in range(70)] + ["Time;X;Y;Total field", "s;m;m;nT"]
    return lines(np.column_stack([T, P, B]), head, ";").replace(".", ",")


def geometrics():
    return lines(np.column_stack([P, B, T, T]), ["   X     Y   READING  TIME  MARK"], "  ")


@pytest.mark.parametrize("make", [labview, dump, geometrics])
def test_tables_below_titles_and_headers(tmp_path, make):
    (tmp_path / "survey.dat").write_text(make())
    readings = read_readings(tmp_path / "survey.dat")
    assert_allclose(readings.p_xy, P, atol=1e-4)
    assert_allclose(readings.b_nt, B, atol=0.2)


def test_angles_with_minutes_and_seconds_are_degrees(tmp_path):
    lat, lon = 52.2681 + P[:, 1] / 111_276, 10.5264 + P[:, 0] / 68_266
    rows = [
        f"{k};08:05:{t:04.1f};{dms(a, 'N')};{dms(o, 'E')};{b:.2f}".replace(".", ",")
        for k, (t, a, o, b) in enumerate(zip(T, lat, lon, B, strict=True))
    ]
    text = ["Rilievo;Prato;;;", "Punto;Ora;Latitudine;Longitudine;Campo totale (nT)", *rows]
    (tmp_path / "prato.csv").write_bytes("\n".join(text).encode("cp1252"))
    readings = read_readings(tmp_path / "prato.csv")
    assert_allclose(readings.p_xy - readings.p_xy.mean(axis=0), P - P.mean(axis=0), atol=1e-3)
    assert_allclose(readings.b_nt, B, atol=0.01)
    assert_allclose(np.diff(readings.t), 0.1, atol=1e-6)


def test_sentences_of_nmea_are_refused_with_the_way_on(tmp_path):
    (tmp_path / "b.log").write_text("$PMAGF,080000.00,49001.9,nT*6E\n$SDDBT,10.3,f,3.1,M*30\n" * 5)
    with pytest.raises(InputError, match=r"b.log:1: sentences of NMEA 0183; .* time,lat,lon,field"):
        read_readings(tmp_path / "b.log")


def test_a_damaged_row_is_no_end_of_a_header(tmp_path):
    rows = [f"{k},{k},49000" for k in range(20)]
    (tmp_path / "s.csv").write_text("\n".join(["x,y,field", *rows[:5], "1,2", *rows]))
    with pytest.raises(InputError, match=r"s.csv:7: 3 values expected, got 2"):
        read_readings(tmp_path / "s.csv")


def surfer():
    head = "DSAA\n4 3\n0 3\n10 12\n0 1\n49001 49002 49003 49004\n"
    return head + "49005 1.70141e+038 49007\n49008 49009 49010 49011 49012\n"


def esri():
    head = "ncols 4\nnrows 3\nxllcorner -0.5\nyllcorner 9.5\ncellsize 1\nNODATA_value -9999\n"
    return head + "49009 49010 49011 49012\n49005 -9999 49007 49008\n49001 49002 49003 49004\n"


@pytest.mark.parametrize(("make", "name"), [(surfer, "g.grd"), (esri, "g.asc")])
def test_grids_are_their_nodes(tmp_path, make, name):
    (tmp_path / name).write_text(make())
    readings = read_readings(tmp_path / name)
    x, y = np.meshgrid(np.arange(4.0), 10 + np.arange(3.0))
    known = np.arange(12) != 5
    assert_allclose(readings.p_xy, np.column_stack([x.ravel(), y.ravel()])[known])
    assert_allclose(readings.b_nt, 49_001 + np.arange(12.0)[known])


def test_lines_of_json_with_places_in_another_file(tmp_path):
    objects = [{"boot": "1.0"}] + [
        {"rx": 1.7e9 + t, "air": {"C": 20}, **dict(zip(("mx", "my", "mz"), b / 1e3 * EARTH, strict=True))}
        for t, b in zip(T, B, strict=True)
    ]
    (tmp_path / "mag.jsonl").write_text("\n".join(map(json.dumps, objects)) + '\n{"rx": 17')
    marks = lines(np.column_stack([T, P])[[0, -1]], ["t,x,y"], ",")
    (tmp_path / "marks.csv").write_text(marks)
    readings = read_readings(tmp_path / "mag.jsonl", waypoints=tmp_path / "marks.csv")
    assert_allclose(readings.p_xy, P, atol=1e-3)
    assert_allclose(readings.b_nt, B, atol=0.01)
    tags = [f"{t},{tag},{x if tag else 0},{y}" for t, (x, y) in zip(T, P, strict=True) for tag in (0, 7)]
    (tmp_path / "tags.csv").write_text("\n".join(["t,tag_id,x,y", *tags]))
    (tmp_path / "marks.csv").unlink()
    with pytest.raises(InputError, match=r"tags.csv: .*--waypoints"):
        read_readings(tmp_path)


@pytest.mark.parametrize("axis", [0, 1])
def test_arrays_of_matlab(tmp_path, axis):
    mag, pos = B[:, None] * EARTH, np.column_stack([P, np.zeros(N)])
    data = {"t": T, "mag": mag.T if axis else mag, "pos": pos.T if axis else pos, "fs": 10.0}
    savemat(tmp_path / "run.mat", {"data": data, "info": "mag in nT", "m_offset": np.zeros(3)})
    readings = read_readings(tmp_path / "run.mat")
    assert_allclose(readings.p_xy, P)
    assert_allclose(readings.b_nt, B)
    assert_allclose(readings.t, T)


def test_groups_of_hdf5_are_joined_by_their_clocks(tmp_path):
    h5py = pytest.importorskip("h5py")
    ns = 1_700_000_000_000_000_000 + np.round(1e9 * T).astype(np.int64)
    with h5py.File(tmp_path / "session.h5", "w") as file:
        file["magnetometer/timestamp"], file["magnetometer/data"] = ns, B[:, None] * EARTH / 1e9
        file["magnetometer/data"].attrs["units"] = "T"
        file["pose/timestamp"], file["pose/position"] = ns[::2], np.column_stack([P, P[:, 0]])[::2]
        file["pose/orientation_xyzw"] = np.tile([0.0, 0, 0, 1], (N // 2, 1))
        file["calibration/mag"] = np.zeros((3, 3))
    readings = read_readings(tmp_path / "session.h5")
    assert_allclose(readings.p_xy, P[: N - 1], atol=1e-6)
    assert_allclose(readings.b_nt, B[: N - 1])
    (tmp_path / "settings.mat").write_bytes(b"MATLAB 5.0")
    with pytest.raises(InputError, match=r"settings.mat: damaged, or no file of arrays"):
        read_readings(tmp_path / "settings.mat")
