"""Bags: rosbag2 in both of its storages, MCAP and sqlite3, without ROS.

Messages are decoded by the definitions that magtwin's own libraries have of them, never by those that a bag
brings along.
"""

from magtwin.io.bag_reader import read_bag
from magtwin.io.bag_readings import read_bag_readings
from magtwin.io.bag_writer import BagWriter, write_bag

__all__ = ["BagWriter", "read_bag", "read_bag_readings", "write_bag"]
