"""The page of a benchmark: every number that it shows, recomputed from the rows of the results."""

import re
from html import unescape

import numpy as np
import pyarrow.parquet as pq
import pytest
from matplotlib.colors import to_hex
from scipy.stats import binomtest

from magtwin.bench.report import report_results
from magtwin.bench.runner import benchmark
from magtwin.figures import canvas

pytest.importorskip("pandas")

SUITE = """
name = "uneven"
seed = 2

[[scenario]]
name = "known"
runs = 300
sessions = 3
duration_s = 12.0

[[scenario]]
name = "global"
runs = 300
duration_s = 14.0
prior = "global"

[[localizer]]
method = "odometry"

[[localizer]]
method = "smoother"

[[localizer]]
method = "ekf"
"""
RUNS = {"odometry": 3, "smoother": 3, "ekf": 5}
PLACES = ("known", "global")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Results of 3 and 5 of 300 runs, the folder of their report, and the figures in it."""
    folder = tmp_path_factory.mktemp("uneven")
    (folder / "uneven.toml").write_text(SUITE)
    benchmark(folder / "uneven.toml", folder / "results", runs=3, jobs=1)
    benchmark(folder / "uneven.toml", folder / "results", runs=5, localizers=["ekf"], jobs=1)
    figures, picture = {}, canvas.picture
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            canvas,
            "picture",
            lambda figure, *a, file, **k: (
                figures.update({file: figure}),
                picture(figure, *a, file=file, **k),
            )[1],
        )
        report_results([folder / "results"], folder / "page")
    return folder / "results", folder / "page", figures


@pytest.fixture(scope="module")
def raw(made):
    """Rows by scenario and localizer, as any reader of Parquet gives them."""
    tables = {place: pq.ParquetDataset(made[0] / "rows" / place).read().to_pandas() for place in PLACES}
    times = {place: pq.ParquetDataset(made[0] / "times" / place).read().to_pandas() for place in PLACES}
    return {
        (place, name): (tables[place].query("localizer == @name"), times[place].query("localizer == @name"))
        for place in PLACES
        for name in RUNS
    }


def tables_of(page):
    """Rows of the tables of the page by section, table and first cell."""
    section = title = ""
    head, found = [], {}
    for line in page.read_text().splitlines():
        for level, heading in re.findall(r"<h([23])>(.*?)</h", line):
            section, title = (heading, "") if level == "2" else (section, unescape(heading))
        if line.startswith("<thead>"):
            head = re.findall(r"<th [^>]*>(.*?)</th>", line)
        elif line.startswith('<tr><th scope="row">'):
            line = re.sub(r'<span class="label">.*?</span>', "", line)
            cells = re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", line)
            cells = [unescape(re.sub(r"<[^>]*>", "", cell)) for cell in cells]
            found[section, title, cells[0]] = dict(zip(map(unescape, head), cells, strict=True))
    return found


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def number(value, digits=3):
    return "" if np.isnan(value) else f"{value:.{digits}f}"


def test_every_number_of_the_page_is_that_of_the_raw_rows(made, raw):
    tables = tables_of(made[1] / "bench.html")
    for (place, name), (rows, times) in raw.items():
        assert len(rows) == RUNS[name]
        anees = rows.anees[np.isfinite(rows.anees)]
        bound = rms(rows.bound_smoothed_m if name == "smoother" else rows.bound_correlated_m)
        shown = tables[place, "Accuracy", name]
        assert shown["runs"] == str(len(rows))
        assert shown["RMSE [m]"].split(" (")[0] == number(rms(rows.rmse_m))
        assert shown["median [m]"].split(" (")[0] == number(np.median(rows.rmse_m))
        assert shown["95th percentile [m]"] == number(np.percentile(rows.rmse_m, 95))
        assert shown["bound [m]"] == number(bound)
        assert shown["RMSE / bound"] == number(rms(rows.rmse_m) / bound, 2)
        assert shown["heading [deg]"] == number(np.degrees(rms(rows.heading_rad)), 1)
        assert shown["us a step"] == number(np.median(times.step_us), 0)
        column = "bound_smoothed_m" if name == "smoother" else "bound_correlated_m"
        assert tables["Leaderboard", "Median RMSE of a run, and median bound [m]", name][place] == (
            f"{np.median(rows.rmse_m):.3f} ({np.median(rows[column]):.3f})"
        )
        shown = tables[place, "Reliability", name]
        if len(anees):
            middle, low, high = np.median(anees), *np.percentile(anees, (25, 75))
            inside = np.mean((rows.anees_low < rows.anees) & (rows.anees < rows.anees_high))
            assert shown["ANEES per state"] == f"{middle:.2f} ({low:.2f} to {high:.2f})"
            assert shown["runs consistent"] == f"{100 * inside:.0f} %"
            assert shown["in 90 % ellipse"] == f"{100 * rows.coverage.mean():.0f} %"
        else:
            assert {shown[key] for key in ("ANEES per state", "runs consistent", "in 90 % ellipse")} == {""}
        for key, count in (
            ("diverged [%]", int(rows.diverged.sum())),
            ("found in 30 s [%]", int((rows.converged_s <= 30).sum()) if place == "global" else None),
        ):
            if count is not None:
                ends = binomtest(count, len(rows)).proportion_ci(0.95, "exact")
                rate = [100 * value for value in (count / len(rows), *ends)]
                assert shown[key] == "{:.1f} ({:.1f} to {:.1f})".format(*rate)
        assert shown["lost"] == f"{100 * rows.lost_share.mean():.0f} %"
        assert shown["failed"] == str((rows.status != "ok").sum())


def test_each_curve_has_the_bound_of_its_own_row(made, raw):
    for place in PLACES:
        (ax,) = made[2][f"{place}_cdf"].axes
        lines = {to_hex(line.get_color()): [] for line in ax.lines}
        for line in ax.lines:
            lines[to_hex(line.get_color())].append(np.asarray(line.get_xdata(), float))
        named = {line.get_label(): to_hex(line.get_color()) for line in ax.lines}
        for name in RUNS:
            rows, _ = raw[place, name]
            errors, bound = lines[named[name]]
            np.testing.assert_allclose(errors[1:], np.clip(np.sort(rows.rmse_m), 0.01, 5))
            expected = rms(rows.bound_smoothed_m if name == "smoother" else rows.bound_correlated_m)
            np.testing.assert_allclose(bound, expected)


def test_the_bound_over_time_is_that_of_causal_methods_over_all_their_runs(made):
    table = pq.ParquetDataset(made[0] / "truths" / "known").read().to_pandas()
    bound = np.stack(table.bound_m)
    (ax,) = made[2]["known_time"].axes
    (line,) = (line for line in ax.lines if line.get_label() == "bound, RMS")
    np.testing.assert_allclose(line.get_ydata(), np.sqrt(np.mean(bound**2, axis=0)), rtol=1e-6)
