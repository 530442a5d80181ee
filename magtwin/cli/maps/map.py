"""The `magtwin map` group, and options that its commands share."""

import warnings
from math import radians
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from magtwin.cli.app import app
from magtwin.errors import InputError, RepairWarning

map_app = App(name="map", help="Import, fit, validate, compare and draw anomaly maps.")
app.command(map_app)

MOST_HEADINGS = 720
"""Most headings of a map."""

LAYERS = (".usdc", ".usd")
PICTURES = (".png", ".svg")

MapFile = Annotated[
    Path,
    Parameter(
        help="Map layer or stage (.usd, .usda, .usdc), a folder of survey CSVs, or a shipped scene's name: "
        "lab."
    ),
]
Kernel = Annotated[
    Literal["matern", "poisson"] | None,
    Parameter(
        help="Covariance of the Gaussian process: Matern of order 5/2, or Poisson (a field above "
        "uncorrelated sources). Default: poisson."
    ),
]
Earth = Annotated[
    str | None,
    Parameter(
        help="The Earth's field for the harmonic fit, in one of three forms: the file of a scene; "
        "latitude,longitude,height,date [deg, deg, m, YYYY-MM-DD], if the world's y axis points to true "
        "north; or components x,y,z in world axes [nT]. Default: the field stored in the survey, as in "
        "surveys of a simulated lab."
    ),
]
Sources = Annotated[Path, Parameter(required=True)]


def headings_rad(text: str) -> list[float]:
    """Headings such as 0,90,180,270 [deg] in radians, each once, ascending; warns of repeated ones."""
    try:
        given = [float(word) % 360 for word in text.split(",")]
    except ValueError:
        given = []
    degrees = sorted(set(given))
    if not degrees or any(h != h for h in degrees):
        raise InputError(
            f"--headings-deg: headings are degrees with commas between, such as 0,90,180,270; got {text!r}"
        )
    if len(degrees) > MOST_HEADINGS:
        raise InputError(f"--headings-deg names {len(degrees):,} headings; take {MOST_HEADINGS} at most")
    if len(degrees) < len(given):
        count = f"{len(degrees)} heading{'s' if len(degrees) > 1 else ''}"
        warnings.warn(
            f"--headings-deg {text}: {count}, as some are equal (360 is 0)", RepairWarning, stacklevel=2
        )
    return [radians(h) for h in degrees]


def earth_nt(text: str) -> tuple[float, float, float]:
    """The Earth's field of `--earth` [nT]."""
    from magtwin.author.earth import earth_of

    try:
        return earth_of(text)
    except InputError as error:
        raise InputError(str(error), parameter="earth") from error
