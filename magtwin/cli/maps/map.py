"""The `magtwin map` group, and options that its commands share."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter

from magtwin.cli.app import app
from magtwin.errors import InputError

map_app = App(name="map", help="Import, fit, survey, validate and compare anomaly maps.")
app.command(map_app)

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


def earth_nt(text: str) -> tuple[float, float, float]:
    """The Earth's field of `--earth` [nT]."""
    from magtwin.author.earth import earth_of

    try:
        return earth_of(text)
    except InputError as error:
        raise InputError(str(error), parameter="earth") from error
