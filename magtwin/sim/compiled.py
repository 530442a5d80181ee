"""The closed loop of `loop.py` as machine code: what `course.py` opens where it pays, and nobody else.

Nothing is computed here. Machine code is kept where numba keeps it, in `__pycache__` beside `loop.py` or,
where that cannot be written to, in the user's cache folder; where neither can, each process compiles anew.
Sums and products are neither reordered nor fused, so it gives the bits that plain Python gives.
"""

from typing import Any

from numba import njit, types
from numba.extending import register_jitable

from magtwin.sim import loop

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

for _part in (
    loop.wrapped,
    loop.limited,
    loop.towards_point,
    loop.along_path,
    loop.commanded,
    loop.clearance,
    loop.free_way,
    loop.drive_on,
):
    register_jitable(nogil=True, error_model="numpy")(_part)


def _compile() -> Any:
    try:
        return njit(_SIGNATURE, cache=True, nogil=True, error_model="numpy")(loop.robots)
    except (RuntimeError, OSError):  # nowhere to keep it, or no room there
        return njit(_SIGNATURE, nogil=True, error_model="numpy")(loop.robots)


robots = _compile()
"""`loop.robots`, compiled."""
