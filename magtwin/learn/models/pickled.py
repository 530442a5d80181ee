"""Pickles read as data: what a pickle names and says, with nothing imported and nothing called.

A pickle is a program for a small stack machine. `pickle.load` lets that program call whatever it
names; even a restricted `find_class` still calls, sets attributes and runs `__setstate__`. Here the
program runs on a machine that can do none of it: a call becomes a `Made` record that says what would
have been called with what, and the reader decides what it means.
"""

import pickletools
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

from magtwin.errors import InputError


@dataclass(frozen=True)
class Global:
    """A class or function that a pickle names, such as `torch.FloatStorage`."""

    name: str


@dataclass(frozen=True)
class Outside:
    """Something that a pickle keeps outside itself (its persistent id), such as a tensor's storage."""

    key: Any


@dataclass(eq=False)
class Made:
    """What a pickle would have made by a call."""

    name: str
    """The global that would have been called."""

    args: tuple[Any, ...]
    """With what."""

    state: Any = None
    """What would have been set on the result (BUILD)."""

    items: dict[str | int, Any] = field(default_factory=dict)
    """What would have been put into it, where it is a mapping."""


class _Mark:
    """A place on the stack to pop back to."""


_MARK = _Mark()


def read_pickle(data: bytes, admitted: Collection[str], where: str) -> Any:
    """The value that a pickle describes; what it would have called are `Made` records.

    Args:
        data: A pickle of protocol 2 or later.
        admitted: Dotted names of the globals that may occur.
        where: The file, for refusals.

    Returns:
        Plain dict, list, tuple, str, bytes, int, float, bool and None, with `Made`, `Global` and
        `Outside` among them. Keys of a dict are str or int.

    Raises:
        InputError: A global that is not admitted, an instruction that no checkpoint needs, or a
            damaged pickle. Nothing of it was imported or called.
    """
    machine = _Machine(frozenset(admitted), where)
    position = 0
    try:
        for opcode, arg, at in pickletools.genops(data):
            position = at or 0
            if machine.step(opcode.name, arg):
                return machine.result()
    except InputError:
        raise
    except (ValueError, LookupError, TypeError, OverflowError) as error:
        raise InputError(
            f"{where}: damaged pickle at byte {position} ({error}); get the file again"
        ) from error
    raise InputError(f"{where}: damaged pickle, it has no end; get the file again")


class _Machine:
    """Stack, memo, and the instructions that a checkpoint needs."""

    def __init__(self, admitted: frozenset[str], where: str) -> None:
        self.admitted, self.where = admitted, where
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def step(self, op: str, arg: Any) -> bool:
        """Do one instruction; True at the end of the pickle."""
        push = self.stack.append
        match op:
            case "STOP":
                return True
            case "PROTO":
                if not 2 <= arg <= 5:
                    raise ValueError(f"protocol {arg}")
            case "FRAME":
                pass  # frames only help readers of streams
            case (
                ("BININT" | "BININT1" | "BININT2" | "LONG1" | "LONG4" | "BINFLOAT")
                | ("BINUNICODE" | "SHORT_BINUNICODE" | "BINUNICODE8")
                | ("BINBYTES" | "SHORT_BINBYTES" | "BINBYTES8")
            ):
                push(arg)
            case "NONE":
                push(None)
            case "NEWTRUE" | "NEWFALSE":
                push(op == "NEWTRUE")
            case "EMPTY_DICT":
                push({})
            case "EMPTY_LIST":
                push([])
            case "EMPTY_TUPLE":
                push(())
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                push(tuple(self.pop(int(op[-1]))))
            case "TUPLE":
                push(tuple(self.pop_to_mark()))
            case "MARK":
                push(_MARK)
            case "POP":
                self.pop(1)
            case "POP_MARK":
                self.pop_to_mark()
            case "APPEND":
                self.extend(self.pop(1))
            case "APPENDS":
                self.extend(self.pop_to_mark())
            case "SETITEM":
                self.update(self.pop(2))
            case "SETITEMS":
                self.update(self.pop_to_mark())
            case "BINPUT" | "LONG_BINPUT":
                self.memo[arg] = self.top()
            case "MEMOIZE":
                self.memo[len(self.memo)] = self.top()
            case "BINGET" | "LONG_BINGET":
                if arg not in self.memo:
                    raise LookupError(f"nothing was kept as {arg}")
                push(self.memo[arg])
            case "GLOBAL":
                push(self.named(arg.replace(" ", ".", 1)))
            case "STACK_GLOBAL":
                module, name = self.pop(2)
                if not (isinstance(module, str) and isinstance(name, str)):
                    raise TypeError("a global whose name is no text")
                push(self.named(f"{module}.{name}"))
            case "REDUCE" | "NEWOBJ":
                called, args = self.pop(2)
                if not (isinstance(called, Global) and isinstance(args, tuple)):
                    raise TypeError(f"a call of a {type(called).__name__}")
                push(Made(called.name, args))
            case "BUILD":
                (state,) = self.pop(1)
                made = self.top()
                if not isinstance(made, Made):
                    raise TypeError(f"a state for a {type(made).__name__}")
                made.state = state
            case "BINPERSID":
                push(Outside(*self.pop(1)))
            case _:
                if op == "INST":  # protocol 0's call, which names what it calls
                    self.named(arg.replace(" ", ".", 1))
                raise InputError(
                    f"{self.where}: its pickle uses {op}, which no network needs; nothing of it was executed"
                )
        return False

    def result(self) -> Any:
        (value,) = self.pop(1)
        if self.stack:
            raise ValueError("values left over at its end")
        return value

    def pop(self, count: int) -> list[Any]:
        """The last `count` values."""
        values = self.stack[-count:]
        if len(values) < count or any(v is _MARK for v in values):
            raise LookupError("too few values on its stack")
        del self.stack[-count:]
        return values

    def pop_to_mark(self) -> list[Any]:
        """All values above the last mark."""
        at = len(self.stack) - 1
        while at >= 0 and self.stack[at] is not _MARK:
            at -= 1
        if at < 0:
            raise LookupError("no mark on its stack")
        values = self.stack[at + 1 :]
        del self.stack[at:]
        return values

    def top(self) -> Any:
        """The last value, left in its place."""
        if not self.stack or self.stack[-1] is _MARK:
            raise LookupError("too few values on its stack")
        return self.stack[-1]

    def named(self, name: str) -> Global:
        """The global called `name`, if it is admitted."""
        if name not in self.admitted:
            shown = ascii(name)[1:-1]
            shown = shown if len(shown) <= 80 else f"{shown[:77]}..."
            raise InputError(
                f"{self.where}: its pickle asks for {shown}, which no network needs; "
                "nothing of it was executed, do not load this file with other programs"
            )
        return Global(name)

    def extend(self, values: list[Any]) -> None:
        target = self.top()
        if not isinstance(target, list):
            raise TypeError(f"items for a {type(target).__name__}")
        target.extend(values)

    def update(self, pairs: list[Any]) -> None:
        target = self.top()
        items = target.items if isinstance(target, Made) else target
        if not isinstance(items, dict) or len(pairs) % 2:
            raise TypeError(f"keys and values for a {type(target).__name__}")
        for key, value in zip(pairs[::2], pairs[1::2], strict=True):
            if not isinstance(key, str | int):  # hashing nested tuples can take for ever
                raise TypeError(f"a key that is a {type(key).__name__}")
            items[key] = value
