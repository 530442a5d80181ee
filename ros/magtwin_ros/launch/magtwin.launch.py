"""The simulated robot, its magnetometer and a path follower.

    ros2 launch magtwin_ros magtwin.launch.py scene:=lab.usda path:=figure8

`sim:=false` launches the magnetometer without the simulator, for a real robot on the network. For Isaac Sim,
add `use_sim_time:=true`. Without `path` there is no follower.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SETTINGS = PathJoinSubstitution([FindPackageShare("magtwin_ros"), "config", "magnetometer.yaml"])


def generate_launch_description() -> LaunchDescription:
    """The arguments and the nodes."""
    value = {
        name: LaunchConfiguration(name)
        for name in (
            "scene",
            "namespace",
            "sim",
            "use_sim_time",
            "units",
            "settings",
            "path",
            "speed",
            "discovery",
        )
    }
    words = {name: ParameterValue(argument, value_type=str) for name, argument in value.items()}
    timed = {"use_sim_time": ParameterValue(value["use_sim_time"], value_type=bool)}
    found = {"discovery": words["discovery"]}
    nodes = {"package": "magtwin_ros", "namespace": value["namespace"], "output": "screen"}
    return LaunchDescription(
        [
            DeclareLaunchArgument("scene", description="USD stage of the scene"),
            DeclareLaunchArgument("namespace", default_value="robot", description="namespace of the topics"),
            DeclareLaunchArgument("sim", default_value="true", description="simulate the robot"),
            DeclareLaunchArgument(
                "use_sim_time",
                default_value=value["sim"],
                description="use the time of /clock; default: as sim",
            ),
            DeclareLaunchArgument(
                "units", default_value="T", description="unit of fields: T, or nT as on APRILab's robot"
            ),
            DeclareLaunchArgument(
                "settings", default_value=SETTINGS, description="parameter file of the magnetometer"
            ),
            DeclareLaunchArgument(
                "discovery",
                default_value=PythonExpression(["'' if '", value["sim"], "' == 'true' else 'subnet'"]),
                description="which machines find the nodes: localhost, subnet; empty: by the environment",
            ),
            DeclareLaunchArgument("path", default_value="", description="path to follow; empty: no follower"),
            DeclareLaunchArgument("speed", default_value="0.2", description="forward speed [m/s]"),
            Node(
                executable="sim",
                parameters=[{"scene": words["scene"], "magnetometer": "none", **found}],
                condition=IfCondition(value["sim"]),
                **nodes,
            ),
            Node(
                executable="magnetometer",
                parameters=[
                    value["settings"],
                    {"scene": words["scene"], "units": words["units"], **timed, **found},
                ],
                **nodes,
            ),
            Node(
                executable="follow",
                parameters=[{"path": words["path"], "speed": words["speed"], **timed, **found}],
                condition=IfCondition(PythonExpression(["'", value["path"], "' != ''"])),
                **nodes,
            ),
        ]
    )
