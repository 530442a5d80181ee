"""Units of a field in files, and whether values can be the Earth's field in them."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, cast

from magtwin.errors import InputError

if TYPE_CHECKING:
    import numpy as np  # else only where it is used, since the command line imports this module for its help
    from numpy.typing import NDArray

Unit = Literal["nT", "uT", "T", "mG", "G"]

# Bounds of a survey's median [nT]. The Earth's field is 22,000 to 67,000 nT; a building bends it.
LEAST_USUAL_NT, MOST_USUAL_NT = 10_000.0, 100_000.0
# Range of the median of readings from which their unit is deduced [nT]: the Earth's field and some steel
INDOORS_NT = 18_000.0, 75_000.0
USUAL_NT = 50_000.0  # Magnitude that a suggested scale would give [nT]
NT_PER: dict[str, float] = {"nT": 1.0, "uT": 1e3, "T": 1e9, "mG": 1e2, "G": 1e5}  # nT per unit
BESIDE_STEEL = 10.0  # Factor by which they are wider for a unit that was told
MIXED = 0.01  # Share of readings in another unit from which they count as mixed units, not as outliers


def _four(value: float) -> str:
    """Four significant digits, without an exponent for usual sizes."""
    return f"{float(f'{value:.4g}'):g}"


def nt_per(unit: str | None, scale: float | None) -> float:
    """Factor from a file's values to nT: `scale` if given, else that of the unit; None is nT."""
    return NT_PER[unit or "nT"] if scale is None else scale


def check_factor(unit: str | None, scale: float | None) -> None:
    """Refuse a unit and a scale for the same field, and a scale that is no factor."""
    if scale is None:
        return
    if unit is not None:
        raise InputError("give either the unit of the field or its scale, the factor to nT")
    if not 0 < scale < float("inf"):
        raise InputError(f"scale, the factor to nT, must be above 0, got {scale:g}", parameter="scale")


def check_unit(
    b_nt: "NDArray[np.float64]",
    where: str,
    column: str,
    unit: str = "nT",
    row: Callable[[int], str] | None = None,
    scale: float | None = None,
    *,
    told: bool = False,
    p_xy: "NDArray[np.float64] | None" = None,
) -> str:
    """Refuse readings whose median cannot be the Earth's field, and readings in two units.

    Readings `b_nt` [nT] are in the order of the file `where`; `row` gives the place of one. If the unit was
    `told` by the header or the user, the median may be ten times beyond the bounds, as beside steel. With
    positions `p_xy` [m], (N, 2), rows in another unit are looked for. Returns a warning about a median that
    the Earth's field does not have; "" if it has.
    """
    import numpy as np

    usual = float(np.median(b_nt))
    if p_xy is not None:
        _check_one_unit(b_nt, p_xy, unit, f"{column} is", row or (lambda k: where))
    if LEAST_USUAL_NT <= usual <= MOST_USUAL_NT:
        return ""
    text = f"the median of {column} is {usual:.6g} nT"
    bounds = f"outside {LEAST_USUAL_NT:,.0f}..{MOST_USUAL_NT:,.0f} nT"
    kept = told and LEAST_USUAL_NT / BESIDE_STEEL <= usual <= MOST_USUAL_NT * BESIDE_STEEL
    if scale is not None:
        advice = f"--scale {_four(scale * USUAL_NT / usual)} would make it {USUAL_NT:,.0f} nT"
        text = f"{text} with scale {scale:g}, {bounds}; {advice}"
    else:
        number = usual / NT_PER[unit]
        could = {other: number * factor for other, factor in NT_PER.items()}
        could = {o: value for o, value in could.items() if LEAST_USUAL_NT <= value <= MOST_USUAL_NT}
        advice = " or ".join(
            f"in {other} it would be {value:,.0f} nT: give --unit {other}" for other, value in could.items()
        )
        if not kept and not any(INDOORS_NT[0] <= value <= INDOORS_NT[1] for value in could.values()):
            no_unit = "no usual unit makes it the Earth's field"
            advice = (
                f"{advice or no_unit}; for a normalised sensor give --scale, the factor to nT "
                f"({_four(USUAL_NT / number)} would make it {USUAL_NT:,.0f} nT)"
            )
        text = "; ".join(part for part in (f"{text}, {bounds}", advice) if part)
    if kept:
        return text
    raise InputError(f"{where}: {text}")


def _check_one_unit(
    b_nt: "NDArray[np.float64]",
    p_xy: "NDArray[np.float64]",
    unit: str,
    what: str,
    row: Callable[[int], str],
) -> None:
    """Refuse rows in another unit: they jump by its ratio in the file, and from the rows nearest in place.

    Beside steel, a field rises by degrees along the path and does neither.
    """
    import numpy as np

    usual = float(np.median(b_nt))
    for other, factor in NT_PER.items():
        ratio = factor / NT_PER[unit]
        odd = np.abs(np.log10(b_nt / usual * ratio)) < 0.3
        if other == unit or not MIXED * len(b_nt) < np.count_nonzero(odd) < len(b_nt) or odd.sum() < 2:
            continue
        from scipy.spatial import cKDTree

        edge = np.flatnonzero(np.diff(odd))
        near = np.flatnonzero(~odd)[cKDTree(p_xy[~odd]).query(p_xy[odd])[1]]
        jump = np.abs(np.log10(b_nt[edge + 1] / b_nt[edge]))
        in_file = np.median(np.abs(jump - abs(np.log10(ratio)))) < 0.3
        if in_file and np.median(np.abs(np.log10(b_nt[odd] * ratio / b_nt[near]))) < 0.15:
            first = int(np.argmax(odd))
            raise InputError(
                f"{row(first)}: {what} {b_nt[first]:.6g} nT, where most readings are about {usual:,.0f} nT; "
                f"it and {odd.sum() - 1} more would fit in {other}: give all rows "
                f"in one unit, or --unit {unit} if they are field"
            )


def unit_by_size(b: "NDArray[np.float64]") -> Unit | None:
    """Deduce the unit in which magnitudes have the size of the Earth's field indoors; None if none fits."""
    import numpy as np

    b = np.abs(b[np.isfinite(b)])
    if not len(b):
        return None
    usual = float(np.median(b))
    low, high = INDOORS_NT
    fits = (unit for unit, nt in NT_PER.items() if low <= usual * nt <= high)
    return cast(Unit | None, next(fits, None))
