"""Compression: bags that rosbag2 compressed with zstd, as whole files or message by message.

A few bytes of zstd can stand for gigabytes, and a frame need not say its size. Both are decompressed in steps
and stopped at the budget.
"""

import os
from collections.abc import Iterator
from pathlib import Path

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
        places = zip(packed.start.tolist(), packed.size.tolist(), strict=True)
        raws = (packed.buffer[start : start + size].tobytes() for start, size in places)
        content = [b"".join(self._parts(pa.BufferReader(raw))) for raw in raws]
        return Messages.of(packed.received, [len(raw) for raw in content], b"".join(content))

    def _parts(self, packed: pa.NativeFile) -> Iterator[bytes]:
        with pa.CompressedInputStream(packed, "zstd") as stream:
            while part := stream.read(STEP):
                self._spent += len(part)
                check_decoded(self._path, self._size, self._spent)
                yield part
