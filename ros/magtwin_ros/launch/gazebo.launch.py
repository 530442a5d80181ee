"""Gazebo's topics for magtwin: the bridge, and the magnetometer that Gazebo's robot carries. Not run.

    ros2 launch magtwin_ros gazebo.launch.py scene:=lab.usda

Gazebo runs a world with a robot named `robot`; config/ros_gz_bridge.yaml has the topics.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

CONFIG = PathJoinSubstitution([FindPackageShare("magtwin_ros"), "config"])


def generate_launch_description() -> LaunchDescription:
    """The arguments and the nodes."""
    value = {name: LaunchConfiguration(name) for name in ("scene", "bridge", "settings")}
    words = {name: ParameterValue(argument, value_type=str) for name, argument in value.items()}
    return LaunchDescription(
        [
            DeclareLaunchArgument("scene", description="USD stage of the scene"),
            DeclareLaunchArgument(
                "bridge",
                default_value=PathJoinSubstitution([CONFIG, "ros_gz_bridge.yaml"]),
                description="configuration of ros_gz_bridge",
            ),
            DeclareLaunchArgument(
                "settings",
                default_value=PathJoinSubstitution([CONFIG, "magnetometer.yaml"]),
                description="parameter file of the magnetometer",
            ),
            Node(
                package="ros_gz_bridge",
                executable="parameter_bridge",
                name="ros_gz_bridge",
                output="screen",
                parameters=[{"config_file": words["bridge"], "use_sim_time": True}],
            ),
            Node(
                package="magtwin_ros",
                executable="magnetometer",
                namespace="robot",
                output="screen",
                parameters=[value["settings"], {"scene": words["scene"], "use_sim_time": True}],
            ),
        ]
    )
