"""The simulated robot; robot_localization gives odom to base_link, magtwin's localizer map to odom. Not run.

    ros2 launch magtwin_ros ekf.launch.py scene:=lab.usda path:=figure8

The filter's odometry is /odometry/filtered, and the localizer uses it.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SETTINGS = PathJoinSubstitution([FindPackageShare("magtwin_ros"), "config", "robot_localization.yaml"])


def generate_launch_description() -> LaunchDescription:
    """The arguments and the nodes."""
    value = {name: LaunchConfiguration(name) for name in ("scene", "path", "prior", "settings")}
    words = {name: ParameterValue(argument, value_type=str) for name, argument in value.items()}
    ours = {"package": "magtwin_ros", "namespace": "robot", "output": "screen"}
    return LaunchDescription(
        [
            DeclareLaunchArgument("scene", description="USD stage of the scene"),
            DeclareLaunchArgument("path", default_value="", description="path to follow; empty: no follower"),
            DeclareLaunchArgument("prior", default_value="0,0,0", description="start of the localizer"),
            DeclareLaunchArgument(
                "settings", default_value=SETTINGS, description="parameter file of robot_localization"
            ),
            Node(
                executable="sim",
                parameters=[{"scene": words["scene"], "lidar": "on", "tf": "none"}],
                **ours,
            ),
            Node(
                package="robot_localization",
                executable="ekf_node",
                name="ekf_filter_node",
                output="screen",
                parameters=[value["settings"], {"use_sim_time": True}],
            ),
            Node(
                executable="localize",
                parameters=[{"scene": words["scene"], "prior": words["prior"], "use_sim_time": True}],
                remappings=[("odom", "/odometry/filtered")],
                **ours,
            ),
            Node(
                executable="follow",
                parameters=[{"path": words["path"], "use_sim_time": True}],
                condition=IfCondition(PythonExpression(["'", value["path"], "' != ''"])),
                **ours,
            ),
        ]
    )
