"""Places where two runs contradict each other."""

import numpy as np

from magtwin.field.survey.changes import changes_line, scene_changes
from magtwin.field.survey.readings import Readings


def runs(moved=(), vectors=False, seed=0):
    """Three runs over one floor; in those of `moved`, a source near (1, 0.5) reads 3 uT more."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(3):
        p = rng.uniform((-2, -1.5), (2, 1.5), (3000, 2))
        far = np.linalg.norm(p - (1.0, 0.5), axis=1)
        up = 2_000 * np.sin(p[:, 0]) + 3_000 * np.exp(-((far / 0.4) ** 2)) * (k in moved)
        b = np.column_stack([np.zeros(3000), np.full(3000, 20_000.0), up - 40_000])
        parts.append((p, b + rng.normal(0, 100, b.shape)))
    body = np.concatenate([b for _, b in parts])
    return Readings(
        p_xy=np.concatenate([p for p, _ in parts]),
        yaw=np.zeros(9000),
        b_body_nt=body if vectors else None,
        b_nt=np.linalg.norm(body, axis=1),
        run=np.repeat(np.arange(3), 3000),
        runs=("mon", "tue", "wed"),
    )


def test_runs_over_an_unchanged_scene_do_not_contradict_each_other():
    for vectors in (False, True):
        assert scene_changes(runs(vectors=vectors)) == []
        assert changes_line(runs(vectors=vectors)) == ""


def test_a_change_names_the_runs_the_place_and_the_size():
    for vectors in (False, True):
        found = scene_changes(runs(moved=[1], vectors=vectors))
        assert {change.runs for change in found} == {("mon", "tue"), ("tue", "wed")}
        assert np.linalg.norm(np.subtract(found[0].p_xy, (1.0, 0.5))) < 0.3
        assert 2_000 < found[0].nt < 3_200
        assert found[0].cells < 20
        assert found[0].shared > 150
    line = changes_line(runs(moved=[1]))
    assert line.startswith("the scene changed between runs ")
    assert "pairs of runs that differ: 2" in line
    assert "\n" not in line


def test_readings_at_other_headings_and_bad_ones_are_not_compared():
    readings = runs(moved=[1])
    turned = np.where(readings.run == 1, np.pi, 0.0)
    assert scene_changes(readings.with_(yaw=turned)) == []
    assert scene_changes(readings.with_(good=readings.run != 1)) == []


def test_the_real_runs_agree_with_each_other(real_data):
    folder, parts = real_data / "magnetic-data", []
    for k in range(1, 6):
        p, b = (np.loadtxt(folder / f"{k}-{what}.csv", delimiter=",") for what in ("loc", "mag"))
        parts.append((p, 1e3 * b, np.full(len(p), k - 1)))
    p, b, run = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    readings = Readings(p_xy=p, yaw=np.zeros(len(p)), b_body_nt=b, run=run, runs=tuple("12345"))
    assert scene_changes(readings) == []
