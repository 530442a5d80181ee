"""magtwin's nodes as ROS 2 executables."""
