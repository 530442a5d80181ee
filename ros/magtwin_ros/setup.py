"""The ament package of magtwin's nodes. It does not contain magtwin, which is installed with pip."""

from setuptools import setup

NODES = ("sim", "magnetometer", "localize", "follow", "record", "replay")

setup(
    name="magtwin_ros",
    version="0.1.0",
    packages=["magtwin_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/magtwin_ros"]),
        ("share/magtwin_ros", ["package.xml"]),
        (
            "share/magtwin_ros/launch",
            [
                "launch/magtwin.launch.py",
                "launch/slam.launch.py",
                "launch/navigation.launch.py",
                "launch/ekf.launch.py",
                "launch/gazebo.launch.py",
                "launch/view.launch.py",
            ],
        ),
        (
            "share/magtwin_ros/config",
            [
                "config/magnetometer.yaml",
                "config/slam_toolbox.yaml",
                "config/nav2.yaml",
                "config/robot_localization.yaml",
                "config/ros_gz_bridge.yaml",
                "config/magtwin.rviz",
                "config/foxglove.json",
            ],
        ),
    ],
    install_requires=["setuptools", "pyyaml"],
    zip_safe=True,
    license="Apache-2.0",
    description="ROS 2 nodes of magtwin: simulator, neural magnetometer, localizer, path follower, recorder.",
    entry_points={"console_scripts": [f"{node} = magtwin_ros.nodes:{node}" for node in NODES]},
)
