"""Topics of a live robot, in the order in which messages of one time are sent."""

from collections.abc import Mapping
from dataclasses import replace

from magtwin.io.bags.cdr import Index
from magtwin.io.bags.sender import Sender
from magtwin.io.bags.topics import (
    BATTERY,
    CLOCK,
    COMMAND,
    DESCRIPTION,
    FIELD,
    IMU,
    JOINTS,
    MAGNITUDE,
    NAMES,
    OCCUPANCY,
    ODOMETRY,
    POSE,
    READING,
    SCAN,
    TF,
    TF_STATIC,
    VECTOR,
    Columns,
    Fields,
    Qos,
    Topic,
)


def _truth(c: Columns, stamp: Index, sender: Sender) -> Fields:
    return {
        "child_frame_id": sender.truth_frame,
        "pose.pose.position": c["p_world_base"],
        "pose.pose.orientation": c["q_world_base_xyzw"],
        "twist.twist.linear": c["v_base"],
        "twist.twist.angular": c["w_base"],
    }


TOTAL_FIELD = Topic(
    name="/robot/qtfm/total_field_nt",
    kind="std_msgs/msg/Float64",
    needs=("b_measured_nt",),
    sent="each",
    more=lambda c, stamp, sender: {"data": c["b_measured_nt"]},
)
"""The magnitude in nT, whatever the unit of the other topics; in bags, use MAGNITUDE."""

TRUTH = Topic(
    name="/robot/ground_truth",
    kind="nav_msgs/msg/Odometry",
    needs=("p_world_base", "q_world_base_xyzw", "v_base", "w_base"),
    sent="ticks",
    every_s=1 / 62,
    frame="map_frame",
    more=_truth,
)
"""The true pose of base_link in the map, with its velocities in base_link."""

TICKS = replace(CLOCK, sent="each")
"""/clock at each reading, so that timers in simulated time are as fine as the readings."""

SAMPLED: Mapping[str, Topic] = {"odometry": ODOMETRY, "imu": IMU, "mocap": POSE, "battery": BATTERY}
"""Topics that are sent sample by sample on arrival, stamped with the sampling time; by sensor name."""

READ = (TICKS, JOINTS, TF, TRUTH, MAGNITUDE, VECTOR, TOTAL_FIELD)
"""Topics that are sent at readings of the magnetometer."""

READINGS = Topic(name="/robot/ground_truth/readings", kind="sensor_msgs/msg/PointCloud2")
PATH = Topic(name="/robot/ground_truth/path", kind="nav_msgs/msg/Path", qos=Qos(depth=1))

VIEWS = (OCCUPANCY, FIELD, READINGS, PATH)
"""Topics for viewers, see `magtwin.ros.views`; robots share those of the lab."""

LIVE = (*READ, *SAMPLED.values(), SCAN, TF_STATIC, DESCRIPTION, NAMES, READING, *VIEWS)
"""Topics of a simulated robot."""

RECORDED = (*LIVE, COMMAND)
"""Topics that are recorded by default."""
