"""The closed loop of `loop.py`, compiled; `closed_loop.LOOPS` opens this module."""

from collections.abc import Callable
from typing import Any

from numba import types

from magtwin.compiled import compiled, inlined
from magtwin.sim.motion import loop, walls

_MATRIX = types.Array(types.float64, 2, "C")
_NUMBERS = types.Array(types.int64, 1, "C")
_SIGNATURE = (
    _NUMBERS,
    _MATRIX,
    _MATRIX,
    _NUMBERS,
    _NUMBERS,
    _MATRIX,
    _MATRIX,
    _NUMBERS,
    _MATRIX,
    types.int64,
    types.int64,
    types.Array(types.float64, 3, "C"),
    _NUMBERS,
)

# A call counts references to every array that it is given, which would double the time of a step.
_IN_PLACE: tuple[Callable[..., Any], ...] = (loop.towards_point, loop.along_path, loop.commanded)
_CALLED: tuple[Callable[..., Any], ...] = (
    loop.wrapped,
    loop.limited,
    loop.perceived,
    walls.clearance,
    walls.free_way,
    loop.drive_on,
)
for _function in _IN_PLACE:
    inlined(_function, inline="always")
for _function in _CALLED:
    inlined(_function)

robots = compiled(*_SIGNATURE)(loop.robots)
"""`loop.robots`, compiled."""
