import dataclasses
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.colors import to_rgb

from magtwin.errors import InputError
from magtwin.field.maps.difference import difference
from magtwin.field.maps.map import AnomalyMap
from magtwin.figures.canvas import save
from magtwin.figures.maps import FloorPlan, draw_difference, draw_map
from magtwin.figures.runs import draw_run
from magtwin.figures.style import MASKED
from magtwin.run.run import Run

FOUR = np.radians([0.0, 90.0, 180.0, 270.0])


def field_map(**more):
    x, y = np.meshgrid(np.linspace(-3, 3, 9), np.linspace(-1.75, 1.75, 6))
    values = 41_000 + 800 * x - 500 * y * x + 300 * np.cos(FOUR)[:, None, None]
    return AnomalyMap(
        values_nt=values, origin_m=(-3.0, -1.75), cell_m=(0.75, 0.7), headings_rad=FOUR, name="hall", **more
    )


def a_run(rows=400, **changed):
    t = np.arange(rows) / 10
    p = np.column_stack([2 * np.sin(t / 5), np.sin(t / 2.5), 0 * t])
    columns = {
        "t": t,
        "p_world_base": p,
        "v_base": np.tile([0.2, 0, 0], (rows, 1)),
        "battery_v": 16 - t / 1000,
        "lidar_on": (t % 20) > 12,
        "b_map_nt": 41_000 + 800 * p[:, 0],
        "b_disturbance_nt": 300 * np.cos(t),
        "b_total_nt": 41_000 + 800 * p[:, 0] + 300 * np.cos(t),
    }
    return Run({**columns, **changed}, {"scene": "hall", "path": "figure8"})


def plot_map(field, out, *, force=False, what="field", **options):
    save(draw_map(field, what=what, **options), out, force=force)


def pixels(file):
    """Width, height and colours (H, W, 4) of a PNG that matplotlib reads back."""
    from matplotlib.image import imread

    return imread(file)


def test_turning_the_layers_by_a_quarter_turns_the_panels(tmp_path):
    field = field_map()
    turned = AnomalyMap(
        values_nt=np.roll(field.values_nt, 1, axis=0),
        origin_m=field.origin_m,
        cell_m=field.cell_m,
        headings_rad=FOUR,
        name="hall",
    )
    plot_map(field, tmp_path / "a.png", headings=[0.0])
    plot_map(turned, tmp_path / "b.png", headings=[np.pi / 2])
    a, b = pixels(tmp_path / "a.png"), pixels(tmp_path / "b.png")
    below_the_title = slice(len(a) // 3, None)
    assert np.array_equal(a[below_the_title], b[below_the_title])


def test_the_same_map_gives_the_same_bytes_without_date_and_version(tmp_path):
    valid = np.ones((4, 6, 9), bool)
    valid[:, 2, 3] = False
    for name in ("a.png", "b.png", "a.svg", "b.svg"):
        plot_map(field_map(valid=valid), tmp_path / name)
    png, svg = ((tmp_path / f"a.{kind}").read_bytes() for kind in ("png", "svg"))
    assert png == (tmp_path / "b.png").read_bytes()
    assert svg == (tmp_path / "b.svg").read_bytes()
    assert b"tEXt" not in png
    assert b"<dc:date>" not in svg
    assert b"Matplotlib v" not in svg


def texts(file):
    """Texts of an SVG, joined."""
    root = ElementTree.parse(file).getroot()
    return " | ".join("".join(e.itertext()).strip() for e in root.iter("{http://www.w3.org/2000/svg}text"))


def a_peak(**more):
    """One heading with a peak of 50 uT at (1.5, 0.7), on 42 uT."""
    x, y = np.meshgrid(np.linspace(-3, 3, 25), np.linspace(-1.75, 1.75, 15))
    values = 42_000 + 8_000 * np.exp(-((x - 1.5) ** 2 + (y - 0.7) ** 2))
    return AnomalyMap(
        values_nt=values[None], origin_m=(-3.0, -1.75), cell_m=(0.25, 0.25), headings_rad=[0.0], **more
    )


def pixel_at(picture, x, y, about=0):
    """Colour of the panel at a point of a floor of 6 x 3.5 m; the panel is what most of the picture is.

    With `about`, the colours of the pixels around it, shape (N, 3).
    """
    ink = np.any(picture[..., :3] < 0.99, axis=-1)
    rows, columns = np.flatnonzero(ink.mean(axis=1) > 0.5), np.flatnonzero(ink.mean(axis=0) > 0.5)
    columns = columns[: np.flatnonzero(np.diff(columns, append=1e6) > 1)[0] + 1]  # without the bar's
    j = rows[-1] + (rows[0] - rows[-1]) * (y + 1.75) / 3.5
    i = columns[0] + (columns[-1] - columns[0]) * (x + 3) / 6
    if not about:
        return picture[round(j), round(i), :3]
    rows, columns = (slice(round(k) - about, round(k) + about + 1) for k in (j, i))
    return picture[rows, columns, :3].reshape(-1, 3)


def test_the_peak_is_bright_where_it_lies_and_the_rest_dark(tmp_path):
    from matplotlib import colormaps

    plot_map(a_peak(), tmp_path / "a.png")
    picture = pixels(tmp_path / "a.png")
    assert np.allclose(pixel_at(picture, 1.5, 0.7), colormaps["viridis"](1.0)[:3], atol=0.12)
    for x, y in ((-2.9, -1.6), (-1.5, 0.7), (1.5, -1.7)):
        assert np.allclose(pixel_at(picture, x, y), colormaps["viridis"](0.0)[:3], atol=0.06)


def test_a_masked_node_is_grey_over_its_cell_and_no_farther(tmp_path):
    valid = np.ones((1, 15, 25), bool)
    valid[0, 4:7, 5:8] = False  # x from -1.75 to -1.25, y from -0.75 to -0.25, and half a cell about it
    plot_map(a_peak(valid=valid), tmp_path / "a.png")
    picture = pixels(tmp_path / "a.png")

    def grey(x, y):
        seen = np.median(pixel_at(picture, x, y, about=6), axis=0)  # most pixels are not hatched
        return np.allclose(seen, to_rgb(MASKED), atol=0.02)

    assert all(grey(x, y) for x in (-1.8, -1.5, -1.2) for y in (-0.8, -0.5, -0.2))
    assert not any(grey(x, -0.5) for x in (-2.0, -1.0))
    assert not any(grey(-1.5, y) for y in (-1.0, 0.0))


UNKNOWN = np.zeros((4, 6, 9), bool)
NOT_DRAWN = [
    (lambda: draw_map(a_peak(), what="variance"), "has no variance"),
    (lambda: draw_map(a_peak(), what="headings"), "has one heading only"),
    (lambda: draw_map(a_peak(), what="feild"), "did you mean 'field'"),
    (lambda: draw_map(field_map(), headings=[]), "one heading at least"),
    (lambda: draw_map(field_map(), headings=np.linspace(0, 6, 37)), "36 at most, .* got 37"),
    (lambda: draw_map(field_map(valid=UNKNOWN)), "no valid node"),
    (lambda: draw_run(a_run(rows=0)), "no rows"),
    (lambda: draw_run(Run({"t": a_run()["t"]})), "neither positions nor columns"),
]


@pytest.mark.parametrize(("draw", "words"), NOT_DRAWN, ids=range(len(NOT_DRAWN)))
def test_what_is_not_known_is_not_drawn(draw, words):
    with pytest.raises(InputError, match=words):
        draw()


def a_difference(**more):
    changed = a_peak().values_nt.copy()
    changed[0, 10, 6] += 500.0  # at (-1.5, 0.75)
    noise = np.random.default_rng(1).normal(0, 5, changed.shape)
    after = a_peak(name="after", created="2026-02-01", **more)
    after = dataclasses.replace(after, values_nt=changed + 80.0 + noise)
    return difference(a_peak(name="before", created="2026-01-01", **more), after)


def test_a_difference_is_red_where_the_field_rose_and_says_how_much_and_when(tmp_path):
    found = a_difference(variance_nt2=np.full((1, 15, 25), 12.5))
    save(draw_difference(found), tmp_path / "a.svg")
    save(draw_difference(found), tmp_path / "b.svg")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    words = texts(tmp_path / "a.svg")
    for part in (
        "before 2026-01-01 to after 2026-02-01",
        "common bias +79.7 nT",
        "1 of 375 nodes changed, in 1 region,",
        "local change [nT]",
        "changed region",
    ):
        assert part in words
    assert "robust spread" not in words
    save(draw_difference(found), tmp_path / "a.png")
    picture = pixels(tmp_path / "a.png")[:, : 1240 // 2]
    reds = (picture[..., 0] > 0.3) & (picture[..., 1] < 0.1) & (picture[..., 2] < 0.2)
    assert reds.any()


def test_each_quantity_of_the_overview_has_one_scale_over_all_maps():
    one, other = field_map(variance_nt2=np.full((4, 6, 9), 400.0)), field_map()
    other = dataclasses.replace(other, values_nt=other.values_nt + 5_000.0, name="after")
    figure = draw_map([one, other])
    shown = [ax for ax in figure.axes if ax.get_visible() and ax.get_title(loc="left")]
    titles = [ax.get_title(loc="left") for ax in shown]
    assert [title.partition(",")[0] for title in titles] == [
        "hall",
        "after",
        "hall",
        "after",
        "hall",
        "hall",
        "after",
    ]
    norms = {}
    for ax, title in zip(shown, titles, strict=True):
        norms.setdefault(title.partition(", ")[2], []).append(ax.collections[0].norm.boundaries)
    assert len(norms) == 4
    for mine in norms.values():
        np.testing.assert_array_equal(mine[0], mine[-1])
    effect = ax_values(shown[2])
    np.testing.assert_allclose(effect, np.ptp(one.values_nt, axis=0))
    np.testing.assert_allclose(ax_values(shown[4]), 20.0)
    along_y, along_x = np.gradient(one.values_nt.mean(axis=0), 0.7, 0.75)
    np.testing.assert_allclose(ax_values(shown[5]), np.hypot(along_x, along_y))
    assert len([ax for ax in figure.axes if "nT" in ax.get_ylabel()]) == 4  # a bar each


def ax_values(ax):
    """What the cells of a panel hold, shape (Y, X)."""
    return np.asarray(ax.collections[0].get_array())


def test_a_run_is_drawn_by_what_the_map_lacks_on_a_scale_about_zero():
    from magtwin.figures.runs import panels_of

    run = a_run(b_sd_nt=np.full(400, 50.0))
    truth = run["b_total_nt"] + 30.0
    run = run.with_columns(b_truth_nt=truth, b_measured_nt=truth + 5.0)
    lacks, error, *_ = panels_of(run)
    curves = {name: values for name, values, _ in lacks.curves}
    np.testing.assert_allclose(curves["reading − map"], run["b_measured_nt"] - run["b_map_nt"])
    np.testing.assert_allclose(curves["predicted"], run["b_disturbance_nt"])
    np.testing.assert_allclose(lacks.band[1], 1.6448536 * 50.0)
    ((name, values, _),) = error.curves
    assert name == "prediction − exact: mean size 30 nT"
    np.testing.assert_allclose(values, -30.0)
    figure = draw_run(run, field_map())
    (trail,) = [part for part in figure.axes[0].collections if part.get_cmap().name == "RdBu_r"]
    low, high = trail.get_clim()
    assert low == -high
    assert len({part.get_cmap().name for part in figure.axes[0].collections}) == 2  # the map, and the trail


@pytest.mark.parametrize("field", [field_map(), None], ids=["map", "bare floor"])
def test_a_planned_path_is_drawn_and_the_same_run_gives_the_same_bytes(tmp_path, field):
    planned = np.array([[0, 0], [2, 1], [2, -1]])
    for name, plan in (("a", planned), ("b", planned), ("c", None)):
        save(draw_run(a_run(), field, plan), tmp_path / f"{name}.png")
    a, b, c = ((tmp_path / f"{name}.png").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_a_name_with_dollars_is_a_name_and_no_formula(tmp_path):
    field = dataclasses.replace(field_map(), name=r"a $\frac{ b$")
    plot_map(field, tmp_path / "a.svg", what="mask")
    assert r"a $\frac{ b$" in (tmp_path / "a.svg").read_text()


def test_a_picture_of_another_kind_or_in_the_place_of_another_is_refused(tmp_path):
    out = tmp_path / "a.png"
    with pytest.raises(InputError, match=r"a\.jpg: a picture ends in \.png or \.svg"):
        plot_map(a_peak(), tmp_path / "a.jpg")
    out.write_text("mine")
    with pytest.raises(InputError, match=r"a\.png: exists already"):
        plot_map(field_map(), out)
    assert out.read_text() == "mine"
    plot_map(field_map(), out, force=True)
    assert out.read_bytes().startswith(b"\x89PNG")


def test_control_characters_of_a_name_leave_the_picture_well_formed(tmp_path):
    field = dataclasses.replace(field_map(), name="hall\x1b[31m\x9b\u202e</text>")
    save(draw_map(field), tmp_path / "map.svg")
    text = (tmp_path / "map.svg").read_text(encoding="utf-8")
    ElementTree.fromstring(text)
    assert not set(text) & set("\x1b\x9b\u202e")


def test_a_map_of_one_value_has_one_colour_and_one_number():
    noise = 1e-9 * np.random.default_rng(0).normal(size=field_map().values_nt.shape)
    flat = dataclasses.replace(field_map(), values_nt=44_221.5 + noise)
    figure = draw_map(flat, what="field")
    bar = figure.axes[-1]
    assert bar.get_yticks().tolist() == [44_221.5]
    drawn = [c for ax in figure.axes[:-1] for c in ax.collections]
    assert all(len(c.get_cmap().colors) == 1 for c in drawn)


def test_a_map_is_cut_to_a_floor_with_corners():
    floor = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]])
    figure = draw_map(field_map(), what="field", plan=FloorPlan((), floor=floor))
    cut = [drawn.get_clip_path() for drawn in figure.axes[0].collections]
    assert cut
    assert all(len(path.get_fully_transformed_path().vertices) == len(floor) + 1 for path in cut)
