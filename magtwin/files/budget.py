"""Budget: how large an input file of each format may be, in bytes, levels, entries and seconds.

Every reader takes its limits from `BUDGETS` and checks them before it decodes. `MAGTWIN_ALLOW_GB` in the
environment raises the limits of size: `MAGTWIN_ALLOW_GB=8` admits files that are, or become, up to 8 GB.
Limits of depth, count and time are not raised, as they protect the stack and end loops.
"""

import math
import os
from dataclasses import dataclass
from pathlib import Path

from magtwin.errors import InputError

ALLOW = "MAGTWIN_ALLOW_GB"
"""Name of the variable that admits larger inputs [GB]."""

MB, GB = 10**6, 10**9


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Limits of one format."""

    file: int = 64 * GB
    """Most bytes of a file. Formats that are decoded as a whole have a small limit; those that are read in
    place, or in blocks, a large one."""

    depth: int = 64
    """Most levels of nesting."""

    count: int = 10_000_000
    """Most entries: elements of XML, arrays of npz, columns of tables, files of a package, pixels of an
    image, prims of a stage."""

    seconds: float = 20.0
    """Time limit of formats that are decoded in a process of their own, plus 1 s per megabyte."""


BUDGETS: dict[str, Budget] = {
    "TOML": Budget(file=2 * MB, depth=16),
    "JSON": Budget(file=32 * MB),  # 3 bytes of it, an empty object, become 72
    "YAML": Budget(file=1 * MB, count=10_000),
    "XML": Budget(file=256 * MB, depth=200, count=2_000_000),
    "URDF": Budget(count=2_000),  # links, joints, visuals and colliders each
    "npz": Budget(count=10_000),
    "Parquet": Budget(count=10_000),
    "CSV": Budget(file=8 * GB, count=10_000),
    "text": Budget(file=64 * MB),  # model cards and curves of training
    "readings": Budget(file=128 * MB),  # foreign tables, whose words are texts before they are numbers
    "recording": Budget(file=1 * GB),  # of the release, read frame by frame
    "rrd": Budget(),
    "bag": Budget(count=1 << 30),  # bytes of a chunk or message
    "image": Budget(file=512 * MB, count=2**27),
    "mesh": Budget(file=1 * GB, count=50_000),  # nodes, with those that are instanced
    "OBJ": Budget(file=128 * MB),  # its words are texts before they are numbers
    "weights": Budget(file=4 * GB),
    "checkpoint": Budget(file=1 * GB, count=10_000),
    "ONNX": Budget(file=256 * MB, count=10_000),
    "USD text": Budget(file=1 * GB, depth=128),
    "USD": Budget(seconds=60.0, count=1_000_000),  # prims, with those of instances
    "package": Budget(file=4 * GB, count=100_000),  # usdz, which has no larger ones
}
"""Limits by format."""

SHAPES = 100_000
"""Most shapes of a stage that are drawn or exported, with those of instances."""

CORNERS = 50_000_000
"""Most corners of their faces, beyond those that the stage's files hold: of instances and of primitives."""

SPARE = 1 * GB
"""What a file may decode to beyond `RATIO` times its size [bytes]."""

RATIO = 4
"""Most decoded bytes for each byte of a file, beyond `SPARE`."""


def allowed() -> int:
    """Bytes that `MAGTWIN_ALLOW_GB` admits; 0 if it is not set.

    Raises:
        InputError: It is not a number of gigabytes.
    """
    text = os.environ.get(ALLOW, "")
    try:
        value = float(text or 0)
    except ValueError:
        value = math.nan
    if not 0 <= value < 1e9:
        raise InputError(f"{ALLOW}={text!r}: must be a number of gigabytes, such as {ALLOW}=8")
    return int(value * GB)


def check_size(path: Path, kind: str) -> int:
    """Size of a file [bytes], if it is within the limit of its format.

    Raises:
        InputError: It is larger.
    """
    size = path.stat().st_size
    if size > max(BUDGETS[kind].file, allowed()):
        raise InputError(
            f"{path}: {_in_words(size)} are too large for {kind} (at most {_in_words(BUDGETS[kind].file)}); "
            f"if the file is right, set {ALLOW}={math.ceil(size / GB)}"
        )
    return size


def decoded_limit(size: int) -> int:
    """Most bytes that a file of `size` bytes may become in memory."""
    return max(RATIO * size + SPARE, allowed())


def check_decoded(path: str | os.PathLike[str], size: int, decoded: int) -> None:
    """Refuse a file that would become too large in memory, before it is decoded.

    Args:
        path: The file.
        size: Its size [bytes].
        decoded: Bytes that its contents take in memory.

    Raises:
        InputError: `decoded` is above `decoded_limit(size)`.
    """
    if decoded > decoded_limit(size):
        raise InputError(
            f"{path}: {_in_words(size)} that decode to {_in_words(decoded)}; at most "
            f"{_in_words(decoded_limit(size))} are read; if the file is right, set "
            f"{ALLOW}={math.ceil(decoded / GB) if decoded < 10**6 * GB else 1}"
        )


def check_count(where: object, kind: str, count: int, noun: str) -> None:
    """Refuse more entries than the format's limit."""
    most = BUDGETS[kind].count
    if count > most:
        raise InputError(f"{where}: over {most:,} {noun}; split the file")


def check_depth(where: object, kind: str, depth: int, noun: str = "levels") -> None:
    """Refuse deeper nesting than the format's limit."""
    most = BUDGETS[kind].depth
    if depth > most:
        raise InputError(f"{where}: nests deeper than {most} {noun}")


def _in_words(size: int) -> str:
    """A size in bytes, MB or GB."""
    if size < MB:
        return f"{size:,} bytes"
    return f"{size / MB:,.1f} MB" if size < GB else f"{size / GB:,.1f} GB"
