"""Localizers of others run in a jail: they gain nothing, and touch no row but their own."""

import time

import hostile_localizers
import numpy as np
import pytest
from hostile_localizers import FAIL, GAIN_NOTHING, OUT_OF_JAIL

from magtwin.bench import row, sealed
from magtwin.bench.runner import benchmark
from magtwin.bench.suite import Entry, load_suite
from magtwin.errors import InputError
from magtwin.localization.localizers import load_localizer
from magtwin.localization.problem import Estimate
from magtwin.localization.readings import packed, readings_of, unpacked
from magtwin.localization.track import track
from magtwin.parallel import jail

jailed = pytest.mark.skipif(not jail.version(), reason="this system has no Landlock")

SUITE = """
name = "sealed"
seed = 5
chunk = 1
time_limit_s = 15.0

[[scenario]]
name = "tracking"
runs = 1
duration_s = 4.0
map_error_nt = 150.0
sensor = { iron_nt = 400.0 }

[[localizer]]
method = "odometry"

[[localizer]]
method = "rbpf-iron"
"""
MORE = '\n[[localizer]]\nmethod = "{}"\n'


def suite_in(folder, *methods):
    file = folder / "sealed.toml"
    file.write_text(SUITE + "".join(MORE.format(method) for method in methods))
    return file


def rows_of(results):
    """Rows by localizer, as bytes but for texts and the name."""
    names = [name for name in results.rows if name not in ("localizer",)]
    return {
        str(name): {key: results.rows[key][k] for key in names}
        for k, name in enumerate(results.rows["localizer"])
    }


def same(a, b):
    return all(np.array_equal(a[key], b[key], equal_nan=not isinstance(a[key], str)) for key in a)


@pytest.fixture(scope="module", autouse=True)
def ended():
    yield
    sealed.close()


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    suite = load_suite(suite_in(tmp_path_factory.mktemp("case")))
    return row.make_case(suite, suite.scenarios["tracking"], 0)


@jailed
def test_each_attack_fails_or_gains_nothing_and_its_neighbours_keep_their_bytes(tmp_path, capfd):
    alone = rows_of(benchmark(suite_in(tmp_path), tmp_path / "alone", jobs=1))
    assert all(each["status"] == "ok" for each in alone.values())
    attacks = [f"hostile_localizers:{each.__name__}" for each in (*GAIN_NOTHING, *FAIL)]
    rows = rows_of(benchmark(suite_in(tmp_path, *attacks), tmp_path / "all", jobs=1))
    for name in alone:
        assert same(rows[name], alone[name]), name
    for each in GAIN_NOTHING:
        assert same(rows[f"hostile_localizers:{each.__name__}"], alone["odometry"]), each
    for each, reason in FAIL.items():
        row = rows[f"hostile_localizers:{each.__name__}"]
        assert row["status"] == "failed", each
        assert reason in row["reason"], (each, row["reason"])
        assert row["reason"].isprintable()
        assert len(row["reason"]) <= sealed.MOST_TEXT
    assert "hostile" not in "".join(capfd.readouterr())


@pytest.mark.parametrize("attack", OUT_OF_JAIL)
def test_the_attacks_work_without_a_jail(case, attack, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "earlier.parquet").write_bytes(b"truth")
    assert track(attack(), case.problem, case.readings).lost.all()


def test_frames_and_seeds_are_open_to_what_runs_beside_the_truth(case):
    made = row.run_localizer  # in whose frame the case is
    entry = Entry(method="odometry")
    scenario = load_suite("standard").scenarios["tracking"]
    for attack in (hostile_localizers.Frames, hostile_localizers.Inverts):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(row, "load_localizer", lambda *_, attack=attack: attack())
            assert made(entry, case, 60.0, None, scenario, case.problem.seed)[0].lost.all()


@jailed
@pytest.mark.parametrize("method", ["odometry", "ekf", "rbpf-iron", "smoother"])
def test_a_method_gives_the_same_row_in_its_own_process(case, method, monkeypatch):
    scenario = load_suite("standard").scenarios["tracking"]
    inside, outside = [], []
    for made, seals in ((inside, False), (outside, True)):
        monkeypatch.setattr(row, "seals", lambda _, seals=seals: seals)
        made += row.run_localizer(Entry(method=method), case, 60.0, None, scenario, case.problem.seed)
    for name in ("pose", "covariance", "bias_nt", "lost"):
        np.testing.assert_array_equal(getattr(inside[0], name), getattr(outside[0], name))
    one, other = (each[1].row() for each in (inside, outside))
    one.pop("step_us"), other.pop("step_us")
    assert same(one, other)
    assert inside[2] == outside[2] == (method == "smoother")


class Tells:
    """Tells what it has got so far, in its estimates: the number of readings, and the time of the last."""

    def reset(self, problem):
        import os

        self.count, self.line = 0, next(n for n in range(3, 30) if _is_line(os, n))

    def step(self, reading):
        import socket

        self.count += 1
        with socket.fromfd(self.line, socket.AF_UNIX, socket.SOCK_STREAM) as line:
            try:  # what was sent before it was asked for
                waiting = len(line.recv(1 << 16, socket.MSG_DONTWAIT))
            except BlockingIOError:
                waiting = 0
        return Estimate(reading.t, self.count, reading.t, waiting)


def _is_line(os, number):
    import stat

    try:
        return stat.S_ISSOCK(os.fstat(number).st_mode)
    except OSError:
        return False


@jailed
def test_an_estimate_cannot_use_a_reading_that_was_not_sent(case):
    contestant = sealed.Contestant(Entry(method="test_sealed:Tells"), case.problem, 1, case.readings, 20.0)
    try:
        made = contestant.load().run(case.problem, case.readings)
    finally:
        contestant.end()
    assert [each.x for each in made] == list(range(1, case.readings.rows + 1))
    assert [each.y for each in made] == case.readings["t"].tolist()
    assert not any(each.yaw for each in made)


@jailed
def test_a_localizer_that_is_missing_is_refused_before_anything_runs(tmp_path):
    with pytest.raises(InputError, match="cannot be imported: ModuleNotFoundError"):
        benchmark(suite_in(tmp_path, "no_such_module:Mine"), tmp_path / "out")
    with pytest.raises(InputError, match=r"localizer 'hostile_localizers:Frame': .*'Frames'"):
        benchmark(suite_in(tmp_path, "hostile_localizers:Frame"), tmp_path / "out")


def test_where_there_is_no_jail_the_rest_works(tmp_path, monkeypatch):
    monkeypatch.setattr(jail, "version", lambda: 0)
    assert not sealed.seals("hostile_localizers:Frames")
    made = benchmark(suite_in(tmp_path, "bad_localizers:Raises"), tmp_path / "out", jobs=1)
    assert made.rows["status"].tolist()[:2] == ["ok", "ok"]


def test_seeds_are_hashes_of_all_that_names_a_run():
    names = ("suite", "scenario", 3, "mine", b"salt")
    others = [("s", *names[1:]), ("suite", "x", 3, "mine", b"salt"), (*names[:2], 4, "mine", b"salt")]
    others += [(*names[:3], "other", b"salt"), (*names[:4], b"")]
    seeds = {sealed.seed_of(*each) for each in (names, *others)}
    assert len(seeds) == 6
    assert all(0 <= seed < 2**63 for seed in seeds)


def test_a_packed_row_is_its_reading(case):
    layout, rows = packed(case.readings)
    readings = list(readings_of(case.readings))
    assert rows.shape == (len(readings), 7 + sum(width or 1 for _, width, _ in layout))
    for reading, values in zip(readings, rows, strict=True):
        again = unpacked(layout, values.tolist())
        assert (reading.t, reading.b_nt, reading.odometry) == (again.t, again.b_nt, again.odometry)
        for name, value in reading.signals.items():
            assert type(value) is type(again.signals[name])
            np.testing.assert_array_equal(value, again.signals[name])
            assert np.all(value == case.readings[name][round(reading.t * 5)])


@jailed
def test_a_child_is_ready_soon_and_readings_cost_little(case):
    """A loose guard; benchmarks/sealed.py measures."""
    took = []
    for _ in range(5):
        begin = time.process_time()
        contestant = sealed.Contestant(Entry(method="odometry"), case.problem, 1, case.readings, 60.0)
        try:
            contestant.load().run(case.problem, case.readings)
        finally:
            contestant.end()
        took.append(time.process_time() - begin)
    assert min(took) < 0.05
    assert load_localizer("odometry") is not None
