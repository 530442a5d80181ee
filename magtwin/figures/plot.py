"""Plot: a run or a map as a matplotlib figure, for `magtwin.plot`, `run.plot()` and `anomaly_map.plot()`."""

from collections.abc import Sequence
from functools import partial

from matplotlib.figure import Figure

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.figures.canvas import plain_text, render
from magtwin.figures.maps import draw_map
from magtwin.figures.runs import draw_run
from magtwin.run.run import Run


def plot(
    what: Run | AnomalyMap,
    *,
    anomaly_map: AnomalyMap | None = None,
    quantity: str = "overview",
    headings: Sequence[float] | None = None,
) -> Figure:
    """Draw a run or a map.

    A run: the path over the floor, coloured by the reading less the map, and against time what the map lacks,
    the error of the prediction, the field, speed and battery, of those columns that it has. A map: filled
    contours of its mean, heading effect, standard deviation and gradient.

    Args:
        what: A `Run` or an `AnomalyMap`.
        anomaly_map: For a run: the map to draw below the path, as the mean over its headings. None draws a
            bare floor.
        quantity: For a map: "overview", "field", "gradient", "variance", "mask" or "headings"; see
            `magtwin.figures.maps.draw_map`.
        headings: For a map: headings to show [rad]. None shows the map's own, or about four of more than
            eight.

    Returns:
        A matplotlib figure without pyplot state. A notebook shows it; `savefig` writes it.

    Raises:
        InputError: `what` is neither a run nor a map, or has nothing that can be drawn.
    """
    if isinstance(what, Run):
        figure = draw_run(what, anomaly_map)
    elif isinstance(what, AnomalyMap):
        figure = draw_map(what, what=quantity, headings=headings)
    else:
        raise InputError(f"plot draws a Run or an AnomalyMap, got {type(what).__name__}")
    plain_text(figure)
    figure._repr_png_ = partial(render, figure, ".png")  # type: ignore[attr-defined]  # notebooks call this
    return figure
