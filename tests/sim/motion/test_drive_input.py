"""What simulate takes: a Twin, a stage file or a Scene; a path by name, as CSV or as points."""

import gc
import pickle
from dataclasses import replace

import numpy as np
import pytest

from magtwin.errors import InputError
from magtwin.run.run import Run
from magtwin.twin import open_twin, simulate, simulate_robots, sweep
from magtwin.usd.scene import read_scene

POINTS = [[-1.0, -0.5], [0.25, 0.5], [1.0, 0.125], [0.5, -0.75]]
SHORT = {"duration_s": 3.0, "rate_hz": 20.0}


@pytest.fixture(scope="module")
def twin(lab_scene):
    return open_twin(lab_scene)


def same(a: Run, b: Run) -> bool:
    return list(a) == list(b) and all(a[name].tobytes() == b[name].tobytes() for name in a)


def csv_of(points, file):
    file.write_text("x,y\n" + "".join(f"{x!r},{y!r}\n" for x, y in points))
    return file


def test_scene_twin_and_file_give_equal_bytes(lab_scene, twin):
    runs = [simulate(what, "sine", seed=4, **SHORT) for what in (lab_scene, twin, read_scene(lab_scene))]
    assert same(runs[0], runs[1])
    assert same(runs[0], runs[2])
    metadata = [dict(run.metadata) for run in runs]
    assert metadata[0] == metadata[1]
    assert metadata[0].keys() - metadata[2].keys() <= {"scene_file", "git_revision"}
    assert all(metadata[0][name] == value for name, value in metadata[2].items())


def test_the_stage_of_a_scene_lasts_as_long_as_its_twins(lab_scene):
    twin = open_twin(read_scene(lab_scene))
    file, other = twin.scene_file, replace(twin, metadata={})
    del twin
    gc.collect()
    assert file.is_file()
    away = pickle.loads(pickle.dumps(other.stage))
    del away
    assert file.is_file()
    del other
    gc.collect()
    assert not file.parent.parent.exists()


def test_points_give_the_run_of_their_csv(twin, tmp_path):
    file = csv_of(POINTS, tmp_path / "mine.csv")
    read = simulate(twin, file, **SHORT)
    for points in (POINTS, np.array(POINTS), tuple(map(tuple, POINTS)), np.array(POINTS, np.float32)):
        run = simulate(twin, points, **SHORT)
        assert same(run, read)
        assert run.metadata["path"] == "points"
        assert run.metadata["path_sha256"] == read.metadata["path_sha256"]
        assert "path_file" not in run.metadata
    many = sweep(twin, POINTS, [0, 1], **SHORT)
    assert same(many[0], read)
    mixed = sweep(twin, ["sine", np.array(POINTS)], [0, 0], **SHORT)
    assert same(mixed[1], read)
    name = twin.scene.robot.name
    assert same(simulate_robots(twin, {name: POINTS}, **SHORT)[name], read)


@pytest.mark.parametrize(
    ("way", "said"),
    [
        (np.zeros((5, 3)), r"points must have shape \(N, 2\) \[m\], got \(5, 3\)"),
        ([], r"points must have shape \(N, 2\) \[m\], got \(0,\)"),
        ([[0, 0], [np.nan, 1]], r"point 1 is not finite: \(nan, 1.0\)"),
        ([[1, 2]], "two different points are needed, got 1"),
        (["a", "b"], r"points must be numbers of shape \(N, 2\)"),
        ([[0, 0], [9, 9]], "leaves the floor at point 2 of 2"),
        (3, r"path must be a name, a CSV file, points \(N, 2\) \[m\], a Path, Commands or a Run, got int"),
        (None, "got NoneType"),
        ("figure9", "did you mean 'figure8'"),
    ],
)
def test_what_is_no_path_is_refused(twin, way, said):
    with pytest.raises(InputError, match=said):
        simulate(twin, way, **SHORT)
