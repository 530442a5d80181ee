"""Bus: the interface of a node to ROS 2, and its two backends.

`bus` has the interface and `open_bus`; `names` has the names and the reach of a node; `messages` encodes
messages; `dds` and `rclpy_bus` are the backends.
"""

from magtwin.ros.bus.bus import (
    Backend,
    Bus,
    Endpoint,
    Handler,
    Message,
    Publisher,
    Subscription,
    open_bus,
)
from magtwin.ros.bus.messages import poses_bytes, to_bytes
from magtwin.ros.bus.names import Names, Range, is_name, names_of

__all__ = [
    "Backend",
    "Bus",
    "Endpoint",
    "Handler",
    "Message",
    "Names",
    "Publisher",
    "Range",
    "Subscription",
    "is_name",
    "names_of",
    "open_bus",
    "poses_bytes",
    "to_bytes",
]
