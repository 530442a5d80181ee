"""The simulated robot and slam_toolbox, which publishes /map and the transform from map to odom. Not run.

    ros2 launch magtwin_ros slam.launch.py scene:=lab.usda path:=figure8

Without `path`, drive with teleop_twist_keyboard. The simulator's own map is on /ground_truth/map.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SETTINGS = PathJoinSubstitution([FindPackageShare("magtwin_ros"), "config", "slam_toolbox.yaml"])
SLAM = PathJoinSubstitution([FindPackageShare("slam_toolbox"), "launch", "online_async_launch.py"])


def generate_launch_description() -> LaunchDescription:
    """The arguments and the nodes."""
    value = {name: LaunchConfiguration(name) for name in ("scene", "path", "settings")}
    words = {name: ParameterValue(argument, value_type=str) for name, argument in value.items()}
    ours = {"package": "magtwin_ros", "namespace": "robot", "output": "screen"}
    return LaunchDescription(
        [
            DeclareLaunchArgument("scene", description="USD stage of the scene"),
            DeclareLaunchArgument("path", default_value="", description="path to follow; empty: no follower"),
            DeclareLaunchArgument(
                "settings", default_value=SETTINGS, description="parameter file of slam_toolbox"
            ),
            Node(
                executable="sim",
                parameters=[{"scene": words["scene"], "lidar": "on", "tf": "odom"}],
                remappings=[("/map", "/ground_truth/map")],
                **ours,
            ),
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(SLAM),
                launch_arguments={"use_sim_time": "true", "slam_params_file": value["settings"]}.items(),
            ),
            Node(
                executable="follow",
                parameters=[{"path": words["path"], "use_sim_time": True}],
                condition=IfCondition(PythonExpression(["'", value["path"], "' != ''"])),
                **ours,
            ),
        ]
    )
