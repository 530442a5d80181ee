"""Bags: rosbag2, read and written without ROS.

Messages are decoded with the type definitions of rosbags; those in a bag are used for types that it lacks.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from magtwin.io.bags.reader import read_bag as read_bag
    from magtwin.io.bags.writer import RawBagWriter as RawBagWriter
    from magtwin.io.bags.writer import write_bag as write_bag

_MODULES = {"read_bag": "reader", "RawBagWriter": "writer", "write_bag": "writer"}

__all__ = ["RawBagWriter", "read_bag", "write_bag"]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
