"""Elementary functions of one number that the compiler turns into vector code, and normal random numbers.

Logarithms, exponentials, sines and cosines are polynomials, whose errors are below 1e-13. Random numbers are
a function of a key, a number and the number of the draw, so that they can be drawn in any order. Importing
this module opens numba.
"""

import math
from functools import partial

import numpy as np

from magtwin.compiled import inlined

GOLDEN, MIX_1, MIX_2 = (np.uint64(k) for k in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))
_S20, _S27, _S30, _S31, _S32, _S52 = (np.uint64(k) for k in (20, 27, 30, 31, 32, 52))
_LOW = np.uint64(0xFFFFFFFF)
_MANTISSA, _ONE_BITS, _WHOLE_BITS = (
    np.uint64(k) for k in (0x000FFFFFFFFFFFFF, 0x3FF0000000000000, 0x4330000000000000)
)
_WHOLE = 2.0**52  # The float of _WHOLE_BITS: an integer in its lowest bits is the float plus that integer
_LN2, _SQRT2, _TURN = math.log(2), math.sqrt(2), 2 * math.pi

_SIN = tuple((-1) ** k * _TURN ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(10))
_EXP = tuple(1 / math.factorial(k) for k in range(13))


whole = partial(inlined, forceinline=True)
"""As `inlined`, and always so: a loop becomes vector code only if all of it stands in one function."""


@whole
def mix(z: np.uint64) -> np.uint64:
    """A hash of 64 bits (the finalizer of splitmix64: Steele, Lea and Flood 2014)."""
    z = (z ^ (z >> _S30)) * MIX_1
    z = (z ^ (z >> _S27)) * MIX_2
    return z ^ (z >> _S31)


@whole
def sine_of_turns(u: float) -> float:
    """sin(2 pi u) for u in [-1/4, 1/4]."""
    z = u * u
    (c0, c1, c2, c3, c4, c5, c6, c7, c8, c9) = _SIN
    p = c5 + z * (c6 + z * (c7 + z * (c8 + z * c9)))
    return u * (c0 + z * (c1 + z * (c2 + z * (c3 + z * (c4 + z * p)))))


@whole
def logarithm(x: float) -> float:
    """log(x) for x > 0 and not subnormal."""
    bits = np.float64(x).view(np.uint64)
    m = np.uint64((bits & _MANTISSA) | _ONE_BITS).view(np.float64)
    e = np.uint64((bits >> _S52) | _WHOLE_BITS).view(np.float64)
    big = m > _SQRT2
    v = 0.5 * m if big else m
    k = e - (_WHOLE + 1022 if big else _WHOLE + 1023)
    t = (v - 1) / (v + 1)
    z = t * t
    p = 1 / 9 + z * (1 / 11 + z * (1 / 13 + z * (1 / 15 + z / 17)))
    return k * _LN2 + 2 * t * (1 + z * (1 / 3 + z * (1 / 5 + z * (1 / 7 + z * p))))


@whole
def exponential(x: float) -> float:
    """exp(x) for x <= 0; 0 below -700."""
    (c0, c1, c2, c3, c4, c5, c6, c7, c8, c9, c10, c11, c12) = _EXP
    v = max(x, -700.0)
    k = np.floor(v / _LN2 + 0.5)
    r = v - k * _LN2
    p = c6 + r * (c7 + r * (c8 + r * (c9 + r * (c10 + r * (c11 + r * c12)))))
    p = c0 + r * (c1 + r * (c2 + r * (c3 + r * (c4 + r * (c5 + r * p)))))
    power = np.uint64(np.float64(k + (_WHOLE + 1023)).view(np.uint64) << _S52).view(np.float64)
    return p * power if x > -700 else 0.0


@whole
def cosine_sine(turns: float) -> tuple[float, float]:
    """cos(2 pi u) and sin(2 pi u) for u in [-1/2, 1/2]."""
    far, half = abs(turns) > 0.25, 0.5 if turns > 0 else -0.5
    return sine_of_turns(0.25 - abs(turns)), sine_of_turns(half - turns if far else turns)


@whole
def centred(angle: float) -> float:
    """An angle [rad] in turns, in [-1/2, 1/2]."""
    turns = angle / _TURN
    return turns - np.floor(turns + 0.5)


@whole
def stream(key: np.uint64, draw: int) -> np.uint64:
    """Start of the random numbers of one draw of all particles."""
    return key + mix(np.uint64(draw) * GOLDEN)


@whole
def normals(start: np.uint64, number: np.uint64) -> tuple[float, float]:
    """Two standard normal numbers of the particle of a number (Box and Muller 1958)."""
    z = mix(start + number * GOLDEN)
    high = np.uint64(((z >> _S32) << _S20) | _ONE_BITS).view(np.float64)
    low = np.uint64(((z & _LOW) << _S20) | _ONE_BITS).view(np.float64)
    radius = math.sqrt(-2 * logarithm(2 - high))
    c, s = cosine_sine(low - 1.5)
    return radius * c, radius * s
