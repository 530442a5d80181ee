"""Shards: every n-th chunk, so that n machines without a network between them share the work."""

from magtwin.errors import InputError


def parse_shard(text: str) -> tuple[int, int]:
    """The shard i of n from "i/n", with i counted from 0.

    Raises:
        InputError: The text is not of that form, or i is not below n.
    """
    i, slash, n = text.partition("/")
    if not (slash and i.strip().isdecimal() and n.strip().isdecimal()):
        raise InputError(f"`shard` must be i/n, such as 0/4, got {text!r}", parameter="shard")
    return checked_shard((int(i), int(n)))


def checked_shard(shard: tuple[int, int]) -> tuple[int, int]:
    """`shard`, if it is one of `n` shards, counted from 0."""
    i, n = shard
    if not 0 <= i < n:
        text = f"shard {i} of {n} does not exist; `shard` goes from 0/{n} to {max(n, 1) - 1}/{n}"
        raise InputError(text, parameter="shard")
    return shard


def in_shard(index: int, shard: tuple[int, int] | None) -> bool:
    """Whether chunk `index` belongs to shard i of n: index % n == i. All chunks do if `shard` is None."""
    return shard is None or index % shard[1] == shard[0]
