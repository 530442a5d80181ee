"""The twin and its magnetometer: `ros2 launch magtwin_ros magtwin.launch.py scene:=lab.usda path:=figure8`.

With `sim:=false` the magnetometer alone, for a real robot or Isaac Sim.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PythonExpression
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """What is launched."""
    said = {
        "scene": ("", "USD stage of the twin"),
        "namespace": ("robot", "namespace of the topics"),
        "sim": ("true", "whether the robot is simulated"),
        "units": ("T", "unit of fields: T, or nT as APRILab's robot has it"),
        "path": ("", "path that is driven; none unless given"),
        "speed": ("0.2", "forward speed [m/s]"),
    }
    value = {name: LaunchConfiguration(name) for name in said}
    space = ["--namespace", value["namespace"]]
    simulated = IfCondition(value["sim"])
    driven = IfCondition(PythonExpression(["'", value["path"], "' != ''"]))
    sim_time = PythonExpression(
        ["'use_sim_time:=true' if '", value["sim"], "' == 'true' else 'use_sim_time:=false'"]
    )
    follow_time = PythonExpression(["'--sim-time' if '", value["sim"], "' == 'true' else '--no-sim-time'"])
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in said.items()
            ),
            Node(
                package="magtwin_ros",
                executable="sim",
                arguments=[value["scene"], "--no-magnetometer", *space],
                condition=simulated,
                output="screen",
            ),
            Node(
                package="magtwin_ros",
                executable="magnetometer",
                arguments=[value["scene"], ["units:=", value["units"]], sim_time, *space],
                output="screen",
            ),
            Node(
                package="magtwin_ros",
                executable="follow",
                arguments=[value["path"], "--speed", value["speed"], follow_time, *space],
                condition=driven,
                output="screen",
            ),
        ]
    )
