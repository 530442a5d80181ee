"""Scenes in Python: rooms call by call, changes by name, and one scene behind TOML, Python and USD."""

import dataclasses
import runpy
import typing
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from places import ROOT

import magtwin as mt
from magtwin.author.scene_file import SceneFile
from magtwin.author.tables import table_of_scene, toml_text
from magtwin.errors import InputError, MismatchWarning
from magtwin.files.settings import from_table, parse_toml

BOX = np.array([[x, y, z] for x in (0, 0.5) for y in (0, 0.4) for z in (0, 0.3)])
SIDES = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1), (2, 3, 7), (2, 7, 6)]
SIDES += [(0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]


def small(name="den") -> mt.Room:
    """A room of everything that a room can have."""
    sensor = {"rate_hz": 20, "p_link_sensor": (0.02, 0, 0.01)}
    return (
        mt.Room(5, 4, name=name, seed=4, wall_height_m=0.25)
        .wall((0.5, -2), (0.5, 2), material="reinforced_concrete")
        .door(1.2, width_m=1.0, open_deg=60, material="steel")
        .window(3.2)
        .shelf((-2.2, 0.5), susceptibility=20)
        .desk((1.6, 1.5), yaw=-1.57)
        .furniture("mesh", (-1, 1.2), material="wood", vertices_m=BOX, faces=SIDES)
        .magnet((1.5, -1, -0.1), m_world=(0, 0, 3))
        .magnet((-1, -1, -0.2), shape="cuboid", size_m=(0.3, 0.1, 0.1), magnetization=(2e3, 0, 0))
        .earth(48.137, 11.575, 520, "2026-06-01", north_deg=20)
        .survey(spacing_m=0.5, headings_deg=[0, 180], readings=5)
        .robot(
            at=(-1.5, -1),
            yaw=0.5,
            magnetometer=sensor,
            path="sine",
        )
        .robot(
            name="second",
            at=(1.5, 0),
            magnetometer=sensor,
            battery={"capacity_wh": 30},
            footprint_radius_m=0.2,
        )
    )


@pytest.fixture(scope="module")
def room() -> mt.Room:
    return small()


def same(one: mt.Scene, other: mt.Scene) -> bool:
    """Whether two scenes and their maps are equal but for where their files lie, and what they say of it."""

    def bare(scene: mt.Scene) -> mt.Scene:
        robots = [
            dataclasses.replace(placed, robot=dataclasses.replace(placed.robot, asset=Path()))
            for placed in scene.robots
        ]
        return dataclasses.replace(
            scene, map_layer=Path(), map_sha256="", robot=robots[0].robot, others=tuple(robots[1:])
        )

    maps = [mt.load_map(scene.map_layer).values_nt.tobytes() for scene in (one, other)]
    return bare(one) == bare(other) and maps[0] == maps[1]


def test_toml_python_and_usd_lead_to_each_other_without_loss(room, tmp_path):
    scene = room.scene
    room.to_toml(tmp_path / "den.toml")
    from_toml = mt.scene_from_toml(tmp_path / "den.toml")
    assert same(scene, from_toml)
    stage = mt.author_scene(room, tmp_path / "den")
    assert dataclasses.replace(stage.scene, start=scene.start) == dataclasses.replace(
        mt.read_scene(stage), start=scene.start
    )
    from_usd = stage.scene
    close = from_usd.with_(start=scene.start)  # a yaw comes back from a quaternion
    assert np.allclose(from_usd.start, scene.start, atol=1e-12)
    p = [placed.robot.p_base_magnetometer for placed in (*close.robots, *scene.robots)]
    assert np.allclose(p[0], p[2], atol=1e-12)
    exact = dataclasses.replace(close.robot, p_base_magnetometer=scene.robot.p_base_magnetometer)
    assert same(dataclasses.replace(close, robot=exact, others=scene.others), scene)
    from_usd.to_toml(tmp_path / "again.toml")
    assert same(mt.scene_from_toml(tmp_path / "again.toml"), from_usd)
    assert table_of_scene(from_usd).keys() == table_of_scene(scene).keys()


def another(kind: typing.Any, name: str) -> typing.Any:
    """A value that a key of a TOML may have, by its type."""
    if dataclasses.is_dataclass(kind):
        return table_of(kind)
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if type(None) in args:
        return another(next(a for a in args if a is not type(None)), name)
    if origin is typing.Literal:
        return args[-1]
    if origin is tuple:
        kinds = (args[0],) * 2 if args[-1] is Ellipsis else args
        return [another(each, name) for each in kinds]
    if origin is not None:
        return {"key": "value"}
    known = {float: 0.375, int: 3, str: f'a "{name}" \\ with é and \x7f', bool: True, Path: "a/b.usdc"}
    return known.get(kind, known[str])


def table_of(cls: type) -> dict[str, typing.Any]:
    """A table with every key of a dataclass of a TOML, as docs/scenes.py lists them."""
    hints = typing.get_type_hints(cls)
    keys = {f.name: f.metadata.get("key", f.name) for f in dataclasses.fields(cls)}
    return {key: another(hints[name], name) for name, key in keys.items() if key is not None}


def test_every_key_of_a_toml_goes_through_its_text_and_back():
    table = table_of(SceneFile)
    text = toml_text(table)
    assert parse_toml(text, "text") == table
    page = (ROOT / "docs" / "scenes.md").read_text(encoding="utf-8")
    assert all(f"`{key}`" in page or f"[{key}]" in page for key in table)


def test_every_key_of_a_room_is_in_the_tables_of_its_scene(room):
    """What a call takes is in the TOML, and what the scene holds comes back from its own tables."""
    tables = room.tables
    from_table(SceneFile, dict(tables), "room")
    of_scene = table_of_scene(room.scene)
    assert set(tables) - {"seed", "survey"} <= set(of_scene)
    for section in ("wall", "door", "window", "furniture", "source", "robot"):
        assert [each["name"] for each in tables[section]] == [each["name"] for each in of_scene[section]]


def test_each_call_leaves_the_room_as_it_was():
    before = mt.Room(5, 4)
    after = before.shelf((1, 1))
    assert "furniture" not in before.table
    assert after.table["furniture"][0]["name"] == "shelf"
    with pytest.raises(AttributeError):
        before.table = {}


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda room: mt.Room("6", 4), "floor_m must be a list of 2, each a number, got .'6'"),
        (lambda room: mt.Room(6000, 4000), "must be in metres"),
        (lambda room: mt.Room(6, 4, wall_hight_m=1), "did you mean 'wall_height_m'"),
        (lambda room: mt.Room(6, floor=[(0, 0), (1, 0), (1, 1)]), "leave out x_m"),
        (lambda room: room.shelf((2500, 0)), "at is .*beyond the slab.*lengths are in metres"),
        (lambda room: room.shelf(("1", "2")), "p_world must be a list of 3, each a number, got .'1'"),
        (lambda room: room.shelf(3), r"at must be x and y"),
        (lambda room: room.shelf((1, 1), yaw=90), "in radians.*90 deg are 1.5708"),
        (lambda room: room.furniture("shelv", (1, 1)), "did you mean 'shelf'"),
        (lambda room: room.shelf((1, 1), magnetisation=[1]), "did you mean 'magnetization'"),
        (lambda room: room.box((1, 1), (1, 1), "steel"), "size_m must be a list of 3"),
        (lambda room: room.mesh("nope.stl", (1, 1), "steel"), "nope.stl: no such mesh file"),
        (lambda room: room.shelf((1, 1), name="a").desk((0, 0), name="a"), "called 'a'"),
        (lambda room: room.door(1), "no wall yet"),
        (lambda room: room.wall((0, -2), (0, 2)).door(9), "choose at_m from 0.45 to 3.55"),
        (lambda room: room.wall((0, -2), (0, 2)).door(2).wall((-1, 0), (1, 0)), "crosses 'door_0'"),
        (lambda room: room.wall((0, -2), (0, 2)).shelf((0, 0)), "deep in wall"),
        (lambda room: room.shelf((0, 0)).wall((0, -2), (0, 2)), "deep in wall"),
        (lambda room: room.magnet((0, 0)), "needs m_world"),
        (lambda room: room.magnet((0, 0), m_world=5), "m_world must be a list of 3, each a number, got 5"),
        (lambda room: room.wall((4, 0), (5, 0)), r"stands off the floor .* 2.00 m .* at \(5.00, 0.00\)"),
        (lambda room: room.earth(100, 0), "latitude_deg"),
        (lambda room: room.survey(spacing=1), "did you mean 'spacing_m'"),
        (lambda room: room.robot("turtelbot4"), "no robot 'turtelbot4'; known: turtlebot4"),
        (lambda room: room.robot(wheels=3), "no part 'wheels'"),
        (lambda room: room.robot(at=(9, 9)).scene, "off the floor.*is free"),
        (lambda room: room.door(2, "south").robot(at=(-1.45, -1.3)).scene, "is in 'door_0'; .* is free"),
        (lambda room: room.robot().robot(name="turtlebot4"), "called 'turtlebot4'"),
        (lambda room: mt.simulate(room), r"has no robot; add one: .robot"),
        (lambda room: mt.open_twin(5), "scene must be a Scene, a Room"),
        (lambda room: mt.survey(room.robot(), spacing=1), "did you mean 'spacing_m'"),
        (lambda room: mt.FurnitureSpec(name="a", kind="shelf", p_world=(1, 2)), "must be 3 numbers"),
        (lambda room: mt.MagnetometerSpec(rate_hz="135"), "must be a number, got '135'"),
        (lambda room: mt.train("nowhere", hidden=(3,)), "hidden is no option of a training; known: batch"),
        (lambda room: mt.train("nowhere", epochs="5"), "epochs must be a whole number, got '5'"),
        (lambda room: mt.sweep([]), "sweep got no scene"),
    ],
)
def test_a_mistake_in_python_is_refused_with_the_way_on(make, words):
    with pytest.raises(InputError, match=words):
        make(mt.Room(6, 4))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"furniture.dsk.p_world": (1, 0, 0)}, "did you mean 'desk'"),
        ({"furniture.desk.p_wrld": (1, 0, 0)}, "did you mean 'p_world'"),
        ({"furniture.desk": 3}, "followed by a field"),
        ({"furniture.desk.p_world": (100, 2, 0)}, "beyond the slab"),
        ({"robot.magnetometer.rate_hz": "20"}, "must be a number"),
        ({"robot.magnetometer.link": "x"}, "must stay 'magnetometer_link'"),
        ({"nme": 3}, "did you mean 'name'"),
    ],
)
def test_a_change_that_cannot_be_is_refused(room, changes, words):
    with pytest.raises(InputError, match=words):
        room.with_(changes)


def test_changes_by_name(room):
    scene = room.scene
    changed = room.with_(
        {"furniture.*.susceptibility": 0.0, "furniture.desk": None, "lab.doors.door_0.open_deg": 0}, name="b"
    )
    assert [piece.name for piece in changed.furniture] == ["shelf", "mesh"]
    assert {piece.susceptibility for piece in changed.furniture} == {0.0}
    assert (changed.lab.doors[0].open_deg, changed.name, scene.name) == (0.0, "b", "den")
    fresh = changed.with_(map_layer=mt.survey(changed, spacing_m=0.5, readings=2))
    with warnings.catch_warnings():
        warnings.simplefilter("error", MismatchWarning)
        assert mt.open_twin(fresh).scene.name == "b"


def test_a_sweep_of_scenes_equals_single_runs_and_tells_of_stale_maps(room, tmp_path):
    from pxr import Usd

    scene = room.scene
    moved = [scene.with_({"furniture.desk.p_world": (1.6, 1.3 - k / 10, 0)}) for k in range(3)]
    stage_file = mt.author_scene(scene, tmp_path / "den")
    stage = Usd.Stage.Open(str(stage_file))
    stage.GetPrimAtPath("/World/Furniture/desk").GetAttribute("xformOp:translate").Set((1.6, 1.3, 0.0))
    assert mt.read_scene(stage).furniture[1] == moved[0].furniture[1]
    way = [(-2, -1.5), (-0.5, -1.5)]
    options = {"duration_s": 3.0, "rate_hz": 5.0}
    with pytest.warns(
        MismatchWarning, match=r"scene 0.*desk is moved.*nT rms.*at x .* m.*and 3 more"
    ) as told:
        runs = mt.sweep([*moved, stage, room], way, seed=7, **options)
    assert len(told) == 1
    assert len(runs) == 5
    made = list(runs)
    for k, place in enumerate((*moved, stage, room)):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MismatchWarning)
            alone = mt.simulate(place, way, seed=7 + k, **options)
        assert all(alone[name].tobytes() == made[k][name].tobytes() for name in alone)
        assert made[k].metadata["config_sha256"] == alone.metadata["config_sha256"]
        assert ("map_mismatch" in made[k].metadata) == (k < 4)
    assert made[0]["b_total_nt"].tobytes() == runs[0]["b_total_nt"].tobytes()
    assert made[0].metadata["map_mismatch"].endswith("with_(map_layer=magtwin.survey(scene))")
    assert "runs" in str(runs.save(tmp_path / "runs", jobs=2))
    runs.save(tmp_path / "again")
    listed = [(tmp_path / name / "runs.csv").read_text().splitlines() for name in ("runs", "again")]
    assert listed[0] == listed[1]
    assert listed[0][0] == "file,scene,scene_name,path,seed,session,speed_m_s,readings"
    assert [line.split(",")[1:3] for line in listed[0][1:]] == [[str(k), "den"] for k in range(5)]


def test_simulate_warns_of_the_robots_that_it_leaves_out(room):
    with pytest.warns(MismatchWarning, match="drives 'turtlebot4' alone, without 'second'; simulate_robots"):
        mt.simulate(room, [(-2, -1.5), (-0.5, -1.5)], duration_s=1.0, rate_hz=5.0)


def test_the_page_author_in_python_runs_from_an_empty_folder(tmp_path, monkeypatch):
    page = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "python.py")))
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    page.files(text, tmp_path)
    namespace: dict[str, typing.Any] = {"__name__": "__main__"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for kind, code in page.steps(text):
            if kind == "picture":
                assert (ROOT / "docs" / "python" / f"{code}.png").is_file()
                continue
            code = code.replace("range(100)", "range(3)").replace("epochs=20", "epochs=2")
            code = code.replace('"coverage", rate_hz=5', '"coverage", rate_hz=5, duration_s=5')
            exec(compile(code, "docs/python.md", "exec"), namespace)
    assert sum(path.stat().st_size for path in (ROOT / "docs" / "python").iterdir()) < 1_000_000
    heads = [line for line in text.splitlines() if line.startswith("### ")]
    assert len(heads) == 10


def test_what_is_authored_draws_itself(room, tmp_path):
    stage = mt.author_scene(room, tmp_path / "den")
    assert stage == tmp_path / "den" / "den.usda"
    shown = stage._repr_html_()
    assert "data:image/png;base64," in shown
    assert len(shown) < 300_000
    assert stage.parent._repr_html_() is None
    twin = mt.open_twin(stage)
    run = mt.simulate(twin, [(-2, -1.5), (-0.5, -1.5)], duration_s=3, rate_hz=5)
    for figure in (twin.plot(), run.plot(), run.plot(scene=room), room.plot()):
        drawn = [
            patch for ax in figure.findobj(lambda each: hasattr(each, "patches")) for patch in ax.patches
        ]
        assert len(drawn) > 10  # walls and furniture
    with pytest.raises(InputError, match=r"what must be a Run, an AnomalyMap, a Scene, .* got int"):
        mt.plot(5)
