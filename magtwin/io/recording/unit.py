"""Unit: the field of messages in nT, in the unit that is given or that makes it the Earth's field."""

import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, RepairWarning
from magtwin.field.units import INDOORS_NT, LEAST_USUAL_NT, MOST_USUAL_NT, NT_PER, USUAL_NT, Unit, nt_per

Array = NDArray[np.float64]

IRON = 2.0  # Factor by which iron near the sensor may change the median of the field


class Field(NamedTuple):
    """A magnetic field in nT."""

    b_nt: Array  # Magnitude [nT], shape (N,); nan for a message of 0, which is no field
    vector_nt: Array | None  # Vector [nT], shape (N, 3). None: the messages hold a magnitude.
    label: str  # Unit of the messages
    left_out: str  # How many messages are 0; "" if none are


def field_nt(
    b: Array,
    where: str,
    topic: str,
    *,
    unit: Unit | None = None,
    scale: float | None = None,
    standard: bool = True,
) -> Field:
    """The field of messages in nT, of magnitudes `b`, shape (N,), or vectors, shape (N, 3).

    Vectors whose y and z are all 0 are magnitudes in x, as APRILab's robot publishes them. A unit or a
    `scale` to nT that is given counts, with a warning if the median is not that of the Earth's field. Else
    the unit is the one that makes it so, up to twice too large or too small, as by iron near the sensor; this
    warns, unless it is the tesla of messages of a `standard` type of ROS. It is refused if no unit does, or
    no message holds a number; `where` is the file and `topic` the topic, for that.
    """
    vector = b if b.ndim == 2 and np.any(b[:, 1:] != 0) else None
    size = np.abs(b if b.ndim == 1 else b[:, 0]) if vector is None else np.linalg.norm(b, axis=1)
    zero = size == 0
    size = np.where(zero, np.nan, size)
    finite = size[np.isfinite(size)]
    if not len(finite):
        raise InputError(f"{where}: no message of {topic} holds a number")
    told = unit is not None or scale is not None
    if scale is None:
        unit = unit or unit_of(float(np.median(finite)), where, topic)
    factor = nt_per(unit, scale)
    usual = factor * float(np.median(finite))
    doubt = ""
    if not _is_earths(usual):
        of = f"in {unit}" if unit else f"with the scale {scale:g}"
        doubt = f"the median of {topic} is {usual:,.0f} nT {of}, not that of the Earth's field"
        doubt += ": iron near the sensor, or another unit (--unit, --scale)"
    elif not told and not (standard and unit == "T"):
        doubt = f"{topic} is taken as {unit} by its size, as that gives {usual:,.0f} nT (--unit)"
        if not INDOORS_NT[0] <= usual <= INDOORS_NT[1]:
            doubt += "; for a normalised sensor give --scale, the factor to nT"
    if doubt:
        warnings.warn(f"{where}: {doubt}", RepairWarning, stacklevel=3)
    label = unit or f"units of {scale:g} nT"
    text = f"{np.count_nonzero(zero)} of {len(b)} messages of {topic} as missing, which are 0"
    return Field(factor * size, None if vector is None else factor * vector, label, text * bool(zero.any()))


def unit_of(usual: float, where: str, topic: str) -> Unit:
    """The unit that makes a median magnitude the Earth's field, else that with iron; they do not overlap."""
    for apart in (1.0, IRON):
        for unit, factor in NT_PER.items():
            if _is_earths(usual * factor, apart):
                return unit  # type: ignore[return-value]
    advice = "give --unit, or for a normalised sensor --scale, the factor to nT"
    advice += f" ({USUAL_NT / usual:.4g} would make it {USUAL_NT:,.0f} nT)" if usual > 0 else ""
    text = f"the median of {topic} is {usual:.6g}; in no unit is that the Earth's field"
    raise InputError(f"{where}: {text}: {advice}")


def _is_earths(usual_nt: float, apart: float = 1.0) -> bool:
    """Whether a median may be that of the Earth's field, or up to a factor of it [nT]."""
    return LEAST_USUAL_NT / apart <= usual_nt < MOST_USUAL_NT * apart
