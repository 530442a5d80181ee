"""The ament package: what ROS says of a node becomes the command line of magtwin, which takes it."""

import ast
from pathlib import Path
from xml.etree import ElementTree

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "ros" / "magtwin_ros"


@pytest.fixture
def arguments(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(PACKAGE)
    from magtwin_ros.nodes import arguments

    return arguments


@pytest.mark.parametrize(
    ("node", "given", "wanted"),
    [
        (
            "magnetometer",
            "lab.usda units:=nT --ros-args -r __ns:=/tb4 -r __node:=m -p use_sim_time:=true",
            "ros magnetometer lab.usda units:=nT --namespace tb4 use_sim_time:=true",
        ),
        (
            "sim",
            "lab.usda --ros-args -r odom:=/wheel/odom -p use_sim_time:=true -p seed:=3",
            "ros sim lab.usda --remap odom:=/wheel/odom --seed 3",
        ),
        (
            "follow",
            "figure8 --ros-args -p use_sim_time:=true -- --laps 2",
            "ros follow figure8 --laps 2 --sim-time",
        ),
    ],
)
def test_what_ros_says_of_a_node_is_a_command_of_magtwin(arguments, node, given, wanted) -> None:
    assert arguments(node, given.split()) == wanted.split()


def test_every_executable_is_a_function_and_a_command(arguments) -> None:
    import magtwin_ros.nodes

    from magtwin.cli.ros import ros_app

    tree = ast.parse((PACKAGE / "setup.py").read_text())
    names = next(ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign))
    assert len(names) == 6
    for name in names:
        assert callable(getattr(magtwin_ros.nodes, name))
        assert ros_app[name].default_command is not None


def test_the_package_names_every_package_whose_messages_are_said() -> None:
    from magtwin.io.messages import TYPES

    root = ElementTree.parse(PACKAGE / "package.xml").getroot()
    depends = {element.text for element in root.findall("exec_depend")}
    assert {kind.partition("/")[0] for kind in TYPES} - {"tf2_msgs"} <= depends
    assert "tf2_msgs" in depends


def test_the_launch_file_starts_the_executables_that_there_are() -> None:
    tree = ast.parse((PACKAGE / "launch" / "magtwin.launch.py").read_text())
    called = [
        keyword.value.value
        for call in ast.walk(tree)
        if isinstance(call, ast.Call)
        for keyword in call.keywords
        if keyword.arg == "executable" and isinstance(keyword.value, ast.Constant)
    ]
    assert called == ["sim", "magnetometer", "follow"]
