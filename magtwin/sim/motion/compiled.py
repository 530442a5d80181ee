"""The closed loop of `loop.py` as machine code: what `course.py` opens where it pays, and nobody else.

Nothing is computed here. Machine code is kept where numba keeps it, in `__pycache__` beside `loop.py` or,
where that cannot be written to, in the user's cache folder; where neither can, each process compiles anew.
Sums and products are neither reordered nor fused, so it gives the bits that plain Python gives.
"""

from collections.abc import Callable
from typing import Any

from numba import njit, types
from numba.extending import register_jitable

from magtwin.sim.motion import loop

_VECTOR = types.Array(types.float64, 1, "C")
_MATRIX = types.Array(types.float64, 2, "C")
_NUMBERS = types.Array(types.int64, 1, "C")
_SIGNATURE = types.void(
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

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}

# What each step asks for is put in its place: as calls, which count references to every array that they
# are given, these would double the time of a step.
_IN_PLACE: tuple[Callable[..., Any], ...] = (loop.towards_point, loop.along_path, loop.commanded)
_CALLED: tuple[Callable[..., Any], ...] = (
    loop.wrapped,
    loop.limited,
    loop.clearance,
    loop.free_way,
    loop.drive_on,
)
for _part in _IN_PLACE:
    register_jitable(inline="always", **_OPTIONS)(_part)
for _part in _CALLED:
    register_jitable(**_OPTIONS)(_part)


def _compile() -> Any:
    try:
        return njit(_SIGNATURE, cache=True, **_OPTIONS)(loop.robots)
    except (RuntimeError, OSError):  # nowhere to keep it, or no room there
        return njit(_SIGNATURE, **_OPTIONS)(loop.robots)


robots = _compile()
"""`loop.robots`, compiled."""
