"""Pictures and films of runs in their lab."""

import itertools
import stat
from dataclasses import replace

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from magtwin.author.scene import author_scene
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.figures.films import film_of_run
from magtwin.figures.pictures import VEIL
from magtwin.figures.scenery import Scenery, View, picture_of_run
from magtwin.files.file import shipped
from magtwin.io.tables import write_parquet
from magtwin.spec.robot import PlacedRobot
from magtwin.twin import open_twin, scene_from_toml, simulate

SIZE = (160, 90)


@pytest.fixture(scope="module")
def run(lab_scene):
    twin = open_twin(lab_scene, magnetometer="map-only")
    return simulate(twin, "figure8", seed=1, speed=0.3, duration_s=6.0, rate_hz=20.0)


@pytest.fixture(scope="module")
def scenery(run, lab_scene):
    with Scenery(run, lab_scene, np.arange(6.0), view=View.of("top"), size=(640, 360)) as scenery:
        yield scenery


def pixel(scenery, place):
    """Column and row of a place in world."""
    renderer = scenery.plotter.renderer
    renderer.SetWorldPoint(*place, 1.0)
    renderer.WorldToDisplay()
    x, y, _ = renderer.GetDisplayPoint()
    return round(x), round(360 - y)


def test_the_robot_is_seen_where_the_run_has_it(scenery, run):
    first, last = scenery.frame(0).astype(int), scenery.frame(5).astype(int)
    seen = run.resample(np.arange(6.0))["p_world_base"]
    changed = (np.abs(first - last) > 40).any(axis=-1)
    for k in (0, 5):
        x, y = pixel(scenery, (*seen[k, :2], 0.2))
        assert changed[y - 4 : y + 5, x - 4 : x + 5].mean() > 0.5
    x, y = pixel(scenery, (-1.5, 0.8, 0.0))  # where it never was
    assert not changed[y - 4 : y + 5, x - 4 : x + 5].any()


def test_bodies_are_where_pose_and_wheels_say(scenery, run):
    seen = run.resample(np.arange(6.0))
    rest, then = scenery.poses(0), scenery.poses(4)
    np.testing.assert_allclose(then["base_link"][:3, 3], seen["p_world_base"][4])
    for k, side in enumerate(("left_wheel", "right_wheel")):
        local = [np.linalg.inv(poses["base_link"]) @ poses[side] for poses in (rest, then)]
        np.testing.assert_allclose(local[0][:3, 3], local[1][:3, 3], atol=1e-12)
        turned = (local[0].T @ local[1])[:3, :3]
        angle = seen["wheel_angle"][4, k] - seen["wheel_angle"][0, k]
        assert abs(angle) > 5
        assert (np.trace(turned) - 1) / 2 == pytest.approx(np.cos(angle), abs=1e-9)


def test_the_trail_stands_out_from_the_map_by_a_light_and_a_dark_edge(scenery, run):
    frame = scenery.frame(5)
    p = run["p_world_base"][run["t"] < 5][::3, :2]
    ahead = np.gradient(p, axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1, keepdims=True)
    far = np.linalg.norm(p - p[-1], axis=1) > 0.3  # not below the robot
    for place, side in zip(p[far], left[far], strict=True):
        spots = [pixel(scenery, (*(place + at * side), 0.01)) for at in np.linspace(-0.07, 0.07, 29)]
        seen = np.array([frame[y, x] for x, y in spots]).astype(int)
        assert np.ptp(seen @ (0.2126, 0.7152, 0.0722)) > 110, place  # of 255, in luminance


def test_the_robot_is_seen_behind_a_column_in_every_frame(run, lab_scene):
    column, robot = np.array([-4.6, -3.2]), run.resample(np.arange(6.0))["p_world_base"][:, :2]
    with Scenery(run, lab_scene, np.arange(6.0), view=View.of("top"), size=(480, 270)) as scenery:

        def drawn_without(actors, k):
            shown = [actor.visibility for actor in actors]
            for actor in actors:
                actor.visibility = False
            image = scenery.frame(k, whole=True).astype(int)
            for actor, visible in zip(actors, shown, strict=True):
                actor.visibility = visible
            return image

        for k, (x, y) in enumerate(robot):
            place = column + 1.2 * (column - (x, y)) / np.linalg.norm(column - (x, y))
            scenery._view = View.of(f"{place[0]},{place[1]},1.2:{x},{y},0.2")
            seen, solid = (scenery.frame(k, whole=whole).astype(int) for whole in (False, True))
            bare = drawn_without(scenery._screens, k)
            empty = drawn_without([*scenery._screens, *scenery._actors.values()], k)
            on_robot = (np.abs(bare - empty) > 30).any(axis=-1)
            for axis, step in itertools.product((0, 1), (-1, 1)):  # edges are smoothed in both pictures
                on_robot = on_robot & np.roll(on_robot, step, axis)
            assert on_robot.sum() > 50
            assert np.mean(np.ptp(solid[on_robot], axis=0)) < 30  # one plain face of the column
            veiled = np.abs(seen - bare)[on_robot].max(axis=-1)
            assert np.mean(veiled <= VEIL * 255 + 3) > 0.9  # but for thin posts, all edge
            far, near = (np.abs(image - bare)[on_robot].mean() for image in (solid, seen))
            assert near < 0.6 * far  # 0.30 to 0.48 seen: 0.3 but for the posts


def test_a_film_has_a_frame_for_every_moment_and_the_same_bytes_each_time(run, lab_scene, tmp_path):
    told = []
    for name in ("a.mp4", "b.mp4"):
        film_of_run(
            run,
            lab_scene,
            tmp_path / name,
            fps=10,
            speed=4,
            size=SIZE,
            advance=lambda *done: told.append(done),
        )
    frames = int(run.duration_s * 10 / 4) + 1
    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert count == frames
    assert seconds == pytest.approx(frames / 10, abs=0.02)
    assert told[frames - 1] == (frames, frames)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


def test_a_gif_lasts_as_long_as_it_should(run, lab_scene, tmp_path):
    film_of_run(run, lab_scene, tmp_path / "a.gif", fps=15, speed=6, size=SIZE, camera="top")
    with Image.open(tmp_path / "a.gif") as film:
        assert film.size == SIZE
        shown = []
        for k in range(film.n_frames):
            film.seek(k)
            shown.append(film.info["duration"])
    assert sum(shown) == pytest.approx(1000 * (int(run.duration_s * 15 / 6) + 1) / 15, abs=5)


def test_the_commands_draw_a_moment_a_film_and_a_stage(run, lab_scene, tmp_path, capsys):
    file = tmp_path / "run.parquet"
    write_parquet(run, file)
    main(["plot", str(file), "--out", str(tmp_path / "run.png"), "--size", "160x90", "--at", "2"])
    view = ["--size", "160x90", "--camera", "top"]
    main(["plot", str(lab_scene), "--out", str(tmp_path / "stage.png"), *view])
    for name in ("run", "stage"):
        with Image.open(tmp_path / f"{name}.png") as image:
            assert image.size == SIZE
            assert np.ptp(np.asarray(image)) > 150
    pace = ["--size", "160x90", "--pace", "10", "--fps", "5"]
    main(["plot", str(file), "--out", str(tmp_path / "a.mp4"), *pace])
    assert (tmp_path / "a.mp4").stat().st_size > 1000
    assert "changed since" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"camera": "sideways"}, "no camera 'sideways'; known: orbit, top; or x,y,z:x,y,z"),
        ({"camera": "1,2,3:4,5"}, "no camera '1,2,3:4,5'"),
        ({"camera": "1,2,3,4,5,6"}, "no camera '1,2,3,4,5,6'"),
        ({"camera": "nan,2,3:4,5,6"}, "no camera 'nan,2,3:4,5,6'"),
        ({"camera": "0,0,1:0,0,1"}, "looks at its own place"),
        ({"size": (161, 90)}, "an MP4's width and height must be even, got 161 x 90"),
        ({"size": (8, 8)}, "size must lie in 16"),
        ({"fps": 0}, "fps must be above 0"),
        ({"fps": 500}, "fps must be at most 120 in a MP4"),
        ({"speed": float("nan")}, "speed must be above 0 and finite"),
        ({"speed": 1e-4}, "the film would have 1,4"),
        ({"speed": 1e-300}, r"the film would have 1\.49e\+302 frames, and 100,000 are the most"),
        ({"fps": 1e-9}, "fps must be at least 0.01, got 1e-09"),
    ],
)
def test_a_film_that_cannot_be_is_refused_and_nothing_is_written(run, lab_scene, tmp_path, options, what):
    with pytest.raises(InputError, match=what):
        film_of_run(run, lab_scene, tmp_path / "a.mp4", **options)
    assert list(tmp_path.iterdir()) == []


def test_runs_that_cannot_be_shown_are_refused(run, lab_scene, tmp_path):
    out, lost = tmp_path / "a.png", run["p_world_base"].copy()
    lost[-3:] = np.nan
    for broken, what in (
        (run.take(slice(0, 0)), "the run has no readings"),
        (run.select("t", "b_map_nt"), "has no positions"),
        (run.select("t", "p_world_base"), "but no headings"),
        (run.with_columns(p_world_base=lost), "p_world_base of the run is unknown for a part"),
    ):
        with pytest.raises(InputError, match=what):
            picture_of_run(broken, lab_scene, out, size=SIZE)
    with pytest.raises(InputError, match=r"goes from 0 to 5\.95 s; there is no 99 s in it"):
        picture_of_run(run, lab_scene, out, time_s=99.0)
    with pytest.raises(InputError, match=r"a\.mov: films end in \.mp4 or \.gif"):
        film_of_run(run, lab_scene, tmp_path / "a.mov")
    (tmp_path / "a.mp4").write_text("precious")
    with pytest.raises(InputError, match="exists already; give `force=True`"):
        film_of_run(run, lab_scene, tmp_path / "a.mp4")
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_text() == "precious"


def test_an_encoder_that_ends_early_is_a_refusal_with_its_reason(run, lab_scene, tmp_path, monkeypatch):
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\necho '[out#0/mp4 @ 0x5] Error: No space left on device' >&2\nexit 1\n")
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(broken))
    with pytest.raises(InputError, match=r"a\.mp4: cannot be written: Error: No space left on device$"):
        film_of_run(run, lab_scene, tmp_path / "a.mp4", fps=5, speed=2, size=(320, 180))
    assert [p.name for p in tmp_path.iterdir()] == ["ffmpeg"]


def test_of_two_robots_the_runs_own_moves(run, tmp_path):
    lab = scene_from_toml(shipped("scenes", "lab.toml"))
    ann, bob = (replace(lab.robot, name=name) for name in ("ann", "bob"))
    placed = PlacedRobot(robot=bob, start=(1.0, 1.0, 0.0))
    scene = author_scene(replace(lab, robot=ann, others=(placed,)), tmp_path / "scene")
    view, there = View.of("top"), {}
    for name in ("ann", "bob"):
        with Scenery(run.with_metadata(robot=name), scene, [0.0, 5.0], view=view, size=SIZE) as scenery:
            there[name] = scenery.poses(1)
    assert there["ann"].keys().isdisjoint(there["bob"])
    for poses in there.values():
        places = np.array([T[:2, 3] for T in poses.values()])
        np.testing.assert_allclose(places, run["p_world_base"][[100] * len(places), :2], atol=0.3)
    with pytest.raises(InputError, match="name no robot of the scene, which has ann, bob"):
        Scenery(run.with_metadata(robot="cleo"), scene, [0.0], view=view, size=SIZE)
