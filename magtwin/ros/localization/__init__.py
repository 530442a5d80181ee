"""Localizers on live topics, and ROS nodes as localizers."""
