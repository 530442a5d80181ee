"""The picture of a localization: what is drawn, and that the same input gives the same bytes."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from matplotlib.collections import LineCollection

from magtwin.field.maps.map import AnomalyMap
from magtwin.figures.canvas import render
from magtwin.figures.localization import draw_localization, ellipse
from magtwin.frames import quat_from_yaw
from magtwin.localization.problem import Prior
from magtwin.run.run import Run
from magtwin.tasks.localizing import Localization, localization


@pytest.fixture(scope="module")
def result() -> Localization:
    t = np.arange(300) / 5
    p = np.column_stack([2 * np.sin(t / 9), np.sin(t / 5), 0 * t])
    yaw = np.unwrap(np.arctan2(np.gradient(p[:, 1]), np.gradient(p[:, 0])))
    x, y = np.meshgrid(np.linspace(-3, 3, 31), np.linspace(-1.75, 1.75, 21))
    field = AnomalyMap(
        values_nt=(41_000 + 800 * x - 500 * y * x)[None],
        origin_m=(-3.0, -1.75),
        cell_m=(0.2, 0.175),
        headings_rad=np.zeros(1),
        name="hall",
    )
    columns = {
        "t": t,
        "p_world_base": p,
        "yaw": yaw,
        "odom_p": 1.05 * (p - p[0]),
        "odom_q_xyzw": quat_from_yaw(yaw),
        "b_measured_nt": field.lookup(p[:, :2], yaw),
    }
    return localization(Run(columns), field, method="odometry", seed=1)


def test_paths_ellipses_errors_and_bound_are_drawn_and_named(result: Localization) -> None:
    figure = draw_localization(result)
    floor, position, heading = figure.axes[:3]
    names = [text.get_text() for text in floor.get_legend().get_texts()]
    assert names == ["dead reckoning", "true path", "estimate", "its 2-sigma ellipse", "start"]
    names = [text.get_text() for text in position.get_legend().get_texts()]
    assert names == ["2 sigma", "dead reckoning", "estimate", "bound, 1 sigma"]
    lines = {line.get_label(): line.get_xydata() for line in position.get_lines()}
    assert result.truth is not None
    off = np.hypot(*(result.track.pose - result.truth)[:, :2].T)
    np.testing.assert_allclose(lines["estimate"][:, 1], off)
    assert result.bounds is not None
    np.testing.assert_allclose(lines["bound, 1 sigma"][:, 1], result.bounds.correlated)
    (ellipses,) = [part for part in floor.collections if isinstance(part, LineCollection)]
    assert len(ellipses.get_paths()) == 12  # 60 s, one every 5 s
    assert (heading.get_xlabel(), heading.get_ylabel()) == ("time [s]", "heading\nerror [°]")
    assert result.report().verdict in figure.get_suptitle().replace("\n", " ")


def test_nothing_is_clipped_and_no_text_lies_on_another(result: Localization) -> None:
    """With long names, a logarithmic axis, and readings that are flagged as lost."""
    everywhere = Prior(sd=(np.inf,) * 3)
    result = localization(result.run, result.problem.belief, method="odometry", prior=everywhere)
    figure = draw_localization(result)
    data = render(figure, ".png")
    assert data == render(draw_localization(result), ".png")
    renderer = figure.canvas.get_renderer()
    floor, position, heading = figure.axes[:3]
    parts = [floor.get_legend(), floor.xaxis.label, position.get_legend(), heading.xaxis.label]
    boxes = [part.get_window_extent(renderer) for part in (figure._suptitle, *parts)]
    for box in boxes:
        assert box.x0 >= 0
        assert box.x1 <= figure.bbox.width
    for above, below in pairwise(boxes):
        assert above.y0 >= below.y1


def test_lost_readings_are_shaded_and_their_estimates_left_out(result: Localization) -> None:
    lost = result.track.t < 10
    track = dataclasses.replace(result.track, lost=lost)
    figure = draw_localization(dataclasses.replace(result, track=track))
    floor, position = figure.axes[:2]
    (estimate,) = [line for line in floor.get_lines() if line.get_label() == "estimate"]
    assert np.isnan(np.asarray(estimate.get_ydata(), float)).sum() == lost.sum()
    assert "flagged lost" in [text.get_text() for text in position.get_legend().get_texts()]


def test_an_ellipse_lies_two_standard_deviations_away() -> None:
    covariance = np.array([[0.04, 0.012], [0.012, 0.01]])
    away = ellipse(np.array([1.0, 2.0]), covariance) - (1.0, 2.0)
    mahalanobis = np.einsum("ni,ij,nj->n", away, np.linalg.inv(covariance), away)
    np.testing.assert_allclose(mahalanobis, 4.0, rtol=1e-9)
