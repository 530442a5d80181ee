"""The twin and its magnetometer: `ros2 launch magtwin_ros magtwin.launch.py scene:=lab.usda path:=figure8`.

With `sim:=false` the magnetometer alone, for a real robot; for Isaac Sim with `use_sim_time:=true` too.
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
    """What is launched."""
    value = {
        name: LaunchConfiguration(name)
        for name in ("scene", "namespace", "sim", "use_sim_time", "units", "settings", "path", "speed")
    }
    words = {name: ParameterValue(one, value_type=str) for name, one in value.items()}
    timed = {"use_sim_time": ParameterValue(value["use_sim_time"], value_type=bool)}
    nodes = {"package": "magtwin_ros", "namespace": value["namespace"], "output": "screen"}
    return LaunchDescription(
        [
            DeclareLaunchArgument("scene", description="USD stage of the twin"),
            DeclareLaunchArgument("namespace", default_value="robot", description="where the topics stand"),
            DeclareLaunchArgument("sim", default_value="true", description="whether the robot is simulated"),
            DeclareLaunchArgument(
                "use_sim_time", default_value=value["sim"], description="whether time is /clock's"
            ),
            DeclareLaunchArgument(
                "units", default_value="T", description="unit of fields: T, or nT as APRILab's robot has it"
            ),
            DeclareLaunchArgument(
                "settings", default_value=SETTINGS, description="file of the magnetometer's parameters"
            ),
            DeclareLaunchArgument(
                "path", default_value="", description="path that is driven; none unless given"
            ),
            DeclareLaunchArgument("speed", default_value="0.2", description="forward speed [m/s]"),
            Node(
                executable="sim",
                parameters=[{"scene": words["scene"], "magnetometer": "none"}],
                condition=IfCondition(value["sim"]),
                **nodes,
            ),
            Node(
                executable="magnetometer",
                parameters=[
                    value["settings"],
                    {"scene": words["scene"], "units": words["units"], **timed},
                ],
                **nodes,
            ),
            Node(
                executable="follow",
                parameters=[{"path": words["path"], "speed": words["speed"], **timed}],
                condition=IfCondition(PythonExpression(["'", value["path"], "' != ''"])),
                **nodes,
            ),
        ]
    )
