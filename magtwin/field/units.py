"""Units of a field in files, and whether values can be the Earth's field in them."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, cast

from magtwin.errors import InputError

if TYPE_CHECKING:
    import numpy as np  # else only where it is used, since the command line imports this module for its help
    from numpy.typing import NDArray

Unit = Literal["nT", "uT", "T", "mG", "G"]

# Bounds of a survey's mean [nT]. The Earth's field is 22,000 to 67,000 nT; a building bends it.
LEAST_MEAN_NT, GREATEST_MEAN_NT = 10_000.0, 100_000.0
# Range of the median of readings from which their unit is deduced [nT]: the Earth's field and some steel
INDOORS_NT = 18_000.0, 75_000.0
USUAL_NT = 50_000.0  # Magnitude that a suggested scale would give [nT]
NT_PER: dict[str, float] = {"nT": 1.0, "uT": 1e3, "T": 1e9, "mG": 1e2, "G": 1e5}  # nT per unit
MIXED = 0.01  # Share of readings in another unit from which they count as mixed units, not as outliers


def _four(value: float) -> str:
    """Four significant digits, without an exponent for usual sizes."""
    return f"{float(f'{value:.4g}'):g}"


def nt_per(unit: str | None, scale: float | None) -> float:
    """Factor from a file's values to nT: `scale` if given, else that of the unit; None is nT."""
    return NT_PER[unit or "nT"] if scale is None else scale


def check_unit(
    b_nt: "NDArray[np.float64]",
    where: str,
    column: str,
    unit: str = "nT",
    row: Callable[[int], str] | None = None,
    scale: float | None = None,
) -> None:
    """Refuse readings whose mean cannot be the Earth's field, and readings in two units.

    Args:
        b_nt: Field magnitudes [nT], shape (N,).
        where: File, for the error.
        column: Column, for the error.
        unit: Unit that the file was read in.
        row: Gives the place of a reading from its index. Default: the file.
        scale: Factor from the file's values to nT, in place of a unit.

    Raises:
        InputError: The mean is outside 10,000..100,000 nT (the text names the unit that would fit), or more
            than 1 % of the readings are off by the factor of another unit.
    """
    import numpy as np

    usual = float(np.sort(b_nt)[len(b_nt) // 2])
    for other, factor in NT_PER.items():
        ratio = b_nt / usual * factor / NT_PER[unit]
        odd = np.flatnonzero((np.abs(np.log10(np.maximum(ratio, 1e-12))) < 0.3) & (other != unit))
        if LEAST_MEAN_NT <= usual <= GREATEST_MEAN_NT and len(odd) > max(1, MIXED * len(b_nt)):
            first = int(odd[0])
            raise InputError(
                f"{row(first) if row else where}: {column} is {b_nt[first]:.6g} nT, where most readings are "
                f"about {usual:,.0f} nT; it and {len(odd) - 1} more would fit in {other}: give all rows in "
                "one unit"
            )
    mean = float(b_nt.mean())
    if LEAST_MEAN_NT <= mean <= GREATEST_MEAN_NT:
        return
    if scale is not None:
        raise InputError(
            f"{where}: the mean of {column} is {mean:.6g} nT with scale {scale:g}, outside "
            f"{LEAST_MEAN_NT:,.0f}..{GREATEST_MEAN_NT:,.0f} nT; --scale {_four(scale * USUAL_NT / mean)} "
            f"would make it {USUAL_NT:,.0f} nT"
        )
    number = mean / NT_PER[unit]
    could = {other: number * factor for other, factor in NT_PER.items()}
    could = {other: value for other, value in could.items() if LEAST_MEAN_NT <= value <= GREATEST_MEAN_NT}
    advice = " or ".join(
        f"in {other} it would be {value:,.0f} nT: give --unit {other}" for other, value in could.items()
    )
    if not any(INDOORS_NT[0] <= value <= INDOORS_NT[1] for value in could.values()):
        no_unit = "no usual unit makes it the Earth's field"
        advice = (
            f"{advice or no_unit}; for a normalised sensor give --scale, the factor to nT "
            f"({_four(USUAL_NT / number)} would make it {USUAL_NT:,.0f} nT)"
        )
    raise InputError(
        f"{where}: the mean of {column} is {mean:.6g} nT, outside {LEAST_MEAN_NT:,.0f}.."
        f"{GREATEST_MEAN_NT:,.0f} nT; {advice}"
    )


def unit_by_size(b: "NDArray[np.float64]") -> Unit | None:
    """Deduce the unit in which magnitudes have the size of the Earth's field indoors; None if none fits.

    Args:
        b: Magnitudes as the file has them, shape (N,); nan is ignored.
    """
    import numpy as np

    b = np.abs(b[np.isfinite(b)])
    if not len(b):
        return None
    usual = float(np.median(b))
    low, high = INDOORS_NT
    fits = (unit for unit, nt in NT_PER.items() if low <= usual * nt <= high)
    return cast(Unit | None, next(fits, None))
