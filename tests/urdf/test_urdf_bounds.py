"""Descriptions whose counts would take time with their square, or memory beyond their budget."""

import pytest

from magtwin import budget
from magtwin.budget import Budget
from magtwin.errors import InputError
from magtwin.urdf.description.description import read_description
from magtwin.urdf.physics.mechanism import read_mechanism
from magtwin.urdf.physics.merge import place_links, riders


def robot(tmp_path, *parts):
    path = tmp_path / "robot.urdf"
    path.write_text("\n".join(['<robot name="r">', *parts, "</robot>"]))
    return path


def link(name, content=""):
    return f'<link name="{name}">{content}</link>'


def joint(name, parent, child, kind="fixed", content=""):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{content}</joint>'


def test_a_robot_of_too_many_links_or_joints_is_refused_at_once(tmp_path, monkeypatch):
    monkeypatch.setitem(budget.BUDGETS, "URDF", Budget(count=3))
    links = [link(f"l{i}") for i in range(3)]
    joints = [joint(f"j{i}", "l0", f"l{i + 1}") for i in range(2)]
    assert len(read_description(robot(tmp_path, *links, *joints)).links) == 3
    with pytest.raises(InputError, match=r"robot\.urdf:1: over 3 links; split the file"):
        read_description(robot(tmp_path, *links, link("x")))
    with pytest.raises(InputError, match=r"robot\.urdf:1: over 3 joints; split the file"):
        read_description(robot(tmp_path, *links, *joints, *joints))


def test_joints_of_one_name_are_numbered_in_their_order(tmp_path):
    links = [link(f"l{i}") for i in range(6)]
    joints = [joint("j", "l0", f"l{i + 1}") for i in range(4)]
    path = robot(tmp_path, *links, joints[0], *joints, joint("j_3", "l0", "l5"))
    description = read_description(path)
    assert [j.name for j in description.joints.values()] == ["j", "j_2", "j_4", "j_5", "j_3"]
    assert [entry.text.rpartition(": ")[2] for entry in description.repairs.entries] == [
        "the second is equal and left out",
        *(f"the second is called 'j_{n}'" for n in (2, 4, 5)),
    ]


def test_links_of_one_name_follow_the_joints_that_hold_them(tmp_path):
    links = [link("l0"), link("l"), link("l", "<visual/>"), link("l", "<collision/>")]
    description = read_description(robot(tmp_path, *links, *(joint(f"j{i}", "l0", "l") for i in range(3))))
    assert {j.name: child for child, j in description.joints.items()} == {"j0": "l", "j1": "l_2", "j2": "l_3"}


def test_a_chain_of_frames_rides_on_the_first_body(tmp_path):
    mass = '<inertial><mass value="1"/></inertial>'
    links = [link(f"l{i}") for i in range(100)]
    chain = [joint(f"j{i}", f"l{i}", f"l{i + 1}") for i in range(99)]
    body = [
        link("body", mass),
        joint("k", "l98", "body"),
        link("arm", mass),
        joint("m", "body", "arm", "floating"),
    ]
    path = robot(tmp_path, *links, *chain, *body)
    groups = riders(place_links(read_mechanism(read_description(path))))
    assert list(groups) == ["body", "arm"]
    assert [name for name, _ in groups["body"]] == ["body", *(f"l{i}" for i in range(99)), "l99"]
