import contextlib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from magtwin.errors import InputError
from magtwin.files import budget
from magtwin.tables.parquet import _check_pages, _counts, check_parquet


@pytest.fixture
def path(tmp_path):
    table = pa.table(
        {
            "a": np.arange(5000.0),
            "lists": [[1.0, 2.0] * (i % 5) for i in range(5000)],
            "texts": ["x" * (i % 300) for i in range(5000)],
            "flag": np.arange(5000) % 2 == 0,
            "struct": [{"b": i, "c": [i]} for i in range(5000)],
        },
        metadata={"long": "y" * 1000},
    )
    pq.write_table(table, tmp_path / "a.parquet", row_group_size=700)
    return tmp_path / "a.parquet"


def test_values_of_each_column_are_counted_as_by_pyarrow(path):
    about = pq.read_metadata(path)
    groups = [about.row_group(k) for k in range(about.num_row_groups)]
    assert _counts(path) == [[group.column(i).num_values for i in range(6)] for group in groups]
    check_parquet(path)


def test_damaged_metadata_are_refused(path):
    data = path.read_bytes()
    length = int.from_bytes(data[-8:-4], "little")
    refused = 0
    for at in range(len(data) - 8 - length, len(data) - 8, 41):
        for byte in (0x00, 0x19, 0x1C, 0xFF):
            path.write_bytes(data[:at] + bytes([byte]) + data[at + 1 :])
            with contextlib.suppress(InputError):
                refused += 1
                assert len(_counts(path)) < 20
                refused -= 1
    assert refused > 5


def test_pages_that_decompress_to_too_much_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "a.parquet"
    table = pa.table({"a": pa.array(np.arange(3.0)), "b": ["x" * 50_000, "y", "z"]})
    pq.write_table(table, path, use_dictionary=["b"])
    _check_pages(path, path.stat().st_size)
    monkeypatch.setattr(budget, "SPARE", 20_000)
    with pytest.raises(InputError, match="that decode to 50,"):
        _check_pages(path, path.stat().st_size)


@pytest.mark.parametrize("kind", ["text", "list", "struct", "fixed"])
def test_a_long_text_of_a_dictionary_counts_as_often_as_it_is_used(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(budget, "SPARE", 10_000_000)
    path, length = tmp_path / "a.parquet", 100_000
    of = pa.binary(length) if kind == "fixed" else pa.string()
    words = ["x" * length, "y" * length] if kind == "fixed" else ["x" * length, "a"]

    def write(used):
        column = pa.array(words, of).take(pa.array(np.where(np.arange(20_000) < used, 0, 1)[: 20 * used]))
        if kind == "list":
            column = pa.ListArray.from_arrays(np.arange(len(column) + 1, dtype=np.int32), column)
        elif kind == "struct":
            column = pa.StructArray.from_arrays([column], ["s"])
        pq.write_table(pa.table({"c": column}), path, dictionary_pagesize_limit=1 << 20, compression="zstd")

    write(3)
    if kind != "fixed":
        check_parquet(path)
    write(200)
    with pytest.raises(InputError, match="that decode to"):
        check_parquet(path)
