import contextlib

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from magtwin.errors import InputError
from magtwin.run.parquet import _counts, check_parquet


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
