import io
import json
import resource
import signal
import subprocess
import sys
import zipfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magtwin.errors import InputError, RepairWarning
from magtwin.io.formats import read_run
from magtwin.io.tables import (
    ParquetParts,
    read_csv,
    read_npz,
    read_parquet,
    write_csv,
    write_npz,
    write_parquet,
)
from magtwin.run.run import COLUMNS, Run

TABLES = [
    (write_parquet, read_parquet, "run.parquet"),
    (write_csv, read_csv, "run.csv"),
    (write_npz, read_npz, "run.npz"),
]
NAMES = [name for _, _, name in TABLES]
FACTS = {"path": "figure8", "seed": 7, "speed": 0.2, "quick": True, "network": "größe"}


def some_run(rows=50, seed=0):
    """A run with every column of COLUMNS, random numbers in it, and nan where a run may have them."""
    rng = np.random.default_rng(seed)
    columns = {}
    for name, column in COLUMNS.items():
        shape = (rows,) if column.width == 1 else (rows, column.width)
        columns[name] = rng.random(shape) < 0.5 if column.unit == "bool" else rng.normal(0, 1e4, shape)
    columns["t"] = 2.0 + np.cumsum(rng.uniform(0.001, 0.01, rows))
    columns["b_sd_nt"][::3] = np.nan
    columns["b_vector_nt"][:] = np.nan
    columns["v_cmd"][:4] = [np.inf, -np.inf, -0.0, 5e-324][:rows]
    return Run(columns, FACTS)


def assert_same(a, b):
    assert list(a) == list(b)
    assert dict(a.metadata) == dict(b.metadata)
    for name in a:
        assert a[name].dtype == b[name].dtype, name
        assert a[name].shape == b[name].shape, name
        assert a[name].tobytes() == b[name].tobytes(), name


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "run.parquet"
    write_parquet(some_run(), path)
    return path


def test_every_field_says_its_unit_frame_and_meaning(written):
    schema = pq.read_schema(written)
    assert schema.field("odom_v_y").metadata == {
        b"column": b"odom_v",
        b"part": b"y",
        b"unit": b"m/s",
        b"frame": b"base_link",
        b"doc": b"odometry's linear velocity",
    }
    assert {(f.metadata or {})[b"column"].decode() for f in schema} == set(COLUMNS)
    assert json.loads(schema.metadata[b"magtwin_facts"]) == FACTS


def test_floats_are_zstd_in_byte_stream_split_and_nothing_is_nullable(written):
    group = pq.ParquetFile(written).metadata.row_group(0)
    for i in range(group.num_columns):
        column = group.column(i)
        assert column.compression == "ZSTD"
        if column.physical_type == "DOUBLE":
            assert "BYTE_STREAM_SPLIT" in column.encodings
    assert not any(field.nullable for field in pq.read_schema(written))


def test_a_file_rewritten_without_metadata_is_still_a_run(written, tmp_path):
    bare = pq.read_table(written).replace_schema_metadata(None)
    bare = pa.table({name: bare.column(name) for name in reversed(bare.column_names)})
    pq.write_table(bare, tmp_path / "bare.parquet")
    run = read_parquet(tmp_path / "bare.parquet")
    assert not run.metadata
    for name, values in some_run().items():
        assert np.array_equal(run[name], values, equal_nan=True), name


def table(**columns):
    return lambda path: pq.write_table(pa.table(columns), path)


def changed(change):
    def write(path):
        write_parquet(some_run(), path)
        path.write_bytes(change(path.read_bytes()))

    return write


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: None, "no such Parquet file"),
        (lambda path: path.mkdir(), "a folder without Parquet parts"),
        (changed(lambda content: b""), "not a Parquet file"),
        (changed(lambda content: b"t,b_total_nt\n0,41000\n"), "not a Parquet file: it begins with"),
        (changed(lambda content: content[:-100]), "cut short"),
        (changed(lambda content: content[:4] + bytes(1996) + content[2000:]), "damaged Parquet"),
        (table(clock=[0.0, 1.0], b=[1.0, 2.0]), "column 't' is missing"),
        (table(t=[0.0], odom_p_x=[1.0]), "column 'odom_p_y' is missing beside 'odom_p_x'"),
        (table(t=["now", "then"]), "column 't' must hold numbers or flags"),
        (table(t=[0.0, 2.0, 1.0]), "row 2 has 1 s after 2 s"),
        (table(t=[0.0, 1.0], flag_bump=[0.0, 0.5]), r"'flag_bump', row 1: a flag is 0 or 1, got 0\.5"),
    ],
)
def test_parquet_that_holds_no_run_is_refused(tmp_path, make, said):
    make(tmp_path / "run.parquet")
    with pytest.raises(InputError, match=said) as refusal:
        read_parquet(tmp_path / "run.parquet")
    assert "run.parquet" in str(refusal.value)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"yaw": np.zeros(3)}, "the run to write: not a Run: column 't' is missing"),
        ({"t": np.arange(3.0), "est_note": np.array(["a", "b", "c"])}, "column 'est_note' cannot stand"),
        ({"t": np.arange(3.0), "est_p": np.zeros((3, 2, 2))}, r"column 'est_p' cannot stand.*\(3, 2, 2\)"),
        ({"t": np.arange(3.0), "est_p": np.zeros((3, 1)), "est_p_0": np.zeros(3)}, "both be called"),
    ],
)
def test_a_run_that_no_table_can_hold_is_refused_and_nothing_is_written(columns, message, tmp_path):
    with pytest.raises(InputError, match=message):
        write_parquet(Run(columns), tmp_path / "run.parquet")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("write", "read", "name"), TABLES, ids=NAMES)
def test_every_table_of_the_same_run_has_the_same_bytes(write, read, name, tmp_path):
    write(some_run(), tmp_path / name)
    write(some_run(), tmp_path / f"again-{name}")
    assert (tmp_path / name).read_bytes() == (tmp_path / f"again-{name}").read_bytes()
    write(some_run().with_metadata(seed=8), tmp_path / f"other-{name}")
    assert (tmp_path / name).read_bytes() != (tmp_path / f"other-{name}").read_bytes()


@settings(max_examples=30, deadline=None)
@given(values=st.lists(st.floats(width=64), min_size=1, max_size=20))
def test_any_float_comes_back_from_csv_to_the_bit(values, tmp_path_factory):
    path = tmp_path_factory.mktemp("csv") / "run.csv"
    run = Run({"t": np.arange(len(values), dtype=float), "est_x": np.array(values)})
    write_csv(run, path)
    again = read_csv(path)["est_x"]
    assert np.array_equal(again, run["est_x"], equal_nan=True)
    assert np.array_equal(np.signbit(again[again == 0]), np.signbit(run["est_x"][run["est_x"] == 0]))


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tables")
    for write, _, name in TABLES:
        write(some_run(), folder / name)
    return folder


def test_pandas_reads_the_csv_to_the_bit(tables):
    pandas = pytest.importorskip("pandas")
    old = int(pandas.__version__.split(".")[0]) < 3
    options = {"float_precision": "round_trip"} if old else {}
    frame = pandas.read_csv(tables / "run.csv", comment="#", **options)
    flat = some_run().flat()
    assert list(frame.columns) == list(flat)
    for name, values in flat.items():
        assert frame[name].dtype == values.dtype, name
        assert np.array_equal(frame[name], values, equal_nan=True), name


def test_polars_reads_the_csv_and_the_parquet(tables):
    polars = pytest.importorskip("polars")
    flat = some_run().flat()
    read = polars.read_csv(tables / "run.csv", comment_prefix="#", infer_schema_length=None)
    assert read.columns == list(flat)
    for name in ("t", "p_world_base_y", "flag_bump"):
        assert np.array_equal(read[name].to_numpy(), flat[name]), name
    frame = polars.read_parquet(tables / "run.parquet")
    for name, values in flat.items():
        assert np.array_equal(frame[name].to_numpy(), values, equal_nan=values.dtype != bool), name


def test_duckdb_asks_the_csv_and_the_parquet_in_sql(tables):
    duckdb = pytest.importorskip("duckdb")
    run = some_run()
    bumps = int(run["flag_bump"].sum())
    for source in (f"read_csv('{tables}/run.csv', comment='#')", f"'{tables}/run.parquet'"):
        wanted = "count(*), sum(flag_bump::int), max(p_world_base_y), count(*) filter (isnan(b_sd_nt))"
        ((rows, flags, most, unknown),) = duckdb.sql(f"select {wanted} from {source}").fetchall()
        assert (rows, flags, unknown) == (run.rows, bumps, np.isnan(run["b_sd_nt"]).sum())
        assert most == run["p_world_base"][:, 1].max()


def test_numpy_reads_the_npz_without_pickle(tables):
    with np.load(tables / "run.npz", allow_pickle=False) as arrays:
        assert np.array_equal(arrays["p_world_base"], some_run()["p_world_base"])
        told = json.loads(str(arrays["magtwin"]))
    assert told["facts"] == FACTS
    assert told["columns"]["b_total_nt"]["unit"] == "nT"


def test_a_csv_of_a_spreadsheet_is_a_run_where_the_names_are(tmp_path):
    (tmp_path / "run.csv").write_text('\ufeff"t","b_total_nt","flag_bump"\r\n0,41000,0\r\n0.5,nan,TRUE\r\n')
    run = read_csv(tmp_path / "run.csv")
    assert list(run) == ["t", "b_total_nt", "flag_bump"]
    assert np.array_equal(run["b_total_nt"], [41000, np.nan], equal_nan=True)
    assert np.array_equal(run["flag_bump"], [False, True])


def test_a_csv_of_another_program_is_a_run_by_the_names_and_units_of_its_quantities(tmp_path):
    (tmp_path / "run.csv").write_text(
        "t_ms,pos_x,pos_y,theta_deg,b_total_nt\n0,1,2,90,41000\n500,1,3,0,41001\n"
    )
    with pytest.warns(RepairWarning, match="t_ms as t, pos_x as p_world_base_x"):
        run = read_csv(tmp_path / "run.csv")
    assert run["t"].tolist() == [0, 0.5]
    assert run["p_world_base"].tolist() == [[1, 2, 0], [1, 3, 0]]
    assert run["yaw"].tolist() == [np.pi / 2, 0]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "no line of column names; the file is empty"),
        (b"# facts {}\n", "no line of column names"),
        (b"t,yaw\n0,1\n1\n", "Expected 2 columns, got 1"),
        (b"t,yaw\n0,1\n1,2,3\n", "Expected 2 columns, got 3"),
        (b"t,yaw\n0,1\n1,north\n", "invalid value 'north'"),
        (b"t,yaw\n0,1\n1,\n", "column 'yaw', row 1: no value; write nan"),
        (b"t,yaw,yaw\n0,1,2\n", "two columns are called 'yaw'"),
        (b"clock,yaw\n0,1\n", "not a Run: column 't' is missing"),
        (b"t,yaw\n0,1\n0,2\n", "row 1 has 0 s after 0 s"),
        (b"t,yaw\n2,1\n1,2\n", "t must ascend from row to row, but row 1 has 1 s after 2 s"),
        (b"t\nnan\n", "t must be finite, got nan in row 0"),
        (b"t,odom_p_x\n0,1\n", "column 'odom_p_y' is missing beside 'odom_p_x'"),
        (b"t,flag_bump\n0,2\n", "a flag is 0 or 1, got 2"),
        (b"\xff\xfe\x00t\n", "is not UTF-8"),
        (b"a" * (1 << 21), "line 1 is not a line of a CSV file"),
        (b"# facts [1]\nt\n0\n", "must be an object"),
        (b"# facts {\nt\n0\n", "is not JSON"),
        (b'# facts {"a": [1]}\nt\n0\n', "metadata 'a' must be a text, a number"),
        (b"# column t nonsense\nt\n0\n", "csv:1: metadata of a column are not JSON"),
        (b'# column t {"type": "tensor"}\nt\n0\n', "column 't' has no such type"),
        (b'# column t {"type": "double", "column": "t"}\nt\n0\n1', "cut short: its last line has no end"),
    ],
)
def test_a_csv_that_holds_no_run_is_refused_in_one_line(text, message, tmp_path):
    (tmp_path / "run.csv").write_bytes(text)
    with pytest.raises(InputError, match=message) as refused:
        read_csv(tmp_path / "run.csv")
    assert "run.csv" in str(refused.value)
    assert len(str(refused.value)) < 500


def npz(path, **arrays):
    np.savez(path, **arrays)
    return path


class Danger:
    """Runs when it is unpickled."""

    def __reduce__(self):
        return (Path("ran").touch, ())


def test_pickled_objects_in_an_npz_are_refused_and_never_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "run.npz", t=np.arange(1.0), yaw=np.array([Danger()], dtype=object))
    with pytest.raises(InputError, match=r"yaw\.npy is no whole array of plain numbers \(Object arrays"):
        read_npz(tmp_path / "run.npz")
    assert not (tmp_path / "ran").exists()


def test_a_damaged_or_foreign_npz_is_refused(tables, tmp_path):
    path, whole = tmp_path / "run.npz", (tables / "run.npz").read_bytes()
    for content in (b"", b"PK\x03\x04 nothing", whole[:-300], whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"run\.npz: not an npz file, damaged, or cut short"):
            read_npz(path)
    changed = bytearray(whole)
    changed[len(whole) // 2] ^= 255
    path.write_bytes(changed)
    with pytest.raises(InputError, match=r"run\.npz: "):
        read_npz(path)


def test_an_array_whose_header_claims_more_than_is_there_takes_no_memory(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**15,)})
    with zipfile.ZipFile(tmp_path / "run.npz", "w") as archive:
        archive.writestr("t.npy", header.getvalue() + bytes(16))
    with pytest.raises(InputError, match=r"t\.npy is no whole array"):
        read_npz(tmp_path / "run.npz")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"yaw": np.zeros(2)}, "not a Run: column 't' is missing"),
        ({"t": np.array([1.0, 0.0])}, "row 1 has 0 s after 1 s"),
        ({"t": np.arange(2.0), "yaw": np.zeros(3)}, "equally long"),
        ({"t": np.arange(2.0), "odom_p": np.zeros((2, 2))}, "'odom_p' must have shape"),
        ({"t": np.arange(2.0), "name": np.array(["a", "b"])}, "'name' must hold numbers or flags"),
        ({"t": np.arange(2.0), "yaw": np.zeros(2, complex)}, "'yaw' must hold numbers or flags"),
        ({"t": np.arange(2.0), "est_n": np.array(3)}, "column 'est_n' must hold numbers or flags in rows"),
        ({"t": np.arange(2.0), "magtwin": np.zeros(2)}, "holds no metadata of a run"),
        ({"t": np.arange(2.0), "magtwin": np.array('{"columns": {"t": 1}}')}, "object of texts"),
    ],
)
def test_an_npz_that_holds_no_run_is_refused(arrays, message, tmp_path):
    with pytest.raises(InputError, match=message):
        read_npz(npz(tmp_path / "run.npz", **arrays))


@pytest.mark.parametrize("number", [10**400, -(10**309)])
def test_numbers_in_metadata_that_no_float_holds_are_refused(number, tmp_path):
    about = json.dumps({"facts": {"seed": number}})
    with pytest.raises(InputError, match=r"run\.npz: metadata 'seed' is a number beyond 1e308"):
        read_npz(npz(tmp_path / "run.npz", t=np.arange(2.0), magtwin=np.array(about)))
    with pytest.raises(InputError, match="metadata 'seed' is a number beyond 1e308"):
        write_npz(Run({"t": np.arange(2.0)}, {"seed": number}), tmp_path / "out.npz")


@pytest.mark.parametrize(("write", "read", "name"), TABLES)
def test_a_run_of_thousands_of_columns_is_read(write, read, name, tmp_path):
    run = Run({"t": np.arange(2.0)} | {f"c{k}": np.full(2, float(k)) for k in range(3000)})
    write(run, tmp_path / name)
    back = read(tmp_path / name)
    assert list(back) == list(run)
    assert back["c2999"].tolist() == [2999.0, 2999.0]


def test_a_program_that_is_killed_leaves_parts_that_are_read_and_not_overwritten_unasked(tmp_path):
    code = """
import os, signal, sys
from test_tables import some_run
from magtwin.io.tables import ParquetParts
parts, run = ParquetParts(sys.argv[1]), some_run()
parts.append(run.take(slice(0, 20)))
parts.append(run.take(slice(20, 40)))
os.kill(os.getpid(), signal.SIGKILL)
"""
    command = [sys.executable, "-c", code, str(tmp_path / "run.parquet")]
    killed = subprocess.run(command, check=False, cwd=Path(__file__).parent)
    assert killed.returncode == -signal.SIGKILL
    left = tmp_path / "run.parquet.parts"
    assert_same(read_run(left), some_run().take(slice(0, 40)))
    with pytest.raises(InputError, match="parts of a run that did not end; magtwin convert reads them"):
        ParquetParts(tmp_path / "run.parquet")
    assert_same(read_run(left), some_run().take(slice(0, 40)))
    ParquetParts(tmp_path / "run.parquet", force=True).append(some_run(seed=1))
    assert_same(read_run(left), some_run(seed=1))


def test_blocks_that_do_not_run_on_or_are_of_another_run_are_refused(tmp_path):
    run = some_run()
    parts = ParquetParts(tmp_path / "run.parquet")
    parts.append(run.take(slice(0, 20)))
    with pytest.raises(InputError, match=r"the block to append begins at .* s, and the last ended at"):
        parts.append(run.take(slice(10, 30)))
    parts.append(run.select("yaw").take(slice(20, 30)))
    with pytest.raises(InputError, match=r"part-000001\.parquet: has other columns than part-000000"):
        read_run(parts.folder)


@contextmanager
def few_bytes(limit):
    """A process whose files may have no more bytes, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
