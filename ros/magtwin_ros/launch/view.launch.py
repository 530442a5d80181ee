"""RViz with the field along the path, the maps, the robot and the estimate. Not run.

    ros2 launch magtwin_ros view.launch.py

For Foxglove, import config/foxglove.json as a layout and connect by foxglove_bridge, or open a recorded bag.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

LAYOUT = PathJoinSubstitution([FindPackageShare("magtwin_ros"), "config", "magtwin.rviz"])


def generate_launch_description() -> LaunchDescription:
    """The arguments and the node."""
    timed = {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)}
    return LaunchDescription(
        [
            DeclareLaunchArgument("use_sim_time", default_value="true", description="use the time of /clock"),
            DeclareLaunchArgument("layout", default_value=LAYOUT, description="RViz configuration"),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", LaunchConfiguration("layout")],
                parameters=[timed],
                output="screen",
            ),
        ]
    )
