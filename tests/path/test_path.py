"""Paths: arc length, nearest point, names, files, the floor."""

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from magtwin.errors import InputError, UnknownNameError
from magtwin.path import (
    PATHS,
    Path,
    check_clear,
    check_on_floor,
    curvilinear,
    lawnmower,
    path,
    path_named,
    read_path_csv,
    resolve_path,
    sine,
    split_lawnmower,
)
from magtwin.spec.lab import LabSpec
from magtwin.spec.obstacles import Obstacles

FLOOR, FOOTPRINT = (6.0, 3.5), 0.171


def circle(radius: float, points: int = 4001) -> Path:
    u = np.linspace(0, 2 * np.pi, points)
    return Path("circle", radius * np.column_stack([np.cos(u), np.sin(u)]), closed=True)


def test_arc_length_of_a_circle_is_two_pi_r():
    assert circle(0.7).length == pytest.approx(2 * np.pi * 0.7, rel=1e-6)  # chords: u^2 / 24 short


def test_curvature_of_a_circle_is_one_over_r_and_left_is_positive():
    s = np.linspace(0, 4, 50)
    assert_allclose(circle(0.7).curvature(s), 1 / 0.7, rtol=1e-3)
    assert_allclose(Path("back", circle(0.7).p_xy[::-1]).curvature(s[5:-5]), -1 / 0.7, rtol=1e-3)


def test_heading_of_a_circle_is_the_tangent_and_a_closed_path_repeats():
    path = circle(1.0)
    s = np.linspace(-10, 10, 101)
    wanted = np.column_stack([-np.sin(s), np.cos(s)])
    seen = np.column_stack([np.cos(path.heading(s)), np.sin(path.heading(s))])
    assert_allclose(seen, wanted, atol=2e-3)  # half a segment's turn
    assert_allclose(path.at(s), path.at(s + path.length), atol=1e-12)


def test_an_open_path_goes_on_straight_beyond_its_ends():
    path = Path("line", np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]]))
    assert_allclose(path.at([-1.0, 0.5, 1.0, 2.0, 4.0]), [[-1, 0], [0.5, 0], [1, 0], [1, 1], [1, 3]])


def test_a_corner_turns_by_its_angle_and_a_fold_by_half_a_turn():
    corner = Path("corner", np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0]]))
    fold = Path("fold", np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]]))
    assert corner.turn(1.0, 0.03) == pytest.approx(np.pi / 2)
    assert abs(fold.turn(1.0, 0.03)) == pytest.approx(np.pi)


def test_neighbours_that_coincide_are_merged_and_a_closed_path_ends_where_it_began():
    path = Path("square", np.array([[0.0, 0], [0, 0], [1, 0], [1, 1], [1, 1], [0, 1]]), closed=True)
    assert_allclose(path.p_xy, [[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    assert path.length == 4.0


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(-3, 3), st.floats(-2, 2)), min_size=1, max_size=20))
def test_nearest_agrees_with_a_dense_search(points):
    path = path_named("figure8")
    s, d = path.nearest(points)
    assert_allclose(np.hypot(*(path.at(s) - points).T), np.abs(d), atol=1e-12)
    dense = path.at(np.linspace(0, path.length, 20_001))
    least = np.min(np.hypot(*(np.asarray(points)[:, None] - dense).transpose(2, 0, 1)), axis=1)
    assert np.all(np.abs(d) <= least + 1e-12)
    assert_allclose(np.abs(d), least, atol=4e-4)  # half the dense spacing


def test_distance_is_positive_to_the_left_of_the_path_and_keeps_the_shape_of_the_points():
    path = Path("line", np.array([[0.0, 0.0], [4.0, 0.0]]))
    s, d = path.nearest([[[1.0, 0.2], [3.0, -0.1]]])
    assert_allclose(s, [[1, 3]])
    assert_allclose(d, [[0.2, -0.1]])


def test_a_closed_path_is_prolonged_by_laps_and_an_open_one_back_and_forth():
    loop, line = circle(1.0), Path("line", np.array([[0.0, 0.0], [1.0, 0.0]]))
    laps = loop.prolonged(20.0)
    assert laps.length >= 20.0
    assert_allclose(laps.at(np.arange(18.0)), loop.at(np.arange(18.0)), atol=1e-9)
    assert_allclose(line.prolonged(2.5).p_xy[:, 0], [0, 1, 0, 1])
    assert_allclose(line.prolonged(0.1).p_xy, line.p_xy)


def test_the_sine_is_equation_7():
    path = sine(amplitude_m=0.5, wavenumber_rad_m=3.0, phase_rad=0.4, y_mid_m=0.1)
    assert_allclose(path.p_xy[:, 1], 0.5 * np.sin(3.0 * path.p_xy[:, 0] - 0.4) + 0.1, atol=1e-12)


def test_a_lawnmower_sweeps_step_by_step_up_to_its_end():
    path = lawnmower(x_first_m=0.0, x_last_m=1.1, height_m=2.0, step_m=0.5, y_first_m=-1.0)
    assert_allclose(path.p_xy, [[0, -1], [0, 1], [0.5, 1], [0.5, -1], [1, -1], [1, 1]])
    back = lawnmower(x_first_m=1.0, x_last_m=0.0, step_m=0.5)
    assert_allclose(np.unique(back.p_xy[:, 0]), [0, 0.5, 1])
    assert back.p_xy[0, 0] == 1.0


def test_the_lawnmower_is_the_released_one(real_data):
    released = read_path_csv(real_data / "aprilab/paths/lawnmower_path5.csv")
    assert released.length == pytest.approx(path_named("lawnmower").length)
    assert_allclose(path_named("lawnmower").nearest(released.p_xy)[1], 0, atol=1e-9)


@pytest.mark.parametrize("name", ["figure8", "narrow_figure8"])
def test_a_figure_of_eight_is_symmetric_about_both_axes(name):
    path = path_named(name)
    for mirror in ([-1, 1], [1, -1]):
        assert_allclose(path.nearest(path.p_xy * mirror)[1], 0, atol=1e-9)


RELEASED = {"figure8_path": True, "continous_cycle": True, "sinwave_data": False, "path": False}


@pytest.mark.parametrize(("file", "closed"), RELEASED.items())
def test_released_paths_are_read_and_lie_on_the_floor(real_data, file, closed):
    path = read_path_csv(real_data / f"aprilab/paths/{file}.csv")
    check_on_floor(path, LabSpec(floor_m=FLOOR), FOOTPRINT)
    assert path.closed == closed


def test_a_path_that_leaves_the_floor_says_by_how_much():
    path = Path("far", np.array([[0.0, 0.0], [2.0, 0.0], [3.0, 0.0]]))
    with pytest.raises(InputError, match=r"at point 3 of 3, \(3\.000, 0\.000\) m, by 0\.171 m"):
        check_on_floor(path, LabSpec(floor_m=FLOOR), FOOTPRINT)


@pytest.mark.parametrize(
    "text", ["0,0\n1,2\n", "x,y\n0,0\n1,2\n", "# x,y\n\n0 , 0\n1e0,2\n\n", "\ufeff0,0\r\n1,2"]
)
def test_a_csv_is_read_with_or_without_a_header(tmp_path, text):
    file = tmp_path / "p.csv"
    file.write_text(text, encoding="utf-8")
    assert_allclose(read_path_csv(file).p_xy, [[0, 0], [1, 2]])


REFUSED = [
    ("", "is empty"),
    ("x,y\n", "no rows below the header"),
    ("1,2\n", "only 1 point"),
    ("1,2\n1,2\n", "only 1 point"),
    ("0,0\n1,nan\n", "only 1 point"),
    ("0,0\n1,2,3\n", "csv:2: 2 values expected, got 3"),
    ("0,0,0\n1,2,3\n", "csv:1: a point is two numbers, .*; add a header line"),
    ("0,0\n\n1\n", "csv:3: 2 values expected, got 1"),
    ("0,0\n1,two\n", "csv:2: 2 must be a finite number, got 'two'"),
    ("0,0\n1,inf\n", "csv:2: 2 must be a finite number, got 'inf'"),
    ("lat,lon\n48,11\n49,12\n", "latitude and longitude"),
    ("x [deg],y [deg]\n48,11\n49,12\n", "latitude and longitude"),
    ("x [px],y [px]\n48,11\n49,12\n", "in no unit of x"),
    ("time,speed\n1,2\n4,5\n", "no columns x and y in 'time,speed'"),
    ("pos_x,map_x,y\n1,2,3\n4,5,6\n", "pos_x, map_x could each be x"),
    ("0 1 2 0 0 0 0 1\n1 1 2 0 0 0 0 2\n", "csv:2: .* quaternion is 2"),
    ("0.5;1,234\n1;2\n", "must be a finite number"),
    ("\0\x80", "not a text file"),
]


@pytest.mark.parametrize(("text", "words"), REFUSED, ids=range(len(REFUSED)))
def test_a_csv_that_is_no_path_is_refused_with_file_and_line(tmp_path, text, words):
    file = tmp_path / "p.csv"
    file.write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=words) as refused:
        read_path_csv(file)
    assert "p.csv" in str(refused.value)


Y_FIRST = ("northing,easting", "N,E", "pos_y,posX", "py,px", "Position Y (m),position_x")


TUM = "5.0 0 0 3 0 0 0 1\n5.1 1 2 3 0 0 .6 .8\n"
NOTED = [
    ("y,x\n0,0\n2,1\n", "x and y by their names"),
    ("x [cm],y [cm]\n0,0\n100,200\n", "by the units in their names"),
    ("X (mm),y_m\n0,0\n1000,2\n", "by the units in their names"),
    ("\ufeffx;y\n0,0;0,0\n1,0;2,0\n", "decimal commas"),
    ("0,0 0,0\n1,0 2,0\n", "decimal commas"),
    ("sep=;\nx;y\n0;0\n1;2\n", ""),
    ("x\ty\n0\t0\n1\t2\n", ""),
    (",x,y\n0,0,0\n1,1,2\n", ""),
    ("t,x,y\n0,0,0\n1,1,2\n", "left out t"),
    ("x,y\n0,0\n#N/A,1\n-,NULL\n1,2\n", "2 of 4 points"),
    ("a,b\n0,0\n1,2\n", "'a,b' as x,y in metres"),
    *((f"{header}\n0,0\n2,1\n", "as x and y") for header in Y_FIRST),
    ("x,y,yaw [deg]\n0,0,0\n1,2,90\n", "left out yaw"),
    ("pos_x_cm,y [mm]\n0,0\n100,2000\n", "as x and y; .* by the units"),
    ("%time,field.position.x,field.position.y,v.x\n0,0,0,7\n1,1,2,7\n", "field.position.x .* as x"),
    (TUM, "x and y of 't x y z qx qy qz qw'"),
    ("# timestamp tx ty tz qx qy qz qw\n" + TUM, "tx and ty as x and y"),
]


@pytest.mark.parametrize(("text", "note"), NOTED, ids=range(len(NOTED)))
def test_a_csv_of_a_spreadsheet_is_read_with_a_note(tmp_path, text, note, recwarn):
    file = tmp_path / "p.csv"
    file.write_text(text, encoding="utf-8")
    assert_allclose(read_path_csv(file).p_xy, [[0, 0], [1, 2]])
    assert bool(recwarn) == bool(note)
    if note:
        assert re.search(rf"p\.csv: read .*{note}", str(recwarn.pop().message))


def test_resolve_takes_a_name_or_a_file_and_names_the_near_one(tmp_path):
    file = tmp_path / "p.csv"
    file.write_text("0,0\n1,2\n")
    assert resolve_path("figure8").name == "figure8"
    assert resolve_path(file).name == "p.csv"
    with pytest.raises(InputError, match="did you mean 'figure8'"):
        resolve_path("figure9")
    with pytest.raises(InputError, match="no such path file"):
        resolve_path(str(tmp_path / "absent.csv"))
    with pytest.raises(UnknownNameError, match="no path 'figure9'"):
        path_named("figure9")


NO_PATHS = [
    (lambda: Path("bad", np.zeros((3, 3))), r"shape \(N, 2\)"),
    (lambda: Path("bad", np.zeros((0, 2))), "two different points .* got 0"),
    (lambda: Path("bad", np.zeros((3, 2))), "two different points .* got 1"),
    (lambda: Path("bad", np.array([[0.0, 0.0], [np.nan, 1.0]])), "point 1 is not finite"),
    (lambda: lawnmower(step_m=1e-12), "step_m 1e-12 .* points"),
    (lambda: lawnmower(x_last_m=math.inf), "would make inf points"),
    (lambda: lawnmower(step_m=0.0), "step_m .* above 0"),
    (lambda: split_lawnmower(y_split_m=1.4), "y_split_m .* between"),
    (lambda: curvilinear(depth=-1.0), "depth .* got -1"),
    (lambda: curvilinear(depth=math.nan), "depth .* got nan"),
    (lambda: curvilinear(lobes=2.5), "lobes .* whole number, got 2.5"),
]


@pytest.mark.parametrize(("make", "words"), NO_PATHS, ids=range(len(NO_PATHS)))
def test_what_is_no_path_is_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


def test_the_fast_sine_is_the_released_one(real_data):
    released = read_path_csv(real_data / "aprilab" / "paths" / "sinwave_data.csv")
    _, distance = released.nearest(path_named("fast_sine").p_xy)
    assert np.abs(distance).max() < 0.03  # the released one has 50 points a wave, whose chords cut its crests
    assert path_named("fast_sine").length == pytest.approx(released.length, rel=0.01)


def test_a_split_lawnmower_mows_one_half_and_then_the_other_back():
    path = split_lawnmower(y_split_m=0.3, step_m=0.5)
    low = path.p_xy[:, 1] < 0.3
    assert np.count_nonzero(np.diff(low)) == 1  # it crosses the split line once
    assert low[0]
    assert_allclose([path.p_xy[:, 1].min(), path.p_xy[:, 1].max()], [-1.5, 1.5])
    gap = path.p_xy[~low, 1].min() - path.p_xy[low, 1].max()
    assert gap == pytest.approx(0.5)
    assert_allclose(path.p_xy[0, 0], path.p_xy[-1, 0])


DESK = Obstacles(("/World/Desk",), (np.array([[0.5, -0.2], [1.0, -0.2], [1.0, 0.2], [0.5, 0.2]]),))


def test_a_path_through_a_desk_is_refused_with_the_place_and_the_prim():
    line = Path("line", np.array([[-2.0, 0.0], [2.0, 0.0]]))
    with pytest.raises(InputError, match=r"path line runs into /World/Desk: 2\.3\d\d m along it"):
        check_clear(line, DESK, 0.171)


def test_a_path_that_passes_at_just_the_robot_s_radius_is_clear():
    check_clear(Path("line", np.array([[-2.0, 0.371], [2.0, 0.371]])), DESK, 0.171)
    with pytest.raises(InputError, match=r"0\.001 m too near"):
        check_clear(Path("line", np.array([[-2.0, 0.37], [2.0, 0.37]])), DESK, 0.171)


def test_a_registered_path_has_a_name_like_any_other(monkeypatch):
    monkeypatch.setattr(PATHS, "_loaded", dict(PATHS._loaded))

    @path("triangle")
    def triangle() -> Path:
        return Path("triangle", np.array([[0, 0], [2, 0], [1, 1]], float), closed=True)

    assert path_named("triangle").length == pytest.approx(2 + 2 * math.sqrt(2))
    assert resolve_path("triangle").name == "triangle"
    with pytest.raises(UnknownNameError, match="no path 'triangl'; did you mean 'triangle'"):
        path_named("triangl")


def test_loops_have_every_heading_in_each_third_of_the_floor():
    path = path_named("loops")
    s = np.linspace(0, min(path.length, 16.0), 2000)
    x, sector = path.at(s)[:, 0], np.floor(path.heading(s) / (np.pi / 4)) % 8
    for low in np.linspace(-2.3, 2.3, 4)[:-1]:
        assert len(np.unique(sector[(x >= low) & (x < low + 4.6 / 3)])) == 8
