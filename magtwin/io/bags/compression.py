"""Compression: bags that rosbag2 compressed with zstd, as whole files or message by message.

A few bytes of zstd can stand for gigabytes, and a frame need not say its size. Both are decompressed in steps
and stopped at the budget.
"""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from magtwin.files.budget import check_decoded
from magtwin.io.bags.cdr import Messages

STEP = 1 << 20  # Bytes that are decompressed at once


class Room:
    """What a compressed bag, of some files, may still decompress to."""

    def __init__(self, path: Path, files: list[Path]) -> None:
        self._path = path
        self._size = sum(file.stat().st_size for file in files)
        self._spent = 0

    def file(self, source: Path, folder: Path) -> Path:
        """Decompress a file into a folder, within the budget; its name loses the suffix `.zstd`."""
        place = folder / source.stem
        with pa.OSFile(os.fspath(source)) as packed, open(place, "xb") as file:
            for part in self._parts(packed):
                file.write(part)
        return place

    def messages(self, packed: Messages) -> Messages:
        """Decompress messages; errors as for `file`."""
        content = [b"".join(self._parts(pa.BufferReader(raw))) for raw in _each(packed)]
        size = np.array([len(raw) for raw in content], np.int64)
        buffer = np.frombuffer(b"".join(content), np.uint8)
        return Messages(packed.received, buffer, np.cumsum(size) - size, size)

    def _parts(self, packed: pa.NativeFile) -> Iterator[bytes]:
        with pa.CompressedInputStream(packed, "zstd") as stream:
            while part := stream.read(STEP):
                self._spent += len(part)
                check_decoded(self._path, self._size, self._spent)
                yield part


def _each(messages: Messages) -> Iterator[bytes]:
    for start, size in zip(messages.start.tolist(), messages.size.tolist(), strict=True):
        yield messages.buffer[start : start + size].tobytes()
