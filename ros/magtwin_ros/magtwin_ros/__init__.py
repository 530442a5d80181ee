"""Nodes of magtwin as executables of ROS 2."""
