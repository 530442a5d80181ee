"""Mapped arrays: columns of a long run in unnamed files on the disk, so that memory stays flat.

A run of a day has 11.7 million readings, 7 GB of columns. They are mapped from files without a name: they
look like other arrays, the system reads and writes them as needed, and nothing is left if the process is
killed.
The files are in the folder that the environment variable TMPDIR names, else in /var/tmp.
"""

import errno
import mmap
import os
import tempfile
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from magtwin.errors import InputError

LONG = 1 << 19  # Most rows that are kept in memory: an hour at 135 Hz
BLOCK = 1 << 16  # Rows of a longer run that are worked on at a time

_maps: "weakref.WeakSet[mmap.mmap]" = weakref.WeakSet()
"""Mapped files of all arrays that are in use."""


def zeros(shape: int | tuple[int, ...], dtype: DTypeLike = float) -> NDArray[Any]:
    """An array of zeros in an unnamed file.

    Raises:
        InputError: The disk has no room for it.
    """
    shape = (shape,) if isinstance(shape, int) else shape
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if not size:
        return np.zeros(shape, dtype)
    folder = _folder()
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            if hasattr(os, "posix_fallocate"):  # a full disk later would be a signal, not an error
                os.posix_fallocate(file.fileno(), 0, size)
            else:
                file.truncate(size)
            content = mmap.mmap(file.fileno(), size)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        text = f"no room for {size / 1e9:.2g} GB of a long run" if full else str(error.strerror)
        raise InputError(f"{folder}: {text}; set TMPDIR to a folder with room") from error
    _maps.add(content)
    return np.frombuffer(content, dtype).reshape(shape)


def release() -> None:
    """Give the memory of all mapped arrays back to the system; their values stay on the disk."""
    if hasattr(mmap, "MADV_DONTNEED"):
        for content in list(_maps):
            content.madvise(mmap.MADV_DONTNEED)


def parts(rows: int) -> Iterator[slice]:
    """Slices of columns: all rows, or the blocks of a long run; gives the memory back after each."""
    size = BLOCK if rows > LONG else max(rows, 1)
    for first in range(0, rows, size):
        yield slice(first, min(first + size, rows))
        if rows > LONG:
            release()


def joined(parts: "list[NDArray[Any]]") -> NDArray[Any]:
    """Arrays joined along their last axis, in a mapped file if the result is long; empties the list."""
    count = sum(part.shape[-1] for part in parts)
    if count <= LONG:
        return np.concatenate(parts, axis=-1)
    whole = zeros((*parts[0].shape[:-1], count), parts[0].dtype)
    end = count
    while parts:
        part = parts.pop()
        whole[..., end - part.shape[-1] : end] = part
        end -= part.shape[-1]
    release()
    return whole


def settle(parts: "list[NDArray[Any]]") -> None:
    """Move arrays that wait to be `joined` to a mapped file once they are many; their list gets shorter."""
    waiting = [part for part in parts if part.shape[-1] <= LONG]
    if sum(part.shape[-1] for part in waiting) > LONG:
        parts[:] = [*(part for part in parts if part.shape[-1] > LONG), joined(waiting)]


def empty(shape: int | tuple[int, ...], dtype: DTypeLike = float) -> NDArray[Any]:
    """An array to be filled: in memory, or in an unnamed file if its rows are many.

    Raises:
        InputError: The disk has no room for it.
    """
    rows = shape if isinstance(shape, int) else shape[0]
    return zeros(shape, dtype) if rows > LONG else np.empty(shape, dtype)


def _folder() -> Path:
    """Where mapped files are: on a disk rather than in memory, as /tmp is on some systems."""
    if named := os.environ.get("TMPDIR"):
        return Path(named)
    usual = Path("/var/tmp")
    return usual if os.access(usual, os.W_OK) else Path(tempfile.gettempdir())
