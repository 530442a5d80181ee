"""The model of a URDF: every value of every link, joint and material is the one that yourdfpy reads."""

import io
import subprocess
import sys
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from places import DATA

from magtwin.errors import InputError
from magtwin.urdf.description.description import read_description
from magtwin.urdf.description.grammar import check_grammar
from magtwin.urdf.description.model import read_joint

URDF = DATA / "urdf"
FORMS = ("box", "cylinder", "mesh", "sphere")


def readable():
    """Descriptions among the tests' inputs that are not refused, by name."""
    found = {}
    for path in sorted(URDF.glob("*.urdf")):
        try:
            found[path.name] = read_description(path)
        except InputError:
            continue
    return found


def yourdfpys(description):
    """yourdfpy's robot, from the same checked elements; capsules, which it does not know, are cylinders."""
    import yourdfpy

    clean = ElementTree.Element("robot", name=description.name)
    for part in description.xml:
        if part.tag in ("link", "joint", "material"):
            clean.append(check_grammar(part, description.where, lambda kind, text, element: None))
    for capsule in clean.iter("capsule"):
        capsule.tag = "cylinder"
    text = io.BytesIO(ElementTree.tostring(clean))
    return yourdfpy.URDF.load(text, build_scene_graph=False, load_meshes=False).robot


def same(mine, theirs):
    """Numbers, arrays and texts that are equal, to the bit; or records whose fields are."""
    if mine is None or theirs is None:
        assert mine is None
        assert theirs is None
    elif hasattr(mine, "__dataclass_fields__"):
        for name in mine.__dataclass_fields__.keys() - {
            "own_body"
        }:  # `dont_collapse`, which yourdfpy ignores
            same(getattr(mine, name), getattr(theirs, name))
    else:
        kind = float if isinstance(mine, float) else None  # of damping and friction yourdfpy has the text
        assert_array_equal(mine, np.asarray(theirs, kind))


def same_geometry(mine, theirs):
    kind = "cylinder" if mine.kind == "capsule" else mine.kind
    assert [name for name in FORMS if getattr(theirs, name) is not None] == [kind]
    peer = getattr(theirs, kind)
    if kind == "mesh":
        assert mine.filename == peer.filename
        scale = 1.0 if peer.scale is None else peer.scale
        assert_array_equal(np.broadcast_to(mine.size, 3), np.broadcast_to(scale, 3))
    for name in {"size", "radius", "length"} & vars(peer).keys():
        same(getattr(mine, name), getattr(peer, name))


def same_material(mine, theirs):
    if theirs is None:
        assert mine is None
        return
    assert mine.name == theirs.name
    same(mine.rgba, None if theirs.color is None else theirs.color.rgba)
    same(mine.texture, None if theirs.texture is None else theirs.texture.filename)


def is_empty(geometry):
    return geometry.box is not None and 0 in geometry.box.size


def same_shapes(mine, theirs):
    theirs = [shape for shape in theirs if not is_empty(shape.geometry)]
    for shape, peer in zip(mine, theirs, strict=True):
        same_geometry(shape.geometry, peer.geometry)
        assert shape.name == peer.name
        same(shape.origin, peer.origin)
        same_material(shape.material, getattr(peer, "material", None))
    return len(mine)


def compare(description):
    """Hold a description against yourdfpy's; how many links, shapes and joints there were."""
    peer, shapes = yourdfpys(description), 0
    for theirs in peer.links:
        mine = description.links[theirs.name]
        same(mine.inertial, theirs.inertial)
        shapes += same_shapes(mine.visuals, theirs.visuals) + same_shapes(mine.collisions, theirs.collisions)
    for theirs in peer.joints:
        same(description.joints[theirs.child], theirs)
    for theirs in peer.materials:
        same_material(description.materials[theirs.name], theirs)
    assert len(description.links) == len(peer.links)
    assert len(description.joints) == len(peer.joints)
    return len(peer.links), shapes, len(peer.joints)


def test_every_input_of_the_tests_is_read_as_yourdfpy_reads_it():
    counts = np.sum([compare(description) for description in readable().values()], axis=0)
    assert counts.tolist() == [18, 9, 6]


@pytest.mark.parametrize(
    "name",
    [
        "turtlebot4.urdf",
        "turtlebot4_gazebo_tags.urdf",
        "xacro/turtlebot4_description/urdf/standard/turtlebot4.urdf.xacro",
    ],
)
def test_every_description_of_the_real_robot_is_read_as_yourdfpy_reads_it(real_data, name):
    assert compare(read_description(real_data / "turtlebot4" / name)) == (49, 31, 48)


@settings(max_examples=50, deadline=None)
@given(
    xyz=st.lists(st.floats(-1e3, 1e3), min_size=3, max_size=3),
    rpy=st.lists(st.floats(-10, 10), min_size=3, max_size=3),
)
def test_poses_are_yourdfpys_to_the_last_bit(xyz, rpy):
    import yourdfpy

    words = {key: " ".join(map(repr, values)) for key, values in (("xyz", xyz), ("rpy", rpy))}
    joint = ElementTree.Element("joint", name="j", type="fixed")
    ElementTree.SubElement(joint, "parent", link="a")
    ElementTree.SubElement(joint, "child", link="b")
    origin = ElementTree.SubElement(joint, "origin", words)
    peer = yourdfpy.URDF._parse_origin(origin)
    assert_array_equal(read_joint(joint).origin, peer)


def test_a_conversion_without_hulls_imports_neither_yourdfpy_nor_what_it_brings(tmp_path):
    script = (
        "import sys; from magtwin.urdf.convert import convert_urdf\n"
        f"convert_urdf({str(URDF / 'input_joints.urdf')!r}, {str(tmp_path / 'j.usda')!r})\n"
        "print(*{'lxml', 'networkx', 'scipy', 'trimesh', 'yaml', 'yourdfpy'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
