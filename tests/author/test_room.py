"""A room from its TOML alone: furniture, the survey by its robot, refusals, and the file to start from."""

import re
import runpy
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from validators import assert_valid

import magtwin
from magtwin.author.furniture import drawn_magnetization
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.field.maps.holes import filled
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.bodies import Bodies
from magtwin.field.sources.magnets import body_of
from magtwin.files.file import shipped
from magtwin.sim.at_rest import field_at_rest_nt
from magtwin.spec.furniture import KINDS, FurnitureSpec, parts_of
from magtwin.twin import author_scene, new_scene, open_twin, scene_from_toml, simulate
from magtwin.usd.scene import read_scene

ROOM = """
name = "den"
seed = 3

[robot]
asset = "turtlebot4"

[lab]
floor_m = [4.0, 3.0]

[earth]
latitude_deg = 48.0
longitude_deg = 11.0
height_m = 500.0
date = "2026-03-01"

[survey]
spacing_m = 0.5

[[furniture]]
name = "shelf"
kind = "shelf"
p_world = [-1.75, 0.0, 0.0]

[[furniture]]
name = "crate"
kind = "box"
material = "wood"
size_m = [0.4, 0.4, 0.4]
p_world = [1.5, 1.0, 0.0]
"""
TETRAHEDRON = "solid\n" + "".join(
    "facet normal 0 0 0\nouter loop\n"
    + "".join(f"vertex {x} {y} {z}\n" for x, y, z in corners)
    + "endloop\nendfacet\n"
    for corners in (
        ((0, 0, 0), (0, 400, 0), (400, 0, 0)),
        ((0, 0, 0), (400, 0, 0), (0, 0, 400)),
        ((400, 0, 0), (0, 400, 0), (0, 0, 400)),
        ((0, 0, 0), (0, 0, 400), (0, 400, 0)),
    )
)
TETRAHEDRON += "endsolid\n"


@pytest.fixture
def toml(tmp_path) -> Path:
    (tmp_path / "den.toml").write_text(ROOM)
    return tmp_path / "den.toml"


@pytest.fixture(scope="module")
def den(tmp_path_factory) -> Path:
    """The authored room; not to be changed."""
    folder = tmp_path_factory.mktemp("den")
    (folder / "den.toml").write_text(ROOM)
    return author_scene(folder / "den.toml", folder / "den")


# Furniture


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_of_furniture_makes_some_microtesla_beside_it_by_default(kind):
    parts = parts_of(kind)
    front = max(part.p[0] + part.size_m[0] / 2 for part in parts)
    y = np.linspace(-0.6, 0.6, 25)
    at = np.column_stack([np.full(25, front + 0.2), y, np.full(25, 0.405)])
    largest = []
    for seed in range(8):
        spec = FurnitureSpec(
            name=kind, kind=kind, p_world=(0, 0, 0), magnetization=drawn_magnetization(kind, parts, seed=seed)
        )
        field = Bodies([body_of(source) for source in spec.sources()]).field_nt(at)
        largest.append(np.linalg.norm(field, axis=1).max())
    assert 300 < np.median(largest) < 40_000


def test_adding_a_piece_does_not_change_the_others(toml):
    before = scene_from_toml(toml).furniture
    toml.write_text(ROOM + '[[furniture]]\nname = "a"\nkind = "chair"\np_world = [0.5, -1, 0]\n')
    after = scene_from_toml(toml).furniture
    assert after[: len(before)] == before
    assert any(after[-1].magnetization)
    toml.write_text(ROOM.replace("seed = 3", "seed = 4"))
    assert scene_from_toml(toml).furniture[0].magnetization != before[0].magnetization


@pytest.mark.parametrize("material", ["steel", "wood"])
def test_a_mesh_file_in_mm_stands_on_the_floor_amid_its_place(toml, tmp_path, material):
    (tmp_path / "wedge.stl").write_text(TETRAHEDRON)
    toml.write_text(
        ROOM + f'[[furniture]]\nname = "wedge"\nkind = "mesh"\nfile = "wedge.stl"\nscale = 0.001\n'
        f'material = "{material}"\np_world = [0.5, 1.0, 0.0]\n'
    )
    scene = scene_from_toml(toml)
    wedge = scene.furniture[-1]
    (part,) = wedge.parts
    assert part.size_m == pytest.approx((0.4, 0.4, 0.4))
    assert part.p == pytest.approx((0, 0, 0.2))
    assert bool(wedge.magnetization) == (material == "steel")
    assert read_scene(author_scene(scene, tmp_path / "s")).furniture == scene.furniture


@pytest.mark.parametrize(
    ("side", "message"),
    [
        ("4000", r"would be 4,000 m large; if it is in mm, give scale = 0\.001"),
        ("400", r"reaches .*; it is 400 x 400 m: is its file in mm\? then scale = 0\.001"),
    ],
)
def test_a_piece_that_was_taken_in_mm_is_refused_with_the_scale(toml, tmp_path, side, message):
    (tmp_path / "wedge.stl").write_text(TETRAHEDRON.replace("400", side))
    toml.write_text(
        ROOM + '[[furniture]]\nname = "wedge"\nkind = "mesh"\nfile = "wedge.stl"\nmaterial = "wood"\n'
        "p_world = [0.5, 1.0, 0.0]\n"
    )
    with pytest.raises(InputError, match=message):
        scene_from_toml(toml)


# The survey


def test_a_scene_without_a_map_is_surveyed_by_its_own_robot(den):
    twin = open_twin(den)
    field = twin.field
    assert field.values_nt.shape == (4, 7, 9)
    assert field.valid.all()
    y, x = 1, 4
    at = field.origin_m[0] + x * field.cell_m[0], field.origin_m[1] + y * field.cell_m[1]
    exact = field_at_rest_nt(twin.scene, at, field.headings_rad)
    assert field.values_nt[:, y, x] == pytest.approx(exact, abs=0.1)  # noise, and single precision
    assert 40_000 < field.values_nt.mean() < 55_000


def test_the_same_toml_gives_the_same_bytes(den, tmp_path):
    (tmp_path / "den.toml").write_text(ROOM)
    again = author_scene(tmp_path / "den.toml", tmp_path / "again").parent
    for file in den.parent.rglob("*"):
        if file.is_file():
            assert file.read_bytes() == (again / file.relative_to(den.parent)).read_bytes(), file


def test_nodes_in_furniture_are_filled_and_others_are_not(den):
    twin = open_twin(den)
    x = twin.field.origin_m[0] + twin.field.cell_m[0] * np.arange(9)
    y = twin.field.origin_m[1] + twin.field.cell_m[1] * np.arange(7)
    crate = np.array([1.5, 1.0])
    inside = np.hypot(*np.meshgrid(x - crate[0], y - crate[1])) < 0.2
    assert inside.sum() == 1
    row, column = np.argwhere(inside)[0]
    value = twin.field.values_nt[0]
    around = [value[row - 1, column], value[row + 1, column], value[row, column - 1], value[row, column + 1]]
    assert value[row, column] == pytest.approx(np.mean(around), abs=0.01)


def test_a_hole_in_a_harmonic_field_is_filled_exactly():
    x, y = np.meshgrid(np.arange(9.0), np.arange(7.0))
    exact = 45_000 + 3 * (x**2 - y**2) + 5 * x * y  # its discrete Laplacian is nought
    valid = np.ones((1, 7, 9), bool)
    valid[0, 2:5, 3:6] = False
    field = AnomalyMap(
        values_nt=np.where(valid, exact, 0.0),
        origin_m=(0.0, 0.0),
        cell_m=(0.5, 0.5),
        headings_rad=np.zeros(1),
        valid=valid,
        variance_nt2=np.ones((1, 7, 9)),
    )
    whole = filled(field)
    assert whole.valid.all()
    np.testing.assert_allclose(whole.values_nt[0], exact, rtol=1e-12)
    assert whole.variance_nt2 is not None
    assert whole.variance_nt2[~valid].min() > 1
    assert filled(whole) is whole


def test_a_surveyed_room_passes_the_gates(den, tmp_path):
    assert_valid(den, tmp_path)


def test_a_room_of_earth_alone_is_told_to_be_the_same_everywhere(toml):
    toml.write_text(ROOM[: ROOM.index("[[furniture]]")])
    told: list[str] = []
    scene_from_toml(toml, report=told.append)
    assert "nothing is magnetised, so the field is the same everywhere" in told[0]


# Map and sources


def test_a_moved_desk_is_noted_with_its_place(tmp_path):
    text = shipped("scenes", "lab.toml").read_text()
    root = shipped("scenes").parent
    text = text.replace('"../maps/lab/sources.toml"', '"sources.toml"').replace('"../', f'"{root}/')
    (tmp_path / "lab.toml").write_text(text)
    moved = shipped("maps", "lab", "sources.toml").read_text()
    (tmp_path / "sources.toml").write_text(moved.replace("[-1.9, 2.3, 0.0]", "[-1.4, 2.3, 0.0]"))
    told: list[str] = []
    scene_from_toml(tmp_path / "lab.toml", report=told.append)
    assert re.match(
        r"Note: the map differs from .* by 1\d\d nT rms over .* nodes, at most 1,\d+ nT, at x -", told[0]
    )


# The floor, the start, names


@pytest.mark.parametrize("name", ["furniture", "Room", "map", "Küche 地下室's v1.2"])
def test_any_scene_name_works(toml, tmp_path, name):
    toml.write_text(ROOM.replace('"den"', f'"{name}"'))
    root = author_scene(toml, tmp_path / "s")
    assert root.name == f"{name}.usda"
    scene = read_scene(root)
    assert scene.name == name
    assert scene.lab.floor_m == (4.0, 3.0)
    assert len(scene.furniture) == 2
    assert scene.earth is not None


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"turtlebot4"', '"turtelbot"', r"asset: no robot 'turtelbot'; known: turtlebot4; or give"),
        ("[-1.75, 0.0, 0.0]", "[-1.75, 0.0]", r"den\.toml:23: .*p_world must be a list of 3"),
        ("[1.5, 1.0, 0.0]", "[1.5, 9.0, 0.0]", r"den\.toml:30: .*'crate' is \(1\.5, 9\): it reaches .* slab"),
        ("[1.5, 1.0, 0.0]", "[1500, 1000, 0]", r"den\.toml:30: .*beyond the slab, which is 4\.5 x 3\.5 m"),
        ('kind = "box"', 'kind = "bx"', r"den\.toml:25: .*no furniture 'bx'; did you mean 'box'"),
        ('"wood"', '"wod"', r"den\.toml:28: .*no material 'wod'; did you mean 'wood'"),
        ('material = "wood"\n', "", r"material is missing: a box needs one of steel"),
        ("size_m = [0.4, 0.4, 0.4]\n", "", "size_m of a box must be its three sides"),
        ('kind = "shelf"', 'kind = "shelf"\nyaw = 90', r"den\.toml:23: .*radians.* 90 deg are 1\.5708 rad"),
        ('kind = "shelf"', 'kind = "shelf"\nsize_m = [1, 1, 1]', "size_m is for box, cylinder, mesh"),
        ('kind = "shelf"', 'kind = "mesh"\nmaterial = "wood"', 'kind "mesh" needs file = "FILE'),
        ('"crate"', '"shelf"', r"den\.toml:26: .*two pieces of furniture are called 'shelf'"),
        ('"crate"', '"my crate"', r"den\.toml:26: .*'my crate' cannot name a prim"),
        ("[4.0, 3.0]", "[4000, 3000]", r"den\.toml:9: \[lab\] floor_m must be in metres"),
        ("[4.0, 3.0]", "[4.0, 3.0]\napron_m = 1e30", "apron_m must be in metres, at most"),
        ("spacing_m = 0.5", "spacing_m = 50", r"den\.toml: cannot be surveyed: spacing_m 50 leaves no cell"),
        ("seed = 3", "start = [1.5, 0.9, 0]", "is in 'crate'; start ="),
        ("seed = 3", "start = [0, 0, 180]", r"den\.toml:3: start's yaw .* 180 deg are 3\.1416 rad"),
        ("seed = 3", "start = [3, 0, 0]", r"den\.toml:3: start .* off the floor of 4 x 3 m; start = \[1\.83"),
        ("seed = 3", "seed = -3", r"den\.toml:3: seed must not be below 0"),
        ('"den"', '"a/b"', r"den\.toml:2: scene 'a/b' cannot name a file"),
        ("[earth]", "[mars]", r"unknown key 'mars'"),
    ],
)
def test_a_room_that_does_not_fit_is_refused_by_line_with_nothing_written(toml, tmp_path, old, new, said):
    assert old in ROOM
    toml.write_text(ROOM.replace(old, new))
    with pytest.raises(InputError, match=said) as refused:
        author_scene(toml, tmp_path / "s")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "s").exists()


# The file to start from


def test_the_starter_works_as_it_stands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main(["new", "attic.toml"])
    said = capsys.readouterr().out
    assert "magtwin scene attic.toml --out attic" in said
    main(["scene", "attic.toml", "--out", "attic"])
    run = simulate("attic/attic.usda", "figure8", duration_s=5.0, rate_hz=10.0)
    assert np.isfinite(run["b_total_nt"]).all()
    main(["new", "attic.toml"])
    assert (tmp_path / "attic-1.toml").is_file()
    with pytest.raises(InputError, match=r"ends in \.toml"):
        main(["new", "attic.txt", "--debug"])


@pytest.mark.parametrize("path", ["sine", "lawnmower", "A", "B", "C", "D", "E"])
def test_every_path_passes_what_stands_in_the_starters_room(starter, path):
    run = simulate(starter, path, duration_s=400.0, rate_hz=1.0)
    assert not run["flag_bump"].any()
    assert np.isfinite(run["b_map_nt"]).all()


@pytest.fixture(scope="module")
def starter(tmp_path_factory):
    """The starter's twin."""
    folder = tmp_path_factory.mktemp("starter")
    return open_twin(author_scene(new_scene(folder / "room.toml"), folder / "room"))


# The page


def test_the_page_of_keys_is_what_the_dataclasses_give():
    docs = Path(magtwin.__file__).parents[1] / "docs"
    made = SimpleNamespace(**runpy.run_path(str(docs / "scenes.py")))
    page = made.page()
    assert (docs / "scenes.md").read_text(encoding="utf-8") == page, "python docs/scenes.py writes it"
    unsaid = [line for line in page.splitlines() if re.match(r"\| `\w+` .*\|\s+\|$", line)]
    assert unsaid == [], "every key has a meaning"
    assert is_dataclass(made.SceneFile)
    for field in fields(made.SceneFile):
        assert f"`{field.name}`" in page or f"[{field.name}]" in page
