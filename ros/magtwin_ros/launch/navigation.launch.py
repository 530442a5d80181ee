"""nav2 with AMCL or magtwin's localizer, beside the simulated robot or a real one. Not run.

    ros2 launch magtwin_ros navigation.launch.py scene:=lab.usda
    ros2 launch magtwin_ros navigation.launch.py scene:=lab.usda localizer:=magtwin
    ros2 launch magtwin_ros navigation.launch.py scene:=lab.usda sim:=false map:=map.yaml

AMCL localizes by the LiDAR, magtwin's localizer by the magnetic map. Goals come from RViz ("2D Goal Pose")
or the action navigate_to_pose. The simulator publishes /map; `map` names a file of `magtwin map occupancy`
instead.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

SETTINGS = PathJoinSubstitution([FindPackageShare("magtwin_ros"), "config", "nav2.yaml"])


def generate_launch_description() -> LaunchDescription:
    """The arguments and the nodes."""
    value = {
        name: LaunchConfiguration(name)
        for name in ("scene", "sim", "map", "localizer", "prior", "settings", "discovery")
    }
    words = {name: ParameterValue(argument, value_type=str) for name, argument in value.items()}
    timed = {"use_sim_time": ParameterValue(value["sim"], value_type=bool)}
    found = {"discovery": words["discovery"]}
    ours = {"package": "magtwin_ros", "namespace": "robot", "output": "screen"}
    amcl = IfCondition(PythonExpression(["'", value["localizer"], "' == 'amcl'"]))
    magnetic = IfCondition(PythonExpression(["'", value["localizer"], "' == 'magtwin'"]))
    from_file = IfCondition(PythonExpression(["'", value["map"], "' != ''"]))

    def nav2(package: str, executable: str, name: str = "", **rest: object) -> Node:
        return Node(
            package=package,
            executable=executable,
            name=name or executable,
            output="screen",
            **{"parameters": [value["settings"], timed], **rest},
        )

    drives = {"remappings": [("cmd_vel", "/robot/cmd_vel")]}
    return LaunchDescription(
        [
            DeclareLaunchArgument("scene", description="USD stage of the scene"),
            DeclareLaunchArgument("sim", default_value="true", description="simulate the robot"),
            DeclareLaunchArgument(
                "map", default_value="", description="occupancy grid (.yaml); empty: the simulator's"
            ),
            DeclareLaunchArgument("localizer", default_value="amcl", description="amcl or magtwin"),
            DeclareLaunchArgument("prior", default_value="0,0,0", description="start of magtwin's localizer"),
            DeclareLaunchArgument("settings", default_value=SETTINGS, description="parameter file of nav2"),
            DeclareLaunchArgument(
                "discovery",
                default_value=PythonExpression(["'' if '", value["sim"], "' == 'true' else 'subnet'"]),
                description="which machines find the nodes: localhost, subnet; empty: by the environment",
            ),
            Node(
                executable="sim",
                parameters=[{"scene": words["scene"], "lidar": "on", "tf": "odom", **found}],
                remappings=[
                    (
                        "/map",
                        PythonExpression(["'/map' if '", value["map"], "' == '' else '/ground_truth/map'"]),
                    )
                ],
                condition=IfCondition(value["sim"]),
                **ours,
            ),
            Node(
                executable="localize",
                parameters=[{"scene": words["scene"], "prior": words["prior"], **timed, **found}],
                condition=magnetic,
                **ours,
            ),
            nav2(
                "nav2_map_server",
                "map_server",
                parameters=[value["settings"], {"yaml_filename": words["map"]}, timed],
                condition=from_file,
            ),
            nav2("nav2_lifecycle_manager", "lifecycle_manager", "lifecycle_manager_map", condition=from_file),
            nav2("nav2_amcl", "amcl", condition=amcl),
            nav2("nav2_lifecycle_manager", "lifecycle_manager", "lifecycle_manager_amcl", condition=amcl),
            nav2("nav2_controller", "controller_server", **drives),
            nav2("nav2_planner", "planner_server"),
            nav2("nav2_behaviors", "behavior_server", **drives),
            nav2("nav2_bt_navigator", "bt_navigator"),
            nav2("nav2_lifecycle_manager", "lifecycle_manager", "lifecycle_manager_navigation"),
        ]
    )
