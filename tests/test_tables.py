import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magtwin.io.tables import read_parquet, write_parquet
from magtwin.names import RefusedError
from magtwin.run import COLUMNS, Run

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
    assert dict(a.facts) == dict(b.facts)
    for name in a:
        assert a[name].dtype == b[name].dtype, name
        assert a[name].shape == b[name].shape, name
        assert a[name].tobytes() == b[name].tobytes(), name


@pytest.fixture
def written(tmp_path):
    path = tmp_path / "run.parquet"
    write_parquet(some_run(), path)
    return path


def test_a_run_comes_back_from_parquet_to_the_last_bit_in_the_same_order(written):
    assert_same(some_run(), read_parquet(written))


def test_the_same_run_gives_the_same_bytes(written, tmp_path):
    write_parquet(some_run(), tmp_path / "again.parquet")
    assert (tmp_path / "again.parquet").read_bytes() == written.read_bytes()


def test_another_run_gives_other_bytes(written, tmp_path):
    write_parquet(some_run().with_facts(seed=8), tmp_path / "other.parquet")
    assert (tmp_path / "other.parquet").read_bytes() != written.read_bytes()


def test_a_run_of_no_rows_comes_back(tmp_path):
    run = Run({name: values[:0] for name, values in some_run().items()}, FACTS)
    write_parquet(run, tmp_path / "none.parquet")
    assert_same(run, read_parquet(tmp_path / "none.parquet"))


@settings(max_examples=25, deadline=None)
@given(
    width=st.integers(1, 5),
    dtype=st.sampled_from(["f8", "f4", "i8", "i4", "u1", "?"]),
    rows=st.integers(0, 9),
)
def test_a_localizers_columns_come_back_with_their_own_width_and_dtype(tmp_path_factory, width, dtype, rows):
    values = (np.arange(rows * width).reshape(rows, width) % 2).astype(dtype)
    run = Run({"t": np.arange(rows) / 135, "est_p": values, "est_n": values[:, 0].copy()}, {"seed": 1})
    path = tmp_path_factory.mktemp("est") / "run.parquet"
    write_parquet(run, path)
    assert_same(run, read_parquet(path))


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


def test_pandas_reads_the_file_as_plain_floats_and_flags(written):
    pandas = pytest.importorskip("pandas")
    frame = pandas.read_parquet(written)
    assert set(map(str, frame.dtypes)) == {"float64", "bool"}
    assert np.array_equal(frame[["p_world_base_x", "p_world_base_z"]], some_run()["p_world_base"][:, ::2])


def test_a_file_rewritten_without_metadata_is_still_a_run(written, tmp_path):
    bare = pq.read_table(written).replace_schema_metadata(None)
    bare = pa.table({name: bare.column(name) for name in reversed(bare.column_names)})
    pq.write_table(bare, tmp_path / "bare.parquet")
    run = read_parquet(tmp_path / "bare.parquet")
    assert not run.facts
    for name, values in some_run().items():
        assert np.array_equal(run[name], values, equal_nan=True), name


def test_a_missing_file_is_refused_and_the_near_name_told(written):
    with pytest.raises(
        RefusedError, match=r"runn\.parquet: no such Parquet file; did you mean 'run\.parquet'"
    ):
        read_parquet(written.with_name("runn.parquet"))


def test_a_file_of_another_kind_is_refused(tmp_path):
    (tmp_path / "run.parquet").write_text("t,b_total_nt\n0,41000\n")
    with pytest.raises(RefusedError, match=r"run\.parquet: not a Parquet file: it begins with b't,b_'"):
        read_parquet(tmp_path / "run.parquet")


def test_an_empty_file_and_a_folder_are_refused(tmp_path):
    (tmp_path / "run.parquet").touch()
    with pytest.raises(RefusedError, match="not a Parquet file"):
        read_parquet(tmp_path / "run.parquet")
    with pytest.raises(RefusedError, match="a folder without Parquet parts"):
        read_parquet(tmp_path)


def test_a_file_cut_short_is_refused(written):
    written.write_bytes(written.read_bytes()[:-100])
    with pytest.raises(RefusedError, match="Parquet cut short: its end is missing"):
        read_parquet(written)


def test_a_file_damaged_inside_is_refused(written):
    content = bytearray(written.read_bytes())
    content[4:2000] = bytes(1996)
    written.write_bytes(content)
    with pytest.raises(RefusedError, match="damaged Parquet"):
        read_parquet(written)


def test_parquet_without_a_clock_is_refused(tmp_path):
    pq.write_table(pa.table({"time": [0.0, 1.0], "b": [1.0, 2.0]}), tmp_path / "other.parquet")
    with pytest.raises(RefusedError, match="not a Run: column 't' is missing"):
        read_parquet(tmp_path / "other.parquet")


def test_parquet_with_a_part_missing_is_refused(written):
    pq.write_table(pq.read_table(written).drop_columns(["odom_p_y"]), written)
    with pytest.raises(RefusedError, match="column 'odom_p_y' is missing beside 'odom_p_x'"):
        read_parquet(written)


def test_parquet_with_text_or_holes_is_refused(tmp_path):
    path = tmp_path / "run.parquet"
    pq.write_table(pa.table({"t": ["now", "then"]}), path)
    with pytest.raises(RefusedError, match="column 't' must hold numbers or flags, got string"):
        read_parquet(path)
    pq.write_table(pa.table({"t": [0.0, 1.0], "yaw": [0.5, None]}), path)
    with pytest.raises(RefusedError, match="column 'yaw', row 1: no value; write nan"):
        read_parquet(path)


def test_an_output_that_exists_is_kept_unless_forced(written):
    before = written.read_bytes()
    with pytest.raises(RefusedError, match="exists already; give --force"):
        write_parquet(some_run(seed=1), written)
    assert written.read_bytes() == before
    write_parquet(some_run(seed=1), written, force=True)
    assert written.read_bytes() != before


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"yaw": np.zeros(3)}, "the run to write: not a Run: column 't' is missing"),
        ({"t": np.arange(3.0), "est_note": np.array(["a", "b", "c"])}, "column 'est_note' cannot stand"),
        ({"t": np.arange(3.0), "est_p": np.zeros((3, 2, 2))}, r"column 'est_p' cannot stand.*\(3, 2, 2\)"),
        (
            {"t": np.arange(3.0), "est_p": np.zeros((3, 1)), "est_p_0": np.zeros(3)},
            "both be called 'est_p_0'",
        ),
    ],
)
def test_a_run_that_no_table_can_hold_is_refused_and_nothing_is_written(columns, message, tmp_path):
    with pytest.raises(RefusedError, match=message):
        write_parquet(Run(columns), tmp_path / "run.parquet")
    assert not list(tmp_path.iterdir())
