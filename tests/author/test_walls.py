"""Rooms that are not rectangles: walls, doors and windows, their field, and what a robot does with them."""

from dataclasses import fields, replace

import magpylib
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from pxr import Gf, Usd, UsdGeom
from scipy.spatial.transform import Rotation
from validators import assert_valid

from magtwin.author.room import obstacles_in
from magtwin.author.walls import DoorTable, WallTable, lab_with_walls
from magtwin.errors import InputError, MismatchWarning
from magtwin.field.sources.bodies import MU_0, Bodies
from magtwin.field.sources.magnets import body_of
from magtwin.path import Room, path_in
from magtwin.path.points import path_of_points
from magtwin.sim.motion.commands import Commands
from magtwin.spec.lab import LabSpec, check_corners
from magtwin.spec.walls import Door, Wall, Window
from magtwin.twin import author_scene, open_twin, room_of, scan, scene_from_toml, simulate
from magtwin.usd.lab.room import define_lab
from magtwin.usd.lab.walls import read_lab
from magtwin.usd.scene import open_scene

CORNERS = "[[0, 0], [9, 0], [9, 3], [4, 3], [4, 5], [0, 5]]"
L_ROOM = f"""name = "l_room"
robot = {{asset = "turtlebot4", path = "coverage"}}
lab = {{floor = {CORNERS}}}
earth = {{latitude_deg = 48, longitude_deg = 11, height_m = 500, date = "2026-03-01"}}
survey = {{spacing_m = 0.5, headings_deg = [0]}}
wall = [{{from = [4, 0], to = [4, 3], material = "reinforced_concrete"}}, {{from = [0, 2.5], to = [4, 2.5]}}]
door = [{{wall = 0, at_m = 1.2, material = "steel"}}, {{wall = "wall_1", at_m = 2}}]
"""
EVERY_KEY = """
[[wall]]
name = "slab"
from = [4.0, 0.2]
to = [3.9, 2.9]
height_m = 2.25
thickness_m = 0.15
material = "steel"
magnetization = -12.5
susceptibility = 0.25

[[door]]
wall = "slab"
at_m = 1.25
name = "gate"
width_m = 1.05
height_m = 1.9
open_deg = -35.5
hinge = "end"
thickness_m = 0.05
material = "painted_steel"
magnetization = 321.0
susceptibility = 0.5

[[window]]
wall = "edge_1"
at_m = 1.5
name = "pane"
width_m = 0.75
height_m = 0.15
sill_m = 0.1
"""


def written(folder, text: str = L_ROOM):
    (folder / "room.toml").write_text(text, encoding="utf-8")
    return folder / "room.toml"


@pytest.fixture(scope="module")
def l_room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    scene = scene_from_toml(written(folder))
    return scene, author_scene(scene, folder / "l")


def lab_room(lab: LabSpec, radius: float = 0.171) -> Room:
    return Room(lab, radius, obstacles_in(lab, ()))


def test_a_stage_of_walls_reads_back_as_its_toml_and_is_valid(l_room, tmp_path):
    scene, stage = l_room
    opened = open_scene(stage)
    assert opened.scene.lab == scene.lab
    assert opened.scene.magnets == scene.magnets
    assert opened.changes == ()
    assert_valid(stage, tmp_path)


def test_every_key_of_walls_doors_and_windows_goes_into_the_stage_and_back(tmp_path):
    plain = L_ROOM.split("wall = [")[0]
    scene = scene_from_toml(written(tmp_path, plain + EVERY_KEY))
    lab = scene.lab
    for spec, empty in (
        (lab.walls[0], Wall((0, 0), (1, 0))),
        (lab.doors[0], Door("", 0)),
        (lab.windows[0], Window("", 0)),
    ):
        same = [f.name for f in fields(spec) if getattr(spec, f.name) == getattr(empty, f.name)]
        assert same == [], "EVERY_KEY gives each key another value than its default"
    assert open_scene(author_scene(scene, tmp_path / "l")).scene.lab == lab


def test_a_random_driver_a_lidar_and_a_bump_know_a_floor_with_corners(l_room):
    twin = open_twin(l_room[1])
    lab, radius = twin.scene.lab, twin.scene.robot.footprint_radius_m
    run = simulate(twin, "random", seed=3, duration_s=240.0, rate_hz=10)
    p = run["p_world_base"][:, :2]
    assert lab.inside_m(p).min() > radius
    assert not run["flag_bump"].any()
    assert np.ptp(p, axis=0).min() > 1.5  # it drives about
    seen = np.concatenate(scan(twin, run).points_world())[:, :2]
    assert np.abs(lab.inside_m(seen)).min() < 0.05  # sides of the room
    assert lab.inside_m(seen).min() > -0.05  # and nothing behind them
    bare = replace(twin.scene, lab=LabSpec(floor=lab.floor, wall_height_m=0.0))
    pushed = simulate(bare, path_of_points([(3.5, 4.0), (3.8, 4.0)]), seed=1, rate_hz=10)
    assert not pushed["flag_bump"].any()
    over = Commands("push", np.array([[t, 0.2, 0.0] for t in np.arange(0.0, 4.0, 0.1)]))
    pushed = simulate(replace(bare, start=(3.5, 4.0, 0.0)), over, seed=1, duration_s=4, rate_hz=10)
    assert_array_equal(pushed["flag_bump"], lab.inside_m(pushed["p_world_base"][:, :2]) < radius - 1e-9)
    assert pushed["flag_bump"].any()
    with pytest.raises(InputError, match=r"leaves the floor .* inside of its 6 corners"):
        simulate(bare, [(3.0, 4.5), (8.5, 2.0)])  # cuts the corner that points inwards


def test_the_field_of_walls_and_doors_is_magpylibs(l_room):
    lab, rng = l_room[0].lab, np.random.default_rng(1)
    tall, leaf = replace(lab.walls[0], magnetization=50.0), replace(lab.doors[0], magnetization=3000.0)
    lab = replace(lab, walls=(tall, lab.walls[1]), doors=(replace(leaf, open_deg=63.0), lab.doors[1]))
    steel = lab.magnets
    assert len(steel) == 4  # two solids and a lintel of the wall, and the leaf
    beside = [
        tall.at(s, d)
        for s, d in zip(
            rng.uniform(-0.5, 3.5, 100), rng.choice([-1, 1], 100) * rng.uniform(0.06, 4.0, 100), strict=True
        )
    ]
    p = np.column_stack([beside, rng.uniform(0.0, 2.8, 100)])
    want = sum(
        magpylib.magnet.Cuboid(
            dimension=source.size_m,
            polarization=MU_0 * np.array(source.magnetization),
            position=source.p_world,
            orientation=Rotation.from_quat(source.q_world_xyzw),
        ).getB(p)
        for source in steel
    )
    got = Bodies([body_of(source) for source in steel]).field_nt(p)
    assert np.abs(got - want * 1e9).max() < 0.01  # dipoles replace far bodies, within 1e-6 of these fields
    assert np.linalg.norm(got, axis=1).max() > 10_000


@pytest.mark.parametrize("open_deg", [0.0, 90.0, -90.0, 180.0, 40.0])
@pytest.mark.parametrize("hinge", ["start", "end"])
def test_a_leaf_turns_about_its_hinge_and_to_the_side_of_its_sign(open_deg, hinge):
    lab = LabSpec(
        floor_m=(6, 6), walls=(Wall((-2, 0), (2, 0)),), doors=(Door(0, 2.0, open_deg=open_deg, hinge=hinge),)
    )
    stage = Usd.Stage.CreateInMemory()
    define_lab(stage, lab)
    leaf = stage.GetPrimAtPath("/World/Lab/Walls/wall_0/door_0/leaf")
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default", "guide"]).ComputeWorldBound(leaf)
    middle = box.ComputeCentroid()
    jamb = -0.45 if hinge == "start" else 0.45
    assert np.hypot(middle[0] - jamb, middle[1]) == pytest.approx(0.45, abs=0.06)
    assert open_deg == 0 or np.sign(middle[1]) == np.sign(open_deg)
    assert read_lab(stage.GetPrimAtPath("/World/Lab")) == lab


def test_a_door_turned_and_a_wall_moved_on_the_stage_are_read_where_they_are(l_room):
    scene, file = l_room
    stage = Usd.Stage.Open(str(file))
    stage.SetEditTarget(stage.GetSessionLayer())
    door, wall = (stage.GetPrimAtPath(f"/World/Lab/Walls/{name}") for name in ("wall_0/door_0", "wall_0"))
    turn = Gf.Rotation((0, 0, 1), 30).GetQuat()
    door.GetAttribute("xformOp:orient").Set(Gf.Quatd(turn))
    wall.GetAttribute("xformOp:translate").Set(Gf.Vec3d(4.5, 0, 0))
    lab = read_lab(stage.GetPrimAtPath("/World/Lab"))
    assert lab.doors[0].open_deg == pytest.approx(30)
    assert lab.walls[0].start == (4.5, 0.0)
    assert lab.walls[0].end == pytest.approx((4.5, 3.0))
    assert lab.magnets[0].magnetization == scene.lab.magnets[0].magnetization


def test_steel_moved_out_of_its_wall_is_read_as_a_source_and_counts_once(l_room, tmp_path):
    scene, file = l_room
    stage = Usd.Stage.Open(str(file))
    stage.SetEditTarget(stage.GetRootLayer())
    stage.GetPrimAtPath("/World/Lab/Walls/wall_0/solid_0").GetAttribute("xformOp:translate").Set(
        Gf.Vec3d(0.4, 0, 1)
    )
    edited = file.with_name("edited.usda")
    stage.GetRootLayer().Export(str(edited))
    opened = open_scene(edited)
    assert len(opened.scene.magnets) == 2 * len(scene.lab.magnets)  # those of the wall without magnetization
    total = sum(np.abs(source.magnetization).sum() for source in opened.scene.magnets)
    assert total == pytest.approx(sum(np.abs(source.magnetization).sum() for source in scene.lab.magnets))
    assert "wall_0" in " ".join(opened.changes)


def test_coverage_enters_every_room_of_an_l_through_open_doors(l_room):
    twin = open_twin(l_room[1])
    room = room_of(twin)
    path = path_in(room, "coverage")
    assert room.refusal(path) is None
    rng, corners = np.random.default_rng(2), np.array(twin.scene.lab.corners)
    p = rng.uniform(corners.min(0), corners.max(0), (4000, 2))
    keep = twin.scene.robot.footprint_radius_m + 0.09  # its raster keeps some 0.085 m more from walls
    clear, _ = room.obstacles.clearance(p)
    free = p[np.minimum(room.lab.inside_m(p), clear) > keep]
    away = np.abs(path.nearest(free)[1])
    share = float((away <= 0.25).mean())
    assert share >= 0.9
    assert path.swept == pytest.approx(share, abs=0.03)
    for x0, x1, y0, y1 in ((0, 4, 0, 2.5), (0, 4, 2.5, 5), (4, 9, 0, 3)):
        inside = (free > (x0, y0)).all(axis=1) & (free < (x1, y1)).all(axis=1)
        assert (away[inside] <= 0.25).mean() >= 0.9


def test_a_run_over_the_whole_l_says_so_and_a_scaled_path_says_what_it_leaves_out(l_room):
    twin = open_twin(l_room[1])
    run = simulate(twin, "coverage", duration_s=30)
    assert "100.0% of the floor that the robot can reach" in str(run)
    left = simulate(twin, "figure8", duration_s=5)
    assert left.metadata["path_swept"] < 0.8
    assert "% of the free floor is outside of the path" in str(left)


def test_a_closed_door_stops_paths_and_the_lidar_and_is_named(l_room):
    lab = l_room[0].lab
    across = path_of_points([[3.0, 1.2], [5.0, 1.2]])
    assert (
        lab_room(replace(lab, doors=(replace(lab.doors[0], open_deg=110.0), lab.doors[1]))).refusal(across)
        is None
    )
    shut = lab_room(replace(lab, doors=(replace(lab.doors[0], open_deg=0.0), lab.doors[1])))
    said = str(shut.refusal(across))
    assert "/wall_0/door_0/leaf" in said
    assert "; open the door (open_deg), or move" in said
    with pytest.warns(
        MismatchWarning, match=r"cannot enter .* m2 .*: the door nearest to it is .*wall_0/door_0; open it"
    ):
        path_in(shut, "coverage")


def test_lidar_ranges_end_at_walls_and_pass_through_open_doors(l_room):
    twin = open_twin(l_room[1])
    run = simulate(twin, [[2.0, 1.25], [2.3, 1.25]], duration_s=2.0, lidar="on")
    scans = scan(twin, run)
    ranges = np.array(scans.ranges_m[0] if hasattr(scans, "ranges_m") else scans[0].ranges_m)
    known = ranges[np.isfinite(ranges)]
    assert known.min() > 0.5
    assert known.max() > 5.0  # through the door, to the far side of the L
    assert np.median(known) < 2.5


def test_the_sides_of_a_floor_close_its_border():
    lab = LabSpec(floor=((0, 0), (9, 0), (9, 3), (4, 3), (4, 5), (0, 5)))
    assert lab.extent_m == (0, 9, 0, 5)
    stage = Usd.Stage.CreateInMemory()
    define_lab(stage, lab)
    clear, _ = obstacles_in(lab, ()).clearance(
        np.array([[9.02, -0.02], [9.02, 1.0], [4.02, 4.0], [9.02, 3.02]])
    )
    assert (clear < 0).all()
    assert read_lab(stage.GetPrimAtPath("/World/Lab")) == lab
    assert replace(lab, floor=lab.floor[::-1]).corners == lab.floor


def test_default_magnetization_is_that_of_steel_in_the_wall():
    concrete, wall = WallTable((0, 0), (1, 0), material="reinforced_concrete"), WallTable((0, 0), (1, 0))
    made = [lab_with_walls(LabSpec(), [concrete], [], [], "", seed=s) for s in range(200)]
    drawn = [abs(lab.walls[0].magnetization) for lab in made]
    assert 5 <= min(drawn) < 8
    assert 45 < max(drawn) <= 50
    with_door = lab_with_walls(LabSpec(), [wall], [DoorTable(0, 0.5)], [], "", seed=0)
    assert with_door.doors[0].magnetization == 0


WALL = '[[wall]]\nname = "a"\nfrom = [0, 1]\nto = [4, 1]\n'
SHELF = '[[furniture]]\nname = "shelf"\nkind = "shelf"\np_world = [{}, {}, 0]\n'
DOOR = '[[door]]\nwall = "a"\nat_m = 2\n'


@pytest.mark.parametrize(
    ("lab", "more", "line", "said"),
    [
        (
            "floor = [[0, 0], [4, 4], [4, 0], [0, 4]]",
            "",
            "floor",
            "floor crosses itself: .*floor.0. .* meets .*in order",
        ),
        (
            "floor = [[0, 0], [4, 0], [2, 0], [2, 3]]",
            "",
            "floor",
            "floor crosses itself: it turns back at floor.1.",
        ),
        ("floor = [[0, 0], [4, 0]]", "", "floor", "three corners"),
        (
            "floor = [[0, 0], [4, 0], [4, 4], [0, 0]]",
            "",
            "floor",
            "same corner; .* need not repeat the first",
        ),
        ("floor = [[0, 0], [4, 0], [4, 4]]\nfloor_m = [4, 4]", "", "floor", "floor_m .* left out"),
        ("floor = [[0, 0], [9000, 0], [9000, 5000]]", "", "floor", "metres"),
        (
            "",
            "[[wall]]\nfrom = [1, 1]\nto = [1, 1]\n",
            "from",
            "end of wall must differ from its start, `from`",
        ),
        (
            "",
            WALL + SHELF.replace("shelf", "desk").format(2, 1),
            "p_world",
            r"'desk' stands 0.10 m deep in wall 'a' at \(2.00, 1.00\); move it",
        ),
        ("", WALL + "material = 'steal'\n", "material", "'steal'.*steel"),
        ("", WALL + "magnetization = 3.0\n", "magnetization", "plasterboard is not magnetic"),
        ("", WALL + WALL, "name", "'a' has a name that is taken"),
        ("", WALL.replace('"a"', '"a b"'), "name", "cannot name a prim"),
        ("", WALL + DOOR.replace('"a"', '"b"'), "wall", "no wall 'b' for 'door_0'.*'?a"),
        (
            "",
            WALL + DOOR.replace("at_m = 2", "at_m = 3.8"),
            "at_m",
            "reaches from 3.35 to 4.25 m .* 4 m long; choose at_m from 0.45 to 3.55",
        ),
        ("", WALL + DOOR + DOOR, "at_m", "'door_1' overlaps 'door_0'"),
        ("", WALL + DOOR + "thickness_m = 0.2\n", "thickness_m", "not be above that of wall 'a', 0.1 m"),
        ("", WALL + DOOR + "open_deg = 200\n", "open_deg", "-180..180"),
        (
            "",
            WALL + DOOR + "[[wall]]\nfrom = [2, 0]\nto = [2, 1.5]\n",
            "from",
            r"'wall_1' crosses 'door_0' of wall 'a' at \(2.00, 1.00\)",
        ),
        (
            "",
            WALL + SHELF.format(1, 1.1),
            "p_world",
            "'shelf' stands .* m deep in wall 'a'",
        ),
        ("", "[[window]]\nwall = 'a'\nat_m = 1\n", "wall", "the room has none|known: east"),
        (
            f"floor = {CORNERS}",
            WALL.replace("[0, 1]", "[6, 4]").replace("4, 1", "8, 4"),
            "from",
            "off the floor",
        ),
        (
            f"floor = {CORNERS}",
            SHELF.format(7, 4),
            "p_world",
            "reaches 1.25 m beyond the slab, which is the floor",
        ),
        (f"floor = {CORNERS}", SHELF.format(9, 1.5), "p_world", "0.05 m deep in wall 'edge_1'"),
    ],
)
def test_walls_that_cannot_be_are_refused_with_line_place_and_the_way_on(tmp_path, lab, more, line, said):
    text = (
        L_ROOM.split("lab = ")[0].replace("robot =", "start = [-2.0, -1.0, 0.0]\nrobot =")
        + L_ROOM[L_ROOM.index("earth") : L_ROOM.index("survey")]
        + f"[lab]\n{lab}\n{more}"
    )
    file = written(tmp_path, text.replace("start", "# start") if lab else text)
    with pytest.raises(InputError, match=said) as refusal:
        scene_from_toml(file)
    number = int(str(refusal.value).split(":")[1])
    assert file.read_text(encoding="utf-8").splitlines()[number - 1].startswith(line)


def test_what_stands_through_a_side_of_a_rectangle_is_told(tmp_path):
    text = L_ROOM.split("lab = ")[0] + L_ROOM[L_ROOM.index("earth") : L_ROOM.index("wall = ")]
    file = written(tmp_path, text + WALL + SHELF.format(-3, 0))
    with pytest.warns(MismatchWarning) as told:
        scene_from_toml(file)
    assert "'shelf' stands 0.05 m deep in wall 'West'" in str(told[-1].message)
    assert "wall 'a' reaches 1.00 m off the floor at (4.00, 1.00); end it" in str(told[0].message)


def test_a_path_through_a_closed_room_is_refused_with_the_wall(l_room):
    lab = replace(l_room[0].lab, doors=())
    said = str(lab_room(lab).refusal(path_of_points([[3.0, 1.2], [5.0, 1.2]])))
    assert "/World/Lab/Walls/wall_0/solid_0" in said
    check_corners(lab.floor)
