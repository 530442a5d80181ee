"""The closed loop of `loop.py`, compiled; `closed_loop.LOOPS` opens this module."""

from collections.abc import Callable
from typing import Any

from numba import from_dtype, types

from magtwin.compiled import compiled, inlined
from magtwin.sim.motion import loop, walls

_MATRIX = types.Array(types.float64, 2, "C")
_NUMBERS = types.Array(types.int64, 1, "C")
_DRIVES, _GAINS, _STATES = (
    types.Array(from_dtype(kind), 1, "C") for kind in (loop.DRIVE, loop.GAINS, loop.STATE)
)
_SIGNATURE = (
    _NUMBERS,
    _DRIVES,
    _GAINS,
    _MATRIX,
    _MATRIX,
    _NUMBERS,
    _NUMBERS,
    _MATRIX,
    _MATRIX,
    _NUMBERS,
    _STATES,
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
    loop.way_open,
    loop.drive_on,
)
for _function in _IN_PLACE:
    inlined(_function, inline="always")
for _function in _CALLED:
    inlined(_function)

robots = compiled(*_SIGNATURE)(loop.robots)
"""`loop.robots`, compiled."""
