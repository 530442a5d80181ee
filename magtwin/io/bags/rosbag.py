"""Bags: rosbag2 in both of its storages, MCAP and sqlite3, without ROS.

Messages are decoded by the definitions that magtwin's own libraries have of them, never by those that a bag
brings along.
"""

from magtwin.io.bags.reader import read_bag
from magtwin.io.bags.readings import read_bag_readings
from magtwin.io.bags.writer import BagWriter, write_bag

__all__ = ["BagWriter", "read_bag", "read_bag_readings", "write_bag"]
