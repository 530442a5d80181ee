"""The ament package: what ROS says of a node becomes the command line of magtwin, which takes it."""

import ast
import subprocess
import sys
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import pytest
import yaml
from places import ROOT

from magtwin.ros.magnetometer import PARAMETERS

PACKAGE = ROOT / "ros" / "magtwin_ros"
NODES = ("sim", "magnetometer", "localize", "follow", "record", "replay")


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
            "ros magnetometer lab.usda units:=nT use_sim_time:=true --namespace=tb4 --node-name=m",
        ),
        (
            "sim",
            "lab.usda --ros-args -r odom:=/wheel/odom -p use_sim_time:=true -p seed:=3",
            "ros sim lab.usda --seed=3 --remap odom:=/wheel/odom",
        ),
        (
            "follow",
            "figure8 --ros-args -p use_sim_time:=true -- --laps 2",
            "ros follow figure8 --laps 2 --sim-time=true",
        ),
        (
            "magnetometer",
            "--ros-args --log-level warn -p scene:=lab.usda -p duration_s:=5 --disable-stdout-logs odom:=o",
            "ros magnetometer lab.usda --duration-s=5 --remap odom:=o",
        ),
        (
            "localize",
            "lab --ros-args -p method:=ekf -p prior:=global -p use_sim_time:=true -r __ns:=/tb4",
            "ros localize lab --method=ekf prior:=global use_sim_time:=true --namespace=tb4",
        ),
        (
            "follow",
            "figure8 --ros-args -p discovery:=subnet -p domain:= -p laps:=2",
            "ros follow figure8 --discovery=subnet --laps=2",
        ),
        ("replay", "a.mcap --ros-args -p use_sim_time:=true -r x:__ns:=/", "ros replay a.mcap --namespace="),
        (
            "magnetometer",
            "lab.usda --ros-args -p online:=/slam/pose -p measured:=qtfm/magnitude -p map_frame:=world",
            "ros magnetometer lab.usda --online=/slam/pose --measured=qtfm/magnitude map_frame:=world",
        ),
    ],
)
def test_what_ros_says_of_a_node_is_a_command_of_magtwin(arguments, node, given, wanted) -> None:
    assert arguments(node, given.split()) == wanted.split()


def test_parameters_of_a_file_are_read_where_they_are_the_nodes(arguments, tmp_path) -> None:
    sections = {
        "/**": {"ros__parameters": {"rate_hz": 50.0, "lidar": "off"}},
        "/tb4/m": {"ros__parameters": {"use_sim_time": True}},
        "other": {"ros__parameters": {"rate_hz": 1.0}},
    }
    file = tmp_path / "settings.yaml"
    file.write_text(yaml.safe_dump(sections))
    given = f"lab.usda --ros-args -r __ns:=/tb4 -r __node:=m --params-file {file} -p lidar:=on".split()
    wanted = (
        "ros magnetometer lab.usda lidar:=on rate_hz:=50.0 use_sim_time:=true --namespace=tb4 --node-name=m"
    )
    assert arguments("magnetometer", given) == wanted.split()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("--nonsense", "ROS has no argument '--nonsense'"),
        ("-p rate_hz=5", "-p takes name:=value, got 'rate_hz=5'"),
        ("-r", "-r takes a value"),
        ("--params-file no.yaml", "no.yaml: not a parameter file"),
        ("--params-file {plain}", "section 'rate_hz' has no ros__parameters"),
        ("--params-file {broken}", "broken.yaml: not a parameter file"),
    ],
)
def test_an_argument_that_means_nothing_is_refused_in_one_line(arguments, tmp_path, given, said) -> None:
    (tmp_path / "plain.yaml").write_text("rate_hz: 5\n")
    (tmp_path / "broken.yaml").write_text("a: [!!python/object/apply:os.system ['true']\n")
    words = given.format(plain=tmp_path / "plain.yaml", broken=tmp_path / "broken.yaml").split()
    with pytest.raises(ValueError) as refusal:
        arguments("magnetometer", ["--ros-args", *words])
    assert said in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_where_this_python_has_no_magtwin_the_command_on_the_path_is_taken(tmp_path) -> None:
    command = tmp_path / "magtwin"
    command.write_text("#!/bin/sh\necho by $0: $@\n")
    command.chmod(0o755)
    code = "import sys; sys.modules['magtwin'] = None; from magtwin_ros.nodes import sim; sim()"
    run = [sys.executable, "-c", code, "lab.usda", "--ros-args", "-p", "seed:=3"]
    env = {"PATH": f"{tmp_path}:/usr/bin:/bin", "PYTHONPATH": str(PACKAGE)}
    said = subprocess.run(run, env=env, capture_output=True, text=True, check=True).stdout
    assert said == f"by {command}: ros sim lab.usda --seed=3\n"
    without = subprocess.run(run, env=env | {"PATH": "/nowhere"}, capture_output=True, text=True)
    assert without.returncode == 1
    assert without.stderr.startswith("magtwin is neither in this Python nor on the PATH")


def test_every_executable_is_a_function_and_a_command(arguments) -> None:
    import magtwin_ros.nodes

    from magtwin.cli import load
    from magtwin.cli.ros import ros_app

    load("ros")
    assert called("NODES") == NODES == tuple(magtwin_ros.nodes.FIRST)
    for name in NODES:
        assert callable(getattr(magtwin_ros.nodes, name))
        assert ros_app[name].default_command is not None


def called(name: str):
    """The value of a name in setup.py."""
    tree = ast.parse((PACKAGE / "setup.py").read_text())
    return next(
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and node.targets[0].id == name  # type: ignore[attr-defined]
    )


def test_the_package_is_one_of_format_3_and_names_every_package_whose_messages_are_said() -> None:
    from magtwin.io.bags.topics import TOPICS

    root = ElementTree.parse(PACKAGE / "package.xml").getroot()
    assert (root.tag, root.get("format")) == ("package", "3")
    told = [element.tag for element in root]
    assert told[:5] == ["name", "version", "description", "maintainer", "license"]
    assert root.findtext("name") == PACKAGE.name == next((PACKAGE / "resource").iterdir()).name
    assert root.findtext("export/build_type") == "ament_python"
    assert "@" in root.find("maintainer").get("email")  # type: ignore[union-attr, operator]
    depends = {element.text for element in root.findall("exec_depend")}
    assert {kind.partition("/")[0] for topic in TOPICS.values() for kind in (topic.kind, *topic.reads)} - {
        "px4_msgs"  # which bags bring with them
    } | {
        "std_srvs",
        "rclpy",
    } <= depends


def test_the_file_of_settings_holds_what_they_are_unless_given() -> None:
    content = yaml.safe_load((PACKAGE / "config" / "magnetometer.yaml").read_text())
    settings = content["/**"]["ros__parameters"]
    launched = {"units", "use_sim_time"}
    assert settings == {n: p.default for n, p in PARAMETERS.items() if n not in launched}


def stand_in(name: str):
    return lambda *args, **rest: SimpleNamespace(made=name, args=args, **rest)


@pytest.fixture
def describe(monkeypatch: pytest.MonkeyPatch):
    """What a launch file describes, by stand-ins for ROS's classes that keep what they are given."""
    for module, names in {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "IncludeLaunchDescription"],
        "launch.conditions": ["IfCondition"],
        "launch.launch_description_sources": ["PythonLaunchDescriptionSource"],
        "launch.substitutions": ["LaunchConfiguration", "PathJoinSubstitution", "PythonExpression"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "launch_ros.parameter_descriptions": ["ParameterValue"],
        "launch_ros.substitutions": ["FindPackageShare"],
    }.items():
        made = ModuleType(module)
        for name in names:
            setattr(made, name, stand_in(name))
        monkeypatch.setitem(sys.modules, module, made)

    def described(name: str) -> list:
        file = PACKAGE / "launch" / f"{name}.launch.py"
        space: dict = {"__name__": "launch_file"}
        exec(compile(file.read_text(), file, "exec"), space)
        return space["generate_launch_description"]().args[0]

    return described


VALUES = {
    "path": "figure8", "speed": "0.2", "scene": "lab.usda", "units": "T", "use_sim_time": "true",
    "discovery": "", "sim": "true", "prior": "0,0,0", "localizer": "amcl", "map": "",
}  # fmt: skip
OURS = {
    "magtwin": ["sim", "magnetometer", "follow"],
    "slam": ["sim", "follow"],
    "navigation": ["sim", "localize"],
    "ekf": ["sim", "localize", "follow"],
    "gazebo": ["magnetometer"],
    "view": [],
}
"""Launch files, and the nodes of magtwin in each."""


@pytest.mark.parametrize("name", OURS)
def test_the_launch_files_start_commands_that_magtwin_takes(arguments, describe, name: str) -> None:
    import magtwin_ros.nodes

    from magtwin.cli import load
    from magtwin.cli.ros import ros_app

    load("ros")
    launched = describe(name)
    declared = {one.args[0] for one in launched if one.made == "DeclareLaunchArgument"}
    nodes = [one for one in launched if one.made == "Node" and one.package == "magtwin_ros"]
    assert [node.executable for node in nodes] == OURS[name]
    for node in nodes:
        words = ["--ros-args", "-r", "__ns:=/robot"]
        for part in node.parameters:
            if not isinstance(part, dict):
                words += ["--params-file", str(PACKAGE / "config" / "magnetometer.yaml")]
                continue
            for key, value in part.items():
                if isinstance(value, SimpleNamespace):
                    assert value.args[0].args[0] in declared
                    value = value.value_type is bool or VALUES[value.args[0].args[0]]
                words += ["-p", f"{key}:={value}"]
        for theirs, ours in getattr(node, "remappings", ()):
            words += ["-r", f"{theirs}:={ours if isinstance(ours, str) else '/map'}"]
        command, bound, _ = ros_app.parse_args(arguments(node.executable, words)[1:], exit_on_error=False)
        assert command is ros_app[node.executable].default_command
        assert bound.arguments[magtwin_ros.nodes.FIRST[node.executable]]
