"""Paths on floors of any size: they fit and pass what stands there; on the default floor nothing changes."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.path import CASES, PATHS, Path, check_clear, check_on_floor, path_named
from magtwin.path.room import FLOOR_M, RADIUS_M, Room, fit_path, path_in
from magtwin.spec.lab import LabSpec
from magtwin.spec.obstacles import Obstacles
from magtwin.spec.walls import Wall


def box(x: float, y: float, wide: float, deep: float) -> np.ndarray:
    return np.array([x, y]) + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array([wide, deep]) / 2


def room(x: float, y: float, *boxes: np.ndarray, radius: float = RADIUS_M) -> Room:
    return Room(
        LabSpec(floor_m=(x, y)), radius, Obstacles(tuple(f"box_{k}" for k in range(len(boxes))), boxes)
    )


@pytest.mark.parametrize("name", [*PATHS, *CASES])
def test_on_the_default_floor_named_paths_are_as_they_were_to_the_bit(name):
    path, made = path_in(room(*FLOOR_M), name), path_named(name)
    assert path.placing == ()
    assert path.p_xy.tobytes() == made.p_xy.tobytes()


@settings(max_examples=30, deadline=None)
@given(
    name=st.sampled_from(sorted(set(PATHS) - {"coverage"})),  # which is planned, not scaled
    x=st.floats(1.0, 30.0),
    y=st.floats(1.0, 30.0),
    radius=st.floats(0.05, 0.4),
)
def test_a_named_path_fills_any_empty_floor_in_the_same_proportion(name, x, y, radius):
    path, made = path_in(room(x, y, radius=radius), name), path_named(name)
    check_on_floor(path, LabSpec(floor_m=(x, y)), radius)
    reach, made_for = np.array([x, y]) / 2 - radius, np.array(FLOOR_M) / 2 - RADIUS_M
    np.testing.assert_allclose(
        np.abs(path.p_xy).max(axis=0) / reach, np.abs(made.p_xy).max(axis=0) / made_for, rtol=1e-9
    )


@pytest.mark.parametrize("name", PATHS)
@pytest.mark.parametrize(
    "where",
    [
        room(6.0, 3.5, box(1.0, 1.4, 1.5, 0.7)),
        room(3.0, 3.0, box(-1.3, 0.5, 0.4, 1.0), box(1.1, 1.1, 0.6, 0.6)),
        room(12.0, 8.0, *(box(x, 0.0, 0.4, 0.4) for x in (-3, 0, 3))),
        room(5.0, 4.0, box(-1.0, 1.7, 3.0, 0.5), box(2.1, 0.1, 0.7, 3.0)),
    ],
)
def test_a_named_path_passes_what_stands_in_its_way(name, where):
    path = path_in(where, name)
    check_on_floor(path, where.lab, where.footprint_radius_m)
    check_clear(path, where.obstacles, where.footprint_radius_m)
    assert np.ptp(path.p_xy, axis=0).min() > 0.15 * min(where.lab.floor_m)
    assert name != "coverage" or path.swept >= 0.9
    assert name == "coverage" or len(path.p_xy) == len(path_named(name).p_xy)


def test_a_fit_keeps_the_shape_and_only_moves_what_is_small_enough():
    square = Path("own", np.array([[1.0, 1.0], [3.0, 1.0], [3.0, 2.0], [1.0, 2.0]]), closed=True)
    moved = fit_path(square, room(4.0, 3.0))
    assert moved.placing[:2] == (1.0, 1.0)
    np.testing.assert_allclose(np.diff(moved.p_xy, axis=0), np.diff(square.p_xy, axis=0), atol=1e-12)
    shrunk = fit_path(square, room(2.0, 2.0))
    assert shrunk.placing[0] == shrunk.placing[1] < 1
    check_on_floor(shrunk, LabSpec(floor_m=(2.0, 2.0)), RADIUS_M)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        ([[-3, 0], [3, 0]], r"needs 6\.34 x 0\.34 m.* scaled by 0\.6 .*`fit=True`"),
        ([[-3000, 0], [3000, 0]], "in mm or another unit"),
        ([[0, 0], [3, 0]], r"needs 3\.34 x 0\.34 m.* moved by \(-1\.17, 0\.00\) m .*`fit=True`"),
    ],
)
def test_a_path_that_does_not_fit_is_told_what_would(points, said):
    path = Path("own", np.array(points, float))
    with pytest.raises(InputError, match=said):
        check_on_floor(path, LabSpec(floor_m=(4.0, 3.0)), RADIUS_M)
    check_on_floor(fit_path(path, room(4.0, 3.0)), LabSpec(floor_m=(4.0, 3.0)), RADIUS_M)


def test_no_room_is_refused():
    with pytest.raises(InputError, match=r"the floor of 0\.3 x 3 m is no wider than a robot"):
        path_in(room(0.3, 3.0), "sine")
    with pytest.raises(InputError, match="does not fit between the obstacles on the floor of 2 x 2 m"):
        path_in(room(2.0, 2.0, box(0, 0, 1.6, 1.6)), "sine")


def test_a_fit_does_not_change_the_side_of_a_wall():
    lab = LabSpec(floor_m=(6.0, 4.0), walls=(Wall((1.0, -2.0), (1.0, 2.0), name="brick"),))
    shut = Room(lab, RADIUS_M, Obstacles(("brick",), (box(1.0, 0.0, 0.1, 4.0),)))
    with pytest.raises(InputError, match=r"by 1\.\d+ m, to the other side of brick; open the door"):
        fit_path(Path("line", np.array([[-2.0, 0.0], [2.0, 0.0]])), shut)
    beside = fit_path(Path("line", np.array([[-2.0, 0.0], [0.85, 0.0]])), shut)
    assert shut.refusal(beside) is None
    assert path_in(shut, "figure8").swept == pytest.approx(0.66, abs=0.08)  # a third is behind the wall


@pytest.mark.parametrize("placing", [(0.0, 1.0, 0.0, 0.0), (1.0, 1.0), (1.0, 1.0, np.inf, 0.0)])
def test_a_placing_that_is_none_is_refused(placing):
    with pytest.raises(InputError, match="two scales above 0 and two shifts"):
        path_named("sine").placed(placing)


def test_a_fitted_run_is_repeated_to_the_bit(lab_scene, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MAGTWIN_RUN_RATE_HZ", "5")
    (tmp_path / "far.csv").write_text("0,0\n8,0\n8,1\n")
    run = ["run", str(lab_scene), "--path", str(tmp_path / "far.csv"), "--network", "none"]
    with pytest.raises(InputError, match=r"far\.csv leaves the floor .*give `fit=True`"):
        main([*run, "--out", str(tmp_path / "run.parquet"), "--debug"])
    main([*run, "--out", str(tmp_path / "run.parquet"), "--fit"])
    assert re.search(r"Path far\.csv is scaled by 0\.\d+ and moved by \(", capsys.readouterr().err)
    main(["reproduce", str(tmp_path / "run.parquet")])
    assert "yes, to the bit" in capsys.readouterr().out
    with pytest.raises(InputError, match="--fit is for a path"):
        main([*run[:2], "--path", "random", "--fit", "--debug"])
