"""The table of a Run."""

import itertools
import pickle
import runpy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from places import DOCS
from scipy.spatial.transform import Rotation, Slerp

import magtwin
from magtwin.errors import InputError, UnknownNameError
from magtwin.run.run import COLUMNS, Column, Run, numbers_in


def every_column(rows=40, seed=0, start_s=0.0):
    """A run with every column, random numbers in it, unit quaternions, nan where a run may have them."""
    rng = np.random.default_rng(seed)
    columns = {}
    for name, column in COLUMNS.items():
        shape = (rows,) if column.width == 1 else (rows, column.width)
        columns[name] = rng.random(shape) < 0.5 if column.unit == "bool" else rng.normal(0, 2, shape)
        if name.endswith("_xyzw"):
            columns[name] /= np.linalg.norm(columns[name], axis=1, keepdims=True)
    columns["t"] = start_s + np.cumsum(rng.uniform(0.001, 0.01, rows))
    columns["yaw"] = rng.uniform(-np.pi, np.pi, rows)
    columns["b_sd_nt"][::3] = np.nan
    return Run(columns, {"seed": seed, "path": "figure8"})


def assert_same(a, b):
    assert list(a) == list(b)
    for name in a:
        assert a[name].dtype == b[name].dtype, name
        assert a[name].tobytes() == b[name].tobytes(), name


def test_unequal_columns_and_wrong_shapes_are_refused():
    with pytest.raises(InputError, match=r"equally long, got {'t': 2, 'yaw': 3}"):
        Run({"t": [0, 1], "yaw": [0, 1, 2]})
    with pytest.raises(InputError, match=r"'odom_p' must have shape \(2, 3\), got \(2, 2\)"):
        Run({"odom_p": np.zeros((2, 2))})


def test_the_figures_of_a_report_are_those_of_the_raw_arrays():
    rng = np.random.default_rng(2)
    truth = 41e3 + rng.normal(0, 300, 400)
    total, beside = truth + rng.normal(0, 80, 400) + 120, rng.normal(200, 10, 400)
    level, sd = truth - rng.normal(250, 90, 400), rng.uniform(60, 120, 400)
    p = np.column_stack([np.cumsum(rng.normal(0, 0.01, (400, 2)), axis=0), np.zeros(400)])
    columns = {
        "t": np.arange(400) / 8,
        "p_world_base": p,
        "b_map_nt": level,
        "b_total_nt": total,
        "b_sd_nt": sd,
    }
    about = {"magnetometer": "neural", "plant": "hysteresis", "network_label_mean_nt": 240.0}
    run = Run({**columns, "b_truth_nt": truth, "b_unmodelled_nt": beside}, about)
    report = run.report()
    figures = {figure.name: figure for figure in report.figures}
    assert figures["duration"].value == 399 / 8
    assert figures["readings"].value == 400
    assert figures["distance driven"].value == pytest.approx(np.hypot(*np.diff(p[:, :2], axis=0).T).sum())
    for name in ("b_total_nt", "b_map_nt"):
        assert figures[name].value == pytest.approx(run[name].mean(), rel=1e-12)
        assert figures[name].spread == pytest.approx(run[name].std(), rel=1e-9)
        assert figures[name].note == f"{run[name].min():.0f} to {run[name].max():.0f}"
    error, naive = np.abs(total - beside - truth), np.abs(level + 240.0 - truth)
    assert figures["error"].value == pytest.approx(error.mean(), rel=1e-12)
    held = np.mean(error <= 1.6448536 * sd)
    assert f"mean error {error.mean():,.0f} nT against {naive.mean():,.0f} nT" in report.verdict
    assert f"a ratio of {error.mean() / naive.mean():.2f}" in report.verdict
    assert f"hold {held:.0%} of the readings" in report.verdict
    earlier = Run({name: run[name] for name in run if name != "b_unmodelled_nt"}, about)
    assert earlier.report().verdict == ""  # a run of an earlier version: the plant is in reading and truth
    assert "error" not in {figure.name for figure in earlier.report().figures}


def test_public_names_resolve_and_others_are_refused():
    for name in magtwin.__all__:
        assert getattr(magtwin, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'simulat'"):
        _ = magtwin.simulat


def test_to_pandas_has_a_column_a_part_with_units():
    pytest.importorskip("pandas")
    run = every_column()
    frame = run.to_pandas()
    assert len(frame) == run.rows
    assert np.array_equal(frame["imu_q_xyzw_w"], run["imu_q_xyzw"][:, 3])
    assert frame.attrs["units"]["b_total_nt"] == "nT"
    assert frame.attrs["metadata"] == dict(run.metadata)


def test_select_keeps_the_clock_and_takes_patterns_in_the_order_asked():
    run = every_column()
    assert list(run.select("yaw", "b_t*")) == ["t", "yaw", "b_total_nt", "b_truth_nt"]
    assert run.select("yaw").metadata["derived"] == "select(yaw)"
    with pytest.raises(UnknownNameError, match="no column 'b_totl_nt'; did you mean 'b_total_nt'"):
        run.select("b_totl_nt")
    with pytest.raises(UnknownNameError, match=r"no column 'est_\*'"):
        run.select("est_*")


@given(cuts=st.lists(st.floats(0, 0.3), max_size=4).map(sorted))
def test_slices_by_time_put_together_are_the_run(cuts):
    run = every_column()
    t = run["t"]
    edges = [None, *sorted({c for c in cuts if t[0] < c <= t[-1]}), None]
    parts = []
    for a, b in itertools.pairwise(edges):
        rows = (t >= (a or -1)) & (t < (b or 9))
        if rows.any():
            parts.append(run.between(a, b))
            assert np.array_equal(parts[-1]["t"], t[rows])
    assert_same(Run.concat(parts), run)


def test_a_run_read_at_its_own_instants_is_itself_to_the_bit():
    run = every_column()
    assert_same(run.resample(run["t"]), run)
    assert_same(run.resample(run["t"][5:9]), run.take(slice(5, 9)))


def test_flags_commands_and_slow_sensors_hold_what_was_known_by_then():
    run = every_column()
    at = (run["t"][:-1] + run["t"][1:]) / 2
    held = run.resample(at)
    for name in (
        "v_cmd",
        "flag_bump",
        "lidar_on",
        "imu_q_xyzw",
        "odom_p",
        "battery_v",
        "b_vector_measured_nt",
    ):
        assert np.array_equal(held[name], run[name][:-1]), name
        assert held[name].dtype == run[name].dtype


def test_fields_are_linear_and_nothing_is_read_across_nan():
    run = Run({"t": [0, 1, 2, 4], "b_total_nt": [10, 20, np.nan, 40]})
    read = run.resample([0.25, 1.0, 1.5, 2.0, 3.0, 4.0])["b_total_nt"]
    assert_allclose(read, [12.5, 20, np.nan, np.nan, np.nan, 40])


def test_yaw_goes_the_shorter_way_round():
    run = Run({"t": [0.0, 1.0], "yaw": [np.pi - 0.1, -np.pi + 0.3]})
    assert_allclose(run.resample([0.25, 0.75])["yaw"], [-np.pi, -np.pi + 0.2], atol=1e-12)


def test_orientations_turn_as_scipys_slerp_does_whatever_their_signs():
    run = every_column()
    q = run["q_world_base_xyzw"]
    at = np.linspace(run["t"][0], run["t"][-1], 200)
    peer = Slerp(run["t"], Rotation.from_quat(q))(at)
    read = Rotation.from_quat(run.resample(at)["q_world_base_xyzw"])
    assert (read.inv() * peer).magnitude().max() < 1e-7
    near = Run({"t": [0, 1], "q_world_base_xyzw": [[0, 0, 0, 1], [0, 0, 1e-9, 1]]})
    assert_allclose(near.resample([0.5])["q_world_base_xyzw"], [[0, 0, 5e-10, 1]], atol=1e-18)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "needs either t or rate_hz"),
        ({"t": [0.5], "rate_hz": 1.0}, "needs either t or rate_hz"),
        ({"t": [0.5, 3.0]}, "t = 3 s lies outside the run; the run goes from 0 to 2 s"),
        ({"t": [-0.1]}, "t = -0.1 s lies outside the run"),
        ({"t": [1.0, 0.5]}, "row 1 has 0.5 s after 1 s"),
        ({"t": [1.0, np.nan]}, "t must be finite, got nan in row 1"),
        ({"t": ["now"]}, r"t must be numbers of shape \(N,\)"),
        ({"rate_hz": 0.0}, "rate_hz must be above 0 Hz"),
        ({"rate_hz": 1e15}, "gives 2e\\+15 rows in 2 s"),
    ],
)
def test_instants_that_no_run_can_be_read_at_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        Run({"t": [0.0, 1.0, 2.0]}).resample(**options)


def test_runs_that_do_not_run_on_are_refused_or_shifted():
    a = Run({"t": [0.0, 0.5], "yaw": [1, 2]}, {"seed": 1, "scene": "lab"})
    b = Run({"t": [0.0, 0.5], "yaw": [3, 4]}, {"seed": 2, "scene": "lab"})
    with pytest.raises(InputError, match=r"run 1 begins at 0 s, and the one before it ends at 0.5 s"):
        Run.concat([a, b])
    both = Run.concat([a, b], offset=True)
    assert_allclose(both["t"], [0, 0.5, 1.0, 1.5])
    assert np.array_equal(both["yaw"], [1, 2, 3, 4])
    assert both.metadata == {"scene": "lab", "derived": "concat(2 runs)"}
    with pytest.raises(InputError, match="runs 0 and 1: column 'yaw' is in only one of them"):
        Run.concat([a, b.select()])
    with pytest.raises(InputError, match="at least one run"):
        Run.concat([])


def test_a_users_own_column_keeps_what_it_was_said_to_hold():
    spec = Column("K", "", "temperature of the head")
    run = Run({"t": [0.0, 1.0], "head_k": [290.0, 291.0]}).with_specs(head_k=spec)
    assert run.spec("head_k") == spec
    for other in (run.with_metadata(a=1), run.select("head_k"), run.resample([0.5]), Run.concat([run])):
        assert other.spec("head_k") == spec
    assert run.with_columns(est_q_xyzw=np.zeros((2, 4))).spec("est_q_xyzw").interpolation == "quaternion"
    assert run.with_columns(flag_x=np.zeros(2, bool)).spec("flag_x").interpolation == "hold"


def test_the_documented_columns_are_those_of_the_code():
    docs = DOCS
    page = runpy.run_path(str(docs / "columns.py"))["page"]()
    written = (docs / "columns.md").read_text(encoding="utf-8")
    assert written == page, "python docs/columns.py writes it anew"
    for name, column in COLUMNS.items():
        assert f"| `{name}` | {', '.join(column.parts)} | {column.unit} | {column.frame} |" in written


def test_a_run_is_the_same_in_another_process():
    run = Run(
        {"t": [0.0, 1.0], "own": [[1.0, 2.0], [3.0, 4.0]]},
        {"seed": 3},
        {"own": Column("nT", "body", "mine", 2, ("x", "y"))},
    )
    again = pickle.loads(pickle.dumps(run))
    assert_allclose(again["own"], run["own"], rtol=0)
    assert (dict(again.metadata), again.spec("own")) == ({"seed": 3}, run.spec("own"))


@pytest.mark.parametrize("value", ["a, b, c", "nan, 0, 0", "0, 0", "", -1, 10**300])
def test_metadata_that_must_be_numbers_are_refused_by_name(value):
    assert numbers_in({"sensor_m": "0.1, 0, 0.4"}, "sensor_m", 3) == (0.1, 0.0, 0.4)
    assert numbers_in({}, "sensor_m", 3) == ()
    with pytest.raises(InputError, match="metadata 'sensor_m' must be 3 finite numbers, got"):
        numbers_in({"sensor_m": value}, "sensor_m", 3)
