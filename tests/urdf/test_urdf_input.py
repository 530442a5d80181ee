from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from places import DATA

from magtwin.errors import InputError
from magtwin.urdf.convert import convert_urdf
from magtwin.urdf.description.description import read_description
from magtwin.urdf.source.expression import GLOBALS, Budget, ExpressionError, evaluate
from magtwin.urdf.source.package import MissingFileError
from magtwin.urdf.source.source import read_source

URDF = DATA / "urdf"
XACRO = '<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">\n{}\n</robot>\n'

REFUSED = {
    "link_without_name.urdf": r":2: a <link> has no name",
    "no_link.urdf": r":1: the robot has no <link>",
    "two_roots.urdf": r":3: link 'hand' is not connected: a robot has one root, this has base_link, hand",
    "circle_without_root.urdf": r":4: joint 'j' closes a circle: no link is the root; remove one joint",
    "circle_beside_root.urdf": r":5: joint 'j' closes a circle; remove one joint of it",
    "held_twice.urdf": r":8: joint 'k' holds 'hand', which 'j' holds already",
    "joint_type.urdf": r":4: joint 'j' is of type 'ball'; known: fixed, revolute, continuous, prismatic, pl",
    "zero_axis.urdf": r":4: joint 'j' moves about an axis of length 0",
    "child_not_there.urdf": r":4: joint 'j' names no link 'hnad'; did you mean 'hand'\?",
    "joint_without_child.urdf": r":3: joint 'j' has no <child link=>",
    "mesh_missing.urdf": r":4: mesh 'input_meshes/tetrahedro\.stl' is missing \(did you mean 'tetra",
    "mesh_climbs.urdf": r":4: mesh '\.\./\.\./\.\./\.\./secret\.stl' lies outside .*; files are",
    "mesh_absolute.urdf": r":4: mesh 'file:///etc/passwd\.stl' lies outside .*; files are",
    "mesh_climbs_out_of_package.urdf": r":4: mesh 'package:.*' lies outside .*/arm_description;",
    "mesh_scheme.urdf": r":4: mesh 'http:.*' has scheme 'http'; known: file, model, package",
    "package_not_there.urdf": r":4: mesh .* no package 'arm_descripton' .*; did you mean 'arm_description'\?",
    "no_number.urdf": r":7: joint 'j': xyz of <origin> must be 3 finite numbers, got '0 0 O'",
    "not_a_number.urdf": r":7: joint 'j': rpy of <origin> must be 3 finite numbers, got '0 nan 0'",
    "two_numbers_of_three.urdf": r":7: joint 'j': xyz of <origin> must be 3 finite numbers, got '0 1'",
    "broken.urdf": r":3: not XML: mismatched tag \(column 4\)",
    "entity_bomb.urdf": r":2: has a DOCTYPE, whose entities are not followed; remove it",
    "outer_entity.urdf": r":1: has a DOCTYPE, whose entities are not followed; remove it",
    "not_utf8.urdf": r":2: not XML: byte 0xe9 is not UTF-8; save the file as UTF-8, or declare its encoding",
    "unknown_encoding.urdf": r":1: not XML: unknown encoding: klingon; save the file as UTF-8",
    "sdf.urdf": r":1: a URDF begins with <robot>, this file with <sdf>",
    "empty.urdf": r":1: not XML: no element found",
    "too_deep.urdf": r":3: nests deeper than 200 elements",
    "eval_opens_a_file.xacro": r":3: no property 'open'",
    "class_in_a_comprehension.xacro": r":2: attribute '__class__' of type int is not allowed",
    "globals_in_a_lambda.xacro": r":2: attribute '__globals__' of type method is not allowed",
    "frame_of_a_generator.xacro": r":2: attribute 'gi_frame' of type list is not allowed",
    "format_of_a_text.xacro": r":2: method 'format' of type str is not allowed; allowed: capitalize",
    "include_climbs.xacro": r":2: include '.*etc/passwd' lies outside .* and of all packages; name its",
    "include_pattern_climbs.xacro": r":2: include '.*' has a wildcard",
    "include_not_there.xacro": r"missing: include 'input_not_there\.xacro' \(.*\.xacro:2\); put",
    "include_of_itself.xacro": r":2: expands without end: a macro or an include leads to itself",
    "include_with_entities.xacro": r"input_refused_entity_bomb\.urdf:2: has a DOCTYPE",
    "yaml_climbs.xacro": r":3: load_yaml '/etc/hostname' lies outside",
    "yaml_of_objects.xacro": r":3: load_yaml: .*input_objects\.yaml is not YAML: could not determine a co",
    "environment.xacro": r"missing: environment variable 'HOME', which is .* \(.*:2\); give --arg HOME=VALUE",
    "property_not_there.xacro": r":3: no property 'raduis'; did you mean 'radius'\? \(in expression",
    "macro_not_there.xacro": r":2: unknown macro name: xacro:wheel",
    "macro_of_itself.xacro": r":3: expands without end: a macro or an include leads to itself",
    "text_that_doubles.xacro": r":11: a value of over 65536 characters or entries",
    "list_that_doubles.xacro": r":11: a value of over 65536 characters or entries",
    "power.xacro": r":2: an integer of over 4096 bits \(in expression '9\*\*9\*\*9'\)",
    "argument_not_given.xacro": r"missing: argument 'prefix' \(input.*\.xacro:2\); give --arg prefix=VALUE",
    "no_expression.xacro": r":2: not an expression: '1 \+'",
    "not_closed.xacro": r":2: not closed: '\$\{1'",
    "find_not_there.xacro": r"missing: include .* \(did you mean 'arm_description'\?\) \(.*:2\); give --pack",
    "number_from_macro.xacro": r":4: link 'base_link': radius of <sphere> must be a finite number, got 'big'",
}
"""What is said of each file `input_refused_*`."""


def read(path, **options):
    """A description, with every file that it names looked for."""
    description = read_description(read_source(path, **options))
    for mesh in description.xml.iter("mesh"):
        description.find_file(mesh.get("filename"), "mesh")
    return description


def write_xacro(tmp_path, body, name="arm.xacro"):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(XACRO.format(body))
    return path


# --- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", REFUSED)
def test_a_bad_input_is_refused_in_one_line_with_file_and_line(name):
    path = URDF / f"input_refused_{name}"
    with pytest.raises(InputError, match=REFUSED[name]) as refusal:
        read(path)
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).startswith(str(URDF))


def test_every_bad_input_has_its_message():
    assert {f"input_refused_{name}" for name in REFUSED} == {p.name for p in URDF.glob("input_refused_*")}


def test_arguments_that_nobody_asks_for_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"arm\.xacro: no xacro argument 'prefx'; did you mean 'prefix'\?"):
        read_source(write_xacro(tmp_path, '<xacro:arg name="prefix" default=""/>'), arguments={"prefx": "a"})
    with pytest.raises(InputError, match="is not a xacro and takes no arguments; leave out prefix"):
        read_source(URDF / "input_capsule.urdf", arguments={"prefix": "a"})


# --- what a hostile xacro tries -------------------------------------------------------------------

SYSTEM = "__import__('os').system('touch {}')"
TRICKS = [
    "${{{system}}}",
    "${{[{system} for x in [1]]}}",
    "${{(lambda: {system})()}}",
    "${{[c for c in ().__class__.__base__.__subclasses__()]}}",
    "${{list(map(lambda f: f.__globals__, [xacro.load_yaml]))}}",
    "${{xacro.load_yaml.__globals__}}",
    "${{xacro['load_yaml'].__globals__}}",
    "${{python.type(1).mro()}}",
    "${{python.vars(xacro)}}",
    "${{str.format('{{0.__class__}}', 1)}}",
    "${{'%s'.__mod__(1)}}",
    "${{math.__loader__}}",
    "${{(x for x in [1]).gi_frame.f_back.f_globals}}",
    "${{exec('1')}}",
    "${{eval('1')}}",
    "${{open('{canary}', 'w')}}",
    "$(eval ${{code}})",
    "$(eval __builtins__)",
    "$(eval env.__globals__)",
]


@pytest.mark.parametrize("trick", TRICKS)
def test_a_xacro_runs_no_code(tmp_path, trick):
    canary = tmp_path / "canary"
    system = SYSTEM.format(canary)
    text = trick.format(system=system, canary=canary)
    path = write_xacro(tmp_path, f'<xacro:property name="code" value="{system}"/><link name="{text}"/>')
    with pytest.raises(InputError):
        read_source(path)
    assert not canary.exists()


GREEDY = ["9**9**9", "'a'*10**9", "[0]*10**9", "range(10**9)", "python.round(1, -10**9)", "'%999999999d' % 1"]
GREEDY += [
    "'%(a)999999999d' % {'a': 1}",
    "'%*d' % (10**9, 1)",
    "'x'.join(['y'*60000]*60000)",
    "-" * 3000 + "1",
]
GREEDY += ["('a'*60000).replace('a', 'b'*60000)", "[[x for x in range(60000)] for y in range(60000)]"]
GREEDY += ["(lambda f: f(f))(lambda f: f(f))", "python.sum([[1]]*60000, [])", "1 << 10**9"]


@pytest.mark.parametrize("text", GREEDY)
def test_an_expression_cannot_take_time_or_memory_without_bound(text):
    with pytest.raises((ExpressionError, RecursionError)):
        evaluate(text, GLOBALS, Budget(100_000))


COSTLY = {
    "[l.count(-1) for l in [list(range(9000))] for i in range(100)]": "expands without end",
    "[-1 in l for l in [list(range(9000))] for i in range(100)]": "expands without end",
    "[l == l for l in [list(range(9000))] for i in range(100)]": "expands without end",
    "[s - s for s in [set(range(9000))] for i in range(100)]": "expands without end",
    "[l[1:] for l in [list(range(9000))] for i in range(100)]": "expands without end",
    "[python.sum(values=l) for l in [list(range(9000))] for i in range(100)]": "expands without end",
    "[1 for i in range(300) for j in range(300)]": "over 65536 characters or entries",
    "('%(' + ')' * 20000) % 1": "format requires a mapping",
    "'%(a(b)c)999d' % {'a(b)c': 1}": "over two digits",
    "'%(a)s' * 100 % dict(a='\U0001f600' * 2000)": "over 65536 characters or entries",
    "'%(a)s%s' * 100 % dict(a='', b='x' * 2000)": "over 65536 characters or entries",
}


@pytest.mark.parametrize("text", COSTLY)
def test_an_expression_pays_for_what_it_looks_at_and_copies(text):
    with pytest.raises(ExpressionError, match=COSTLY[text]):
        evaluate(text, GLOBALS, Budget(600_000))


SLIPS = {
    "<xacro:property/>": "cannot be expanded: xacro:property: missing attribute 'name'",
    '<xacro:property name="p" value="1" scope="parent"/>': "cannot be expanded: ",
    '<xacro:element xacro:name=""/>': "xacro:element: empty name",
    '<xacro:if value="maybe"><a/></xacro:if>': 'conditional "maybe" evaluated to "maybe", which is not a boo',
    '<xacro:macro name="m" params="a"/><xacro:m/>': r"Undefined parameters \[a\]",
    '<xacro:macro name="m" params="*b"/><xacro:m/>': "Not enough blocks",
    '<xacro:insert_block name="x"/>': 'Undefined block "x"',
    '<xacro:property name="a" value="${b}"/><xacro:property name="b" value="${a}"/><l x="${a}"/>': "circ",
    '<l x="${1 / 0}"/>': r"ZeroDivisionError: division by zero \(in expression '1 / 0'\)",
    '<l x="${xacro.fatal(1, 2)}"/>': "1 2",
    """<l x="${xacro.load_yaml('merges.yaml')}"/>""": "is not YAML: a table of over 10000 entries",
    """<l x="${xacro.load_yaml('deep.yaml')}"/>""": "deep.yaml nests too deep",
    "<a x=\"${xacro.tokenize('a b', '')}\"/>": "tokenize: sep is empty",
    r"""<a x="${'\ud800'}"/>""": "half of a character",
    """<a x="${'%c' % 0xdfff}"/>""": "half of a character",
    '<xacro:include filename="*/../../*/*.none"/>': "has a wildcard; name each file",
    """<xacro:macro name="m" params="a:=bbbbbbbbbbbbbbbbbbbbbbbbbbbbb'"/><xacro:m/>""": "Undefined par",
    '<l x="${xacro}"/>': "a .* is not a value",
    '<l x="$(cwd)"/>': r"\$\(cwd\) is not known; known: arg, dirname, env, eval, find, optenv",
}


@pytest.mark.parametrize("slip", SLIPS)
def test_a_mistake_in_a_xacro_is_refused_with_its_line(tmp_path, slip):
    lines = (f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}" for i in range(1, 60))
    (tmp_path / "merges.yaml").write_text("\n".join(["a0: &a0 {a: 1, b: 2}", *lines]))
    (tmp_path / "deep.yaml").write_text("[" * 5000)
    with pytest.raises(InputError, match=r"arm\.xacro:2: .*" + SLIPS[slip]):
        read_source(write_xacro(tmp_path, slip))


def test_a_xacro_does_not_read_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("ARM_MODE", "secret")
    path = write_xacro(tmp_path, '<link name="$(optenv ARM_MODE quiet)"/>')
    source = read_source(path)
    assert source.xml.find("link").get("name") == "quiet"
    assert source.repairs.notes == (
        "arm.xacro:2: environment variable ARM_MODE is not read, 'quiet' is taken; give --arg ARM_MODE=VALUE",
    )
    given = read_source(path, arguments={"ARM_MODE": "loud"})
    assert given.xml.find("link").get("name") == "loud"
    assert given.repairs.notes == ()


# --- the language of expressions ------------------------------------------------------------------

numbers = st.integers(-99, 99) | st.floats(-9, 9, allow_nan=False)
atoms = numbers.map(lambda n: f"({n!r})")


def grown(inner):
    binary = st.tuples(inner, st.sampled_from(["+", "-", "*", "<", "<=", "==", "!=", "and", "or"]), inner)
    return binary.map(lambda t: f"({t[0]} {t[1]} {t[2]})") | st.tuples(inner, inner, inner).map(
        lambda t: f"({t[0]} if {t[1]} else -{t[2]})"
    )


@given(st.recursive(atoms, grown, max_leaves=12))
def test_arithmetic_is_pythons(text):
    assert evaluate(text, {}, Budget(10_000)) == eval(text, {})


VALUES = {
    "2 * half ** 2": 0.5,
    "7 // 2 % 2": 1,
    "sin(pi / 6) + math.cos(0)": 1.5,
    "radians(180) / pi": 1.0,
    "[2 * i for i in range(4) if i != 1]": [0, 4, 6],
    "[(a, b) for a in 'xy' for b in [1, 2]]": [("x", 1), ("x", 2), ("y", 1), ("y", 2)],
    "{k: v for k, v in sorted(wheel.items())}": {"radius": 0.1, "sides": ["left", "right"]},
    "wheel.radius * wheel['sides'].index('right')": 0.1,
    "'%s_%02d' % (name, 3)": "arm_03",
    "name.upper() + name[1:] + name[-1]": "ARMrmm",
    "','.join(list(map(str, [1, 2])))": "1,2",
    "(lambda a, b: a - b)(3, 1)": 2,
    "not 1 < 2 < 3": False,
    "max([1, 3], key=lambda x: -x)": 1,
    "python.sum(python.enumerate([5, 7])[1])": 8,
    "set([3, 1, 3, 2]) - set([1])": [3, 2],
    "name in ['arm'] and None is None": True,
}


@pytest.mark.parametrize("text", VALUES)
def test_the_language_has(text):
    names = {**GLOBALS, "half": 0.5, "name": "arm", "wheel": {"radius": 0.1, "sides": ["left", "right"]}}
    value = evaluate(text, names, Budget(10_000))
    assert value == (pytest.approx(VALUES[text]) if isinstance(VALUES[text], float) else VALUES[text])


# --- what arrives ---------------------------------------------------------------------------------


def test_xacro_has_arguments_properties_macros_blocks_conditions_includes_and_yaml():
    description = read(URDF / "input_xacro_language.xacro", arguments={"reach": "3"})
    assert list(description.links) == ["left_base", "hand"]
    base, joint = description.links["left_base"], description.joints["hand"]
    assert base.inertial.mass == 3.0625
    assert_allclose(base.inertial.origin[:3, 3], [0.2, -0.2, 0.5])
    assert_allclose(base.visuals[0].geometry.size, [2, 4, 6])
    assert (joint.limit.velocity, joint.limit.upper) == (6, 1.5)
    assert_allclose(joint.limit.lower, -np.pi / 2)
    assert description.xml.find("gazebo/note").text == "${kept} quiet"
    hand = description.xml.findall("link")[1]
    assert description.where(hand) == f"{URDF}/input_packages/arm_description/urdf/hand.xacro:3"


@pytest.mark.parametrize("name", ["latin1", "byte_order_mark", "namespaces"])
def test_declared_encodings_and_namespaces_are_read(name):
    description = read(URDF / f"input_{name}.urdf")
    assert list(description.links) == ["caméra" if name == "latin1" else "base_link"]
    assert not description.repairs.entries


# --- packages -------------------------------------------------------------------------------------


def package(folder, name):
    folder.mkdir(parents=True)
    (folder / "package.xml").write_text(f"<package><name>{name}</name></package>")
    (folder / "meshes").mkdir()
    (folder / "meshes" / "a.stl").write_text(name)
    return folder


def robot(folder, filename="package://hand/meshes/a.stl"):
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "arm.urdf"
    mesh = f'<visual><geometry><mesh filename="{filename}"/></geometry></visual>'
    path.write_text(f'<robot name="arm"><link name="base_link">{mesh}</link></robot>')
    return path


def found(path, filename="package://hand/meshes/a.stl", **packages):
    return read_source(path, packages=packages).find_file(filename, "mesh")


def test_given_packages_win_over_those_above_and_those_beside(tmp_path):
    path = robot(package(tmp_path / "src" / "arms" / "arm", "arm") / "urdf")
    beside = package(tmp_path / "src" / "arms" / "stack" / "hand_folder", "hand")
    assert found(path) == beside / "meshes" / "a.stl"
    assert found(path, "model://hand/meshes/a.stl") == beside / "meshes" / "a.stl"
    given = package(tmp_path / "elsewhere" / "hand", "hand")
    assert found(path, hand=given) == given / "meshes" / "a.stl"
    (path.parents[1] / "package.xml").write_text("<package><name>hand</name></package>")
    assert found(path) == path.parents[1] / "meshes" / "a.stl"


def test_a_description_does_not_choose_any_folder_around_it_as_its_package(tmp_path):
    path = robot(tmp_path / "homes" / "me" / "downloads" / "arm")
    (tmp_path / "homes" / "me" / "private").mkdir()
    (tmp_path / "meshes").mkdir()  # too far above
    (path.parent / "link").symlink_to(tmp_path)
    for name in ("private", "me", "homes", "link", tmp_path.name, path.resolve().parts[1], "x" * 300):
        with pytest.raises(InputError, match=r"no package '.*' around it; give --package"):
            found(path, f"package://{name}/a.stl")


@pytest.mark.parametrize("name", ["a" * 300 + ".stl", "loop/a.stl"])
def test_a_file_that_cannot_be_looked_for_is_refused(tmp_path, name):
    path = robot(tmp_path, name)
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(InputError, match=r":1: mesh '.*' cannot be looked for \(.*\)"):
        convert_urdf(path, tmp_path / "arm.usda")


def test_relative_paths_reach_to_the_package_and_no_further(tmp_path):
    path = robot(package(tmp_path / "arm", "arm") / "urdf")
    assert found(path, "../meshes/a.stl") == tmp_path / "arm" / "meshes" / "a.stl"
    other = package(tmp_path / "other" / "deep" / "deeper" / "deepest" / "hand", "hand")
    with pytest.raises(InputError, match=r"lies outside .*/arm; files are read from there only"):
        found(path, "../../other/deep/deeper/deepest/hand/meshes/a.stl")
    assert found(path, str(other / "meshes" / "a.stl"), hand=other) == other / "meshes" / "a.stl"


def test_the_search_for_packages_is_bounded_and_ignores_what_is_hidden_or_broken(tmp_path, monkeypatch):
    path = robot(tmp_path)
    package(tmp_path / ".hidden", "hand")
    package(tmp_path / "1" / "2" / "3" / "4", "hand")
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken" / "package.xml").write_text("<!DOCTYPE x [<!ENTITY a 'hand'>]><package>&a;")
    with pytest.raises(InputError, match="no package 'hand' around it; give --package hand=FOLDER"):
        found(path)
    monkeypatch.setattr("magtwin.urdf.source.package.FOLDERS", 2)
    with pytest.raises(InputError, match=r"around it \(the search ended after 2 folders\); give"):
        found(path)


# --- the real robot -------------------------------------------------------------------------------

REAL_INPUTS = {
    "turtlebot4.urdf": set(),
    "turtlebot4_gazebo_tags.urdf": {"shell.dae", "oakd_pro.dae"},
    "xacro/turtlebot4_description/urdf/standard/turtlebot4.urdf.xacro": {"shell.dae", "oakd_pro.dae"},
}


@pytest.mark.parametrize("name", REAL_INPUTS)
def test_the_real_robot_is_read_in_every_form_without_the_meshes_that_upstream_lacks(real_data, name):
    source = read_source(real_data / "turtlebot4" / name)
    description = read_description(source)
    assert (len(description.links), len(description.joints)) == (49, 48)
    masses = [link.inertial.mass for link in description.links.values() if link.inertial]
    assert_allclose(sum(masses), 5.39, atol=1e-9)
    missing = set()
    for mesh in description.xml.iter("mesh"):
        try:
            assert description.find_file(mesh.get("filename"), "mesh").is_file()
        except MissingFileError:
            missing.add(mesh.get("filename").rpartition("/")[2])
    assert missing == REAL_INPUTS[name]


def same(ours, theirs):
    """Whether two trees have the same elements, attributes and texts."""
    texts = [(e.text or "").strip() for e in (ours, theirs)]
    return (
        (ours.tag, dict(ours.items()), texts[0]) == (theirs.tag, dict(theirs.items()), texts[1])
        and len(ours) == len(theirs)
        and all(same(a, b) for a, b in zip(ours, theirs, strict=True))
    )


@pytest.mark.parametrize("kind", ["standard", "lite"])
def test_the_real_xacro_expands_as_the_library_alone_expands_it(real_data, kind, monkeypatch):

    import xacro
    from xacro import substitution_args

    path = real_data / "turtlebot4" / "xacro" / "turtlebot4_description" / "urdf" / kind
    path = path / "turtlebot4.urdf.xacro"
    ours = read_source(path)
    monkeypatch.setattr(substitution_args, "_eval_find", lambda name: str(ours.packages.find(name)))
    peer = xacro.process_file(str(path), verbosity=0, mappings={}).toxml()
    assert same(ours.xml, ElementTree.fromstring(peer))
