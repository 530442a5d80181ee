import struct
import subprocess
import sys

import numpy as np
import pytest

from magtwin.field.map import AnomalyMap
from magtwin.io.plots import plot_map, plot_run
from magtwin.names import RefusedError
from magtwin.run import Run

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


def pixels(file):
    """Width, height and colours (H, W, 4) of a PNG that matplotlib reads back."""
    from matplotlib.image import imread

    return imread(file)


def test_a_map_is_drawn_with_a_panel_a_heading(tmp_path):
    plot_map(field_map(), tmp_path / "four.png")
    plot_map(field_map(), tmp_path / "one.png", headings=[0.3])
    four, one = pixels(tmp_path / "four.png"), pixels(tmp_path / "one.png")
    assert four.shape[0] > one.shape[0]
    assert four.shape[1] > 1.5 * one.shape[1]
    assert len(np.unique(four.reshape(-1, 4), axis=0)) > 100  # colours of a field, not an empty frame


def test_three_headings_leave_the_fourth_panel_empty(tmp_path):
    plot_map(field_map(), tmp_path / "three.png", headings=FOUR[:3])
    picture = pixels(tmp_path / "three.png")
    height, width = picture.shape[:2]
    corner = picture[int(0.6 * height) : int(0.85 * height), int(0.5 * width) : int(0.8 * width), :3]
    assert np.all(corner == 1)


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
    below_the_title = slice(len(a) // 4, None)
    assert np.array_equal(a[below_the_title], b[below_the_title])


def test_masked_nodes_look_unlike_any_field(tmp_path):
    valid = np.ones((4, 6, 9), bool)
    valid[:, 2:4, 3:6] = False
    plot_map(field_map(valid=valid), tmp_path / "masked.png", headings=[0.0])
    picture = pixels(tmp_path / "masked.png")[..., :3]
    ground = np.all(np.abs(picture - 0.85) < 0.01, axis=-1)
    plot_map(field_map(), tmp_path / "whole.png", headings=[0.0])
    whole = np.all(np.abs(pixels(tmp_path / "whole.png")[..., :3] - 0.85) < 0.01, axis=-1)
    assert ground.mean() > 0.01 > whole.mean()


def test_one_map_gives_one_file_to_the_byte_without_date_or_version(tmp_path):
    plot_map(field_map(), tmp_path / "a.png")
    plot_map(field_map(), tmp_path / "b.png")
    data = (tmp_path / "a.png").read_bytes()
    assert data == (tmp_path / "b.png").read_bytes()
    assert set(chunks(data)) <= {b"IHDR", b"pHYs", b"IDAT", b"IEND"}


def chunks(data):
    """Names of a PNG's chunks: length, name, content and checksum follow one another after 8 bytes."""
    at, names = 8, []
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        names.append(data[at + 4 : at + 8])
        at += 12 + length
    return names


@pytest.mark.parametrize("field", [field_map(), None], ids=["map", "bare floor"])
def test_a_run_is_drawn_with_and_without_its_map_and_plan(tmp_path, field):
    planned = np.array([[0, 0], [2, 1], [2, -1]])
    plot_run(a_run(), field, tmp_path / "a.png", planned)
    plot_run(a_run(), field, tmp_path / "b.png", planned)
    plot_run(a_run(), field, tmp_path / "c.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a.png").read_bytes() != (tmp_path / "c.png").read_bytes()


def test_a_run_off_the_map_is_drawn_with_gaps(tmp_path):
    total = np.array(a_run()["b_total_nt"])
    total[100:] = np.nan
    plot_run(a_run(b_total_nt=total, b_map_nt=total), field_map(), tmp_path / "half.png")
    plot_run(a_run(b_total_nt=total * np.nan), field_map(), tmp_path / "none.png")
    plot_run(a_run(rows=1), None, tmp_path / "one.png")


def test_nothing_to_draw_is_refused_and_nothing_is_written(tmp_path):
    out = tmp_path / "a.png"
    with pytest.raises(RefusedError, match="headings must name one heading at least"):
        plot_map(field_map(), out, headings=[])
    with pytest.raises(RefusedError, match="map 'hall' has no valid node to draw"):
        plot_map(field_map(valid=np.zeros((4, 6, 9), bool)), out)
    with pytest.raises(RefusedError, match="the run has no rows"):
        plot_run(a_run(rows=0), None, out)
    with pytest.raises(RefusedError, match="no column 'battery_v'"):
        plot_run(Run({k: v for k, v in a_run().items() if k != "battery_v"}), None, out)
    assert not list(tmp_path.iterdir())


def test_a_picture_that_exists_is_kept_unless_force_is_given(tmp_path):
    out = tmp_path / "a.png"
    out.write_text("mine")
    with pytest.raises(RefusedError, match=r"a\.png: exists already"):
        plot_map(field_map(), out)
    assert out.read_text() == "mine"
    plot_map(field_map(), out, force=True)
    assert out.read_bytes().startswith(b"\x89PNG")


def test_plotting_leaves_pyplot_alone(tmp_path):
    code = (
        "import sys; from magtwin.io import plots; assert 'matplotlib' not in sys.modules;"
        "from magtwin.field.map import AnomalyMap; import numpy as np;"
        "m = AnomalyMap(values_nt=np.full((1, 2, 2), 4e4), origin_m=(0, 0), cell_m=(1, 1), headings_rad=[0]);"
        f"plots.plot_map(m, {str(tmp_path / 'a.png')!r}); sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
