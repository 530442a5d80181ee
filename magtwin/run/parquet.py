"""Parquet: what a file would take in memory, from its metadata."""

from pathlib import Path

import pyarrow.parquet as pq

from magtwin.budget import check_count, check_decoded, check_size

_BATCH = 1000
"""Rows of texts that are measured at once."""


def check_parquet(path: Path) -> None:
    """Refuse a Parquet file that would be too large in memory: equal values take no room in the file.

    Raises:
        InputError: Its columns, decoded, are over the budget, or there are too many of them.
    """
    size = check_size(path, "Parquet")
    with pq.ParquetFile(path) as file:
        about = file.metadata
        check_count(path, "Parquet", about.num_columns, "columns")
        values, texts = 0, list[str]()
        for i in range(about.num_columns):
            column = about.schema.column(i)
            count = sum(about.row_group(k).column(i).num_values for k in range(about.num_row_groups))
            values += 8 * max(count, about.num_rows if column.max_repetition_level == 0 else 0)
            if column.physical_type.endswith("BYTE_ARRAY"):
                texts.append(column.path)
        check_decoded(path, size, values)
        for batch in file.iter_batches(_BATCH, columns=texts) if texts else ():
            values += batch.nbytes
            check_decoded(path, size, values)
