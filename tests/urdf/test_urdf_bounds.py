"""Descriptions whose counts would take time with their square, or memory beyond their budget."""

import tracemalloc

import pytest
from made import joint, link

from magtwin.errors import InputError
from magtwin.files import budget
from magtwin.files.budget import Budget
from magtwin.urdf.convert import convert_urdf
from magtwin.urdf.description.description import read_description
from magtwin.urdf.meshes.mesh import read_mesh
from magtwin.urdf.physics import articulation
from magtwin.urdf.source import xacro
from magtwin.urdf.source.markup import plain_text
from magtwin.urdf.source.settings import read_settings
from magtwin.urdf.source.source import read_source


def robot(tmp_path, *parts):
    path = tmp_path / "robot.urdf"
    path.write_text("\n".join(['<robot name="r">', *parts, "</robot>"]))
    return path


def test_a_robot_of_too_many_links_or_joints_is_refused_at_once(tmp_path, monkeypatch):
    monkeypatch.setitem(budget.BUDGETS, "URDF", Budget(count=3))
    links = [link(f"l{i}", "") for i in range(3)]
    joints = [joint(f"j{i}", "l0", f"l{i + 1}") for i in range(2)]
    assert len(read_description(robot(tmp_path, *links, *joints)).links) == 3
    with pytest.raises(InputError, match=r"robot\.urdf:1: over 3 links; split the file"):
        read_description(robot(tmp_path, *links, link("x", "")))
    with pytest.raises(InputError, match=r"robot\.urdf:1: over 3 joints; split the file"):
        read_description(robot(tmp_path, *links, *joints, *joints))
    with pytest.raises(InputError, match=r"robot\.urdf:\d+: joint 'j0' exists twice.*rename one"):
        read_description(robot(tmp_path, link("l0", ""), joint("j0", "l0", "a"), joint("j0", "l0", "b")))
    with pytest.raises(InputError, match=r"robot\.urdf:1: over 3 visuals; split the file"):
        read_description(robot(tmp_path, link("l", "<visual/>" * 4)))


def test_colliders_in_one_place_are_compared_up_to_a_count(tmp_path, monkeypatch):
    ball = '<collision><geometry><sphere radius="1"/></geometry></collision>'
    links = [link(f"l{i}", ball) for i in range(6)]
    joints = [joint(f"j{i}", "l0", f"l{i + 1}", "floating") for i in range(5)]
    monkeypatch.setattr(articulation, "COMPARED", 15)
    convert_urdf(robot(tmp_path, *links, *joints), tmp_path / "r.usda")
    monkeypatch.setattr(articulation, "COMPARED", 14)
    with pytest.raises(InputError, match="link 'l4': over 14 pairs of colliders are in one place"):
        convert_urdf(robot(tmp_path, *links, *joints), tmp_path / "r.usda", force=True)


# --- xacro ----------------------------------------------------------------------------------------

HEAD = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'
ROOT = '<link name="base_link"/></robot>'
MANY = 200
UNUSED = f'<xacro:if value="0">{"<a/>" * MANY}</xacro:if>'
WEARING = {
    "bodies of macros": f'<xacro:macro name="m">{UNUSED}</xacro:macro>' + "<xacro:m/>" * MANY,
    "bodies of comments": f'<xacro:macro name="m">{"<!---->" * MANY * 4}</xacro:macro>' + "<xacro:m/>" * MANY,
    "bodies of blocks": f'<xacro:property name="b">{UNUSED}</xacro:property>'
    + '<xacro:insert_block name="b"/>' * MANY,
    "texts": f'<xacro:macro name="m">{"a" * 50_000}</xacro:macro>' + "<xacro:m/>" * MANY,
    "siblings": "<a/>" * 5 * MANY + "<xacro:if value='0'/>" * 5 * MANY,
    "parameters": f'<xacro:macro name="m" params="{" ".join(f"p{i}:=1" for i in range(20 * MANY))}"/>',
    "names outside of macros": '<xacro:macro name="m0"><a x="${len([p for i in range(999)])}"/></xacro:macro>'
    + "".join(f'<xacro:macro name="m{i}"><xacro:m{i - 1}/></xacro:macro>' for i in range(1, 60))
    + '<xacro:property name="p" value="1"/>'
    + "<xacro:m59/>" * 3,
    "long expressions": f'<a x="${{1 if 1 else [{"1," * 900}]}}"/>' * MANY,
    "includes": '<xacro:include filename="other.xacro"/>' * MANY,
    "settings": """<a x="${len(xacro.load_yaml('settings.yaml'))}"/>""" * 5,
    "names of files": '<xacro:include filename="none.xacro" optional="true"/>' * MANY,
}


@pytest.mark.parametrize("work", WEARING)
def test_a_xacro_pays_for_all_its_work(work, tmp_path, monkeypatch):
    path = tmp_path / "r.xacro"
    path.write_text(HEAD + WEARING[work] + ROOT)
    (tmp_path / "other.xacro").write_text(f"<robot><!--{'a' * 3_000}--></robot>")
    (tmp_path / "settings.yaml").write_text("a: 1\n" * 2_000)
    monkeypatch.setattr(xacro, "UNITS", 200_000)
    with pytest.raises(InputError, match=r"r\.xacro:1: expands without end"):
        read_source(path)


# --- memory ---------------------------------------------------------------------------------------


def test_text_of_many_lines_takes_no_object_for_each(tmp_path):
    path = robot(tmp_path, link("base_link", ""), "<x>" + "\u0100\n" * 300_000, "</x>")
    tracemalloc.start()
    try:
        element = read_source(path).xml[1]
        line = plain_text(element)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 20 * path.stat().st_size  # 76 bytes an object, for 3 bytes of the file
    assert len(line) == len("<x></x>") + 2 * 300_000
    assert line[:6] == "<x>\u0100 \u0100"


def test_a_material_that_nothing_wears_takes_no_room_and_groups_are_counted(tmp_path, monkeypatch):
    path = tmp_path / "m.obj"
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    path.write_text(corners + "usemtl a\n" * 100_000 + "f 1 2 3\n")
    assert len(read_mesh(path).faces) == 1
    path.write_text(corners + "usemtl a\nf 1 2 3\n" * 12)
    assert len(read_mesh(path).faces) == 12
    monkeypatch.setitem(budget.BUDGETS, "mesh", Budget(count=10))
    with pytest.raises(InputError, match="shows over 10 nodes"):
        read_mesh(path)


# --- YAML -----------------------------------------------------------------------------------------

FAULTS = {
    "a: [": "",
    "a: !!python/object/apply:os.getcwd []": "could not determine a constructor",
    "a: !!bool foo": "'foo' is no bool",
    'a: !!int ""': "'' is no int",
    'a: !!int "_"': "'_' is no int",
    'a: !!float ""': "'' is no float",
    "a: !!timestamp foo": "'foo' is no timestamp",
    "? !!timestamp foo\n: b": "'foo' is no timestamp",
    "a: 2001-02-30": "'2001-02-30' is no timestamp: day is out of range",
    "a: !!int '1:30'": "'1:30' is no int: not decimal",
    f"a: 0x{'f' * 400}": "is no int: not decimal, or too long",
    "a: !!int [1]": "expected a scalar node",
    'a: "\\U00110000"': "chr",
    "- &a {a: 1, b: 2}\n" + "- {<<: *a}\n" * 6_000: "a table of over 10000 entries",
}


@pytest.mark.parametrize("text", FAULTS)
def test_a_fault_of_a_yaml_is_refused_in_one_line_by_all_that_read_it(text, tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=r"a\.yaml:\d+: not YAML: .*" + FAULTS[text]):
        list(read_settings(path))
    source = tmp_path / "r.xacro"
    source.write_text(HEAD + """<a x="${xacro.load_yaml('a.yaml')}"/>""" + ROOT)
    with pytest.raises(InputError, match=r"r\.xacro:1: load_yaml: .*a\.yaml is not YAML: .*" + FAULTS[text]):
        read_source(source)


def test_aliases_of_tables_do_not_multiply(tmp_path):
    path = tmp_path / "a.yaml"
    names = [f"k{i}" for i in range(200)]
    tables = [
        f"{a}: &{a} {{{', '.join(f'{name}: {value}' for name in names)}}}"
        for a, value in (("a", 1), ("b", "*a"), ("c", "*b"))
    ]
    path.write_text("\n".join([*tables, "d: *c"]))
    with pytest.raises(InputError, match=r"a\.yaml: has over 1,000,000 values, with those of its aliases"):
        list(read_settings(path))
