"""Protobuf: the fields of a message, found without decoding what they hold.

Encoding: https://protobuf.dev/programming-guides/encoding
"""

import mmap
from collections.abc import Iterator

NUMBER, EIGHT, BYTES, FOUR = 0, 1, 2, 5
"""Types of fields: a number of variable length, 8 bytes, bytes with their length, 4 bytes."""


def fields(message: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Number of each field, its value, and where it begins and ends in the message.

    The value is that of a number, or the length of bytes.

    Raises:
        ValueError: The message is damaged, or has a group, which no current program writes.
    """
    at = 0
    while at < len(message):
        begin = at
        tag, at = varint(message, at)
        kind, value = tag & 7, 0
        if kind in (NUMBER, BYTES):
            value, at = varint(message, at)
        elif kind not in (EIGHT, FOUR):
            raise ValueError(f"a field of kind {kind}")
        at += {NUMBER: 0, EIGHT: 8, BYTES: value, FOUR: 4}[kind]
        yield tag >> 3, value, begin, at


def varint(message: bytes | mmap.mmap, at: int) -> tuple[int, int]:
    """A number of variable length, in groups of 7 bits, the lowest first; and where it ends.

    Raises:
        ValueError: It has no end.
    """
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(message):
            break
        value |= (message[at] & 127) << shift
        at += 1
        if message[at - 1] < 128:
            return value, at
    raise ValueError("a number without an end")
