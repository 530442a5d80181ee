"""Floor plans: SVG, DXF, GeoJSON and occupancy maps made the TOML of a room that is driven through."""

import json

import numpy as np
import pytest

from magtwin.author.plan.plan import plan_toml
from magtwin.author.plan.svg import read_svg
from magtwin.author.room import obstacles_in
from magtwin.author.scene_file import SceneFile
from magtwin.author.walls import lab_with_walls
from magtwin.cli import main
from magtwin.errors import InputError
from magtwin.files.settings import from_table, read_toml
from magtwin.path import Room, path_in
from magtwin.path.occupancy import occupancy_of
from magtwin.spec.lab import LabSpec, area_m2, on_polygon
from magtwin.spec.walls import Door, Wall
from magtwin.twin import new_scene

SVG = """<?xml version="1.0"?>
<svg xmlns="http://www.w3.org/2000/svg" xmlns:inkscape="http://www.inkscape.org/namespaces/inkscape" {size}>
<rect x="0" y="0" width="900" height="500" style="fill:#ffffff"/>
<g inkscape:groupmode="layer" inkscape:label="Walls" style="stroke:#000;stroke-width:12">
<path d="M 10,10 h 880 V 490 H 10 Z"/><line x1="400" y1="10" x2="400" y2="490"/>
<polyline points="400,250 600,250"/><line x1="690" y1="250" x2="890" y2="250"/>
<g transform="translate(150,300) rotate(90)"><rect width="80" height="20"/></g></g>
<g class="doors"><line x1="400" y1="80" x2="400" y2="170"/><line x1="400" y1="330" x2="400" y2="420"/>
<line x1="600" y1="250" x2="690" y2="250"/></g>
<g id="furniture"><rect x="50" y="50" width="100" height="60"/></g>
</svg>"""
SIZED = 'width="9000mm" height="5000mm" viewBox="0 0 900 500"'


def dxf(units: int = 6, k: float = 1.0) -> str:
    """Rooms A and B of 6 x 5 m with a swing door between them, a window, and a block, as text of DXF."""
    head = ["0", "SECTION", "2", "HEADER", "9", "$INSUNITS", "70", str(units), "0", "ENDSEC"]
    block = ["0", "SECTION", "2", "BLOCKS", "0", "BLOCK", "8", "0", "2", "SWING", "10", "0", "20", "0"]
    block += ["0", "LINE", "8", "0", "10", "0", "20", "0", "11", "0", "21", f"{0.9 * k}"]
    block += ["0", "ARC", "8", "0", "10", "0", "20", "0", "40", f"{0.9 * k}", "50", "0", "51", "90"]
    block += ["0", "ENDBLK", "0", "ENDSEC"]
    body = ["0", "SECTION", "2", "ENTITIES", "0", "LWPOLYLINE", "8", "A-WALL", "90", "4", "70", "1"]
    for x, y in ((100, 200), (112, 200), (112, 205), (100, 205)):
        body += ["10", f"{x * k}", "20", f"{y * k}"]

    def line(layer: str, *ends: float) -> list[str]:
        codes = zip(("10", "20", "11", "21"), ends, strict=True)
        return ["0", "LINE", "8", layer, *[word for c, n in codes for word in (c, f"{n * k}")]]

    body += line("A-WALL", 106, 200, 106, 202) + line("A-WALL", 106, 202.9, 106, 205)
    body += line("A-GLAZ", 102, 200, 103.2, 200) + line("A-ANNO-DIMS", 100, 190, 112, 190)
    body += ["0", "INSERT", "8", "A-DOOR", "2", "SWING", "10", f"{106 * k}", "20", f"{202 * k}", "50", "90"]
    return "\n".join([*head, *block, *body, "0", "ENDSEC", "0", "EOF", ""])


def geojson(place) -> str:
    def feature(kind, corners, **properties):
        return {
            "type": "Feature",
            "properties": properties,
            "geometry": {"type": kind, "coordinates": corners},
        }

    rooms = [[(0, 0), (9, 0), (9, 5), (0, 5), (0, 0)], [(9, 0), (14, 0), (14, 5), (9, 5), (9, 0)]]
    features = [feature("Polygon", [[place(*p) for p in ring]], indoor="room") for ring in rooms]
    features.append(feature("LineString", [place(9, 2), place(9, 2.9)], indoor="door"))
    return json.dumps({"type": "FeatureCollection", "features": features})


def room_in(tmp_path, name: str, text: str, scale: float | None = None) -> LabSpec:
    (tmp_path / name).write_text(text, encoding="utf-8")
    toml = new_scene(tmp_path / "room.toml", plan=tmp_path / name, scale=scale)
    return lab_of(toml)


def lab_of(toml) -> LabSpec:
    """The room of a TOML, which is not surveyed."""
    table = read_toml(toml)
    given = from_table(SceneFile, {**table, "robot": [table["robot"]]}, toml)
    return lab_with_walls(given.lab, given.wall, given.door, given.window, toml, seed=0)


def covered(lab: LabSpec) -> float:
    room = Room(lab, 0.171, obstacles_in(lab, ()))
    path = path_in(room, "coverage")
    assert room.refusal(path) is None
    return path.swept


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("name", "text", "walls", "doors", "size"),
    [
        ("plan.svg", SVG.format(size=SIZED), 5, 3, (8.8, 4.8)),
        ("plan.dxf", dxf(), 3, 1, (12, 5)),
        ("plan.geojson", geojson(lambda x, y: [x, y]), 7, 1, (14.1, 5.1)),
    ],
)
def test_a_plan_becomes_a_room_that_is_driven_through_every_door(tmp_path, name, text, walls, doors, size):
    lab = room_in(tmp_path, name, text)
    x0, x1, y0, y1 = lab.extent_m
    assert (x1 - x0, y1 - y0) == pytest.approx(size, abs=0.01)
    assert (len(lab.walls), len(lab.doors)) == (walls, doors)
    assert covered(lab) >= 0.9


def test_walls_of_an_svg_lie_where_its_transforms_put_them(tmp_path):
    lab = room_in(tmp_path, "plan.svg", SVG.format(size=SIZED))
    assert lab.walls[0].start == (3.9, 4.8)
    assert lab.walls[0].thickness_m == 0.12  # its stroke
    pillar = lab.walls[3]
    assert (pillar.start, pillar.end) == ((1.3, 1.1), (1.3, 1.9)) or (pillar.end, pillar.start) == (
        (1.3, 1.1),
        (1.3, 1.9),
    )
    assert pillar.thickness_m == 0.2


@pytest.mark.parametrize(
    ("transform", "want"),
    [
        ("matrix(0 1 -1 0 5 6)", (3, 7)),
        ("translate(5)", (6, 2)),
        ("translate(5,6) scale(2)", (7, 10)),
        ("rotate(90)", (-2, 1)),
        ("rotate(180, 5, 5)", (9, 8)),
        ("skewX(45)", (3, 2)),
        ("skewY(45)", (1, 3)),
    ],
)
def test_transforms_are_those_of_svg(tmp_path, transform, want):
    file = tmp_path / "plan.svg"
    file.write_text(
        f'<svg><line transform="{transform}" x1="1" y1="2" x2="9" y2="9"/></svg>', encoding="utf-8"
    )
    assert read_svg(file).lines[0].p[0] == pytest.approx((want[0], -want[1]))


def test_units_of_a_dxf_scale_it(tmp_path):
    metres = room_in(tmp_path, "plan.dxf", dxf())
    (tmp_path / "room.toml").unlink()
    assert room_in(tmp_path, "plan.dxf", dxf(4, 1000)) == metres
    window, door = metres.windows[0], metres.doors[0]
    assert (window.wall, window.at_m, window.width_m) == ("edge_0", 2.6, pytest.approx(1.2, abs=0.01))
    assert metres.structure.wall_of(door).at(door.at_m) == pytest.approx((6, 2.45))


def test_degrees_are_projected_to_metres_on_the_ellipsoid(tmp_path):
    # a degree of latitude and of longitude at 60 N on WGS 84: 111,412 m and 55,800 m (NGA's tables)
    lab = room_in(tmp_path, "plan.geojson", geojson(lambda x, y: [25 + x / 55_800, 60 + y / 111_412]))
    assert covered(lab) > 0.9
    x0, x1, y0, y1 = lab.extent_m
    assert (x1 - x0, y1 - y0) == pytest.approx((14.1, 5.1), abs=0.005)


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_an_occupancy_map_becomes_the_room_that_it_shows(tmp_path, yaw):
    made = LabSpec(
        floor=((0, 0), (8, 0), (8, 3), (4, 3), (4, 6), (0, 6)),
        walls=(Wall((0, 3), (4, 3)),),
        doors=(Door(0, 2, material="none"),),
    )
    grid = occupancy_of(Room(made, 0.171, obstacles_in(made, ())))
    file, _ = grid.save(tmp_path / "map.yaml")
    file.write_text(file.read_text(encoding="utf-8").replace("0.0]", f"{yaw}]"), encoding="utf-8")
    lab = lab_of(new_scene(tmp_path / "room.toml", plan=tmp_path / "map.pgm"))
    assert area_m2(lab.corners) == pytest.approx(36 - 0.3, rel=0.03)
    inside = np.array([[1.0, 1.0], [7.0, 1.0], [1.0, 5.0], [2.0, 3.0]])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    at = (inside - grid.origin_m) @ turn.T + grid.origin_m
    assert on_polygon(at, lab.corners).all()
    assert covered(lab) >= 0.9


BOX = '<svg width="90" height="50"><rect id="wall" width="90" height="50" stroke="red"/></svg>'


@pytest.mark.parametrize(
    ("name", "text", "scale", "said"),
    [
        (
            "p.svg",
            BOX,
            None,
            r"p.svg: a plan without a scale: .* give `scale=M`, .* 90 x 50 units large, so that 0.11 ",
        ),
        (
            "p.svg",
            BOX.replace('"90"', '"90mm"', 1),
            None,
            r"would be 0.02381 x 0.01323 m large, since its width is 90mm; give `scale",
        ),
        ("p.svg", BOX, 100.0, "would be 9000 x 5000 m large, since scale is 100"),
        ("p.svg", BOX, -1.0, "scale must be above 0"),
        ("p.svg", "<svg/>", 1.0, "no lines in it"),
        ("p.svg", "<html/>", 1.0, "not an SVG: its first element is 'html'"),
        ("p.svg", '<svg>\n<path d="M 0 0 L 1"/></svg>', 1.0, r"p.svg:2: command L of a path takes 2 numbers"),
        ("p.svg", '<svg>\n<line x1="a"/></svg>', 1.0, "p.svg:2: x1 of <line> must be a length, got 'a'"),
        ("p.svg", '<!DOCTYPE svg [<!ENTITY a "b">]><svg/>', 1.0, "DOCTYPE"),
        ("p.svg", BOX.replace("wall", "furniture"), 0.1, "no walls in it"),
        ("p.dxf", dxf(0), None, "a plan without a scale: it has no \\$INSUNITS; give `scale=M`"),
        ("p.dxf", "AutoCAD Binary DXF\r\n", None, "save it as ASCII DXF"),
        ("p.dxf", "0\nSECTION\nx\n", None, "no lines|p.dxf:3"),
        ("p.geojson", "{", None, "not GeoJSON"),
        ("p.geojson", '{"type": "FeatureCollection"}', None, "not GeoJSON"),
        ("p.pgm", "P5\n2 2\n255\n", None, "a map without a scale: no p.yaml is beside it"),
        ("p.pgm", "P5\n2 2\n", 0.05, "not a picture"),
        ("p.yaml", "image: p.pgm\n", None, "not a map of map_server"),
        ("p.yaml", "image: p.pgm\nresolution: 0.05\norigin: [a]\n", None, "origin must be"),
        ("p.yaml", "image: gone.pgm\nresolution: 0.05\n", None, "gone.pgm: no such picture"),
        ("p.txt", "", None, "a floor plan is .svg, .dxf, .geojson"),
    ],
)
def test_what_is_no_plan_is_refused_with_file_and_the_way_on(tmp_path, name, text, scale, said):
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=said):
        plan_toml(tmp_path / name, "room", scale)


def test_the_command_says_how_it_read_the_plan_and_what_to_do_next(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plan.svg").write_text(SVG.format(size='width="900"'), encoding="utf-8")
    main(["new", "flat.toml", "--plan", "plan.svg", "--scale", "0.01"])
    said = capsys.readouterr()
    assert "magtwin scene flat.toml --out flat" in said.out
    assert "one unit is 0.01 m (as told)" in (tmp_path / "flat.toml").read_text(encoding="utf-8")
    with pytest.raises(SystemExit):
        main(["new", "other.toml", "--scale", "2"])
    assert "give --plan" in capsys.readouterr().err
