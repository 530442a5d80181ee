"""Topics of a live robot, in the order in which messages of one time are sent."""

from collections.abc import Mapping
from dataclasses import replace

from magtwin.io.bags.topics import (
    BATTERY,
    CLOCK,
    COMMAND,
    DESCRIPTION,
    IMU,
    JOINTS,
    LATCHED,
    MAGNITUDE,
    NAMES,
    ODOMETRY,
    POSE,
    READING,
    SCAN,
    TF,
    TF_STATIC,
    TOTAL_FIELD,
    TRUTH,
    VECTOR,
    Qos,
    Topic,
)

TICKS = replace(CLOCK, sent="each")
"""/clock at each reading, so that timers in simulated time are as fine as the readings."""

SAMPLED: Mapping[str, Topic] = {"odometry": ODOMETRY, "imu": IMU, "mocap": POSE, "battery": BATTERY}
"""Topics that are sent sample by sample on arrival, stamped with the sampling time; by sensor name."""

READ = (TICKS, JOINTS, TF, TRUTH, MAGNITUDE, VECTOR, TOTAL_FIELD)
"""Topics that are sent at readings of the magnetometer."""

OCCUPANCY = Topic(name="/map", kind="nav_msgs/msg/OccupancyGrid", qos=LATCHED, sent="once")
FIELD = Topic(name="/anomaly_map", kind="sensor_msgs/msg/PointCloud2", qos=LATCHED, sent="once")
FIELD_GRID = Topic(name="/anomaly_map/grid", kind="nav_msgs/msg/OccupancyGrid", qos=LATCHED, sent="once")
READINGS = Topic(name="/robot/ground_truth/readings", kind="sensor_msgs/msg/PointCloud2")
PATH = Topic(name="/robot/ground_truth/path", kind="nav_msgs/msg/Path", qos=Qos(depth=1))

VIEWS = (OCCUPANCY, FIELD, FIELD_GRID, READINGS, PATH)
"""Topics for viewers, see `magtwin.ros.views`; robots share those of the lab."""

LIVE = (*READ, *SAMPLED.values(), SCAN, TF_STATIC, DESCRIPTION, NAMES, READING, *VIEWS)
"""Topics of a simulated robot."""

RECORDED = (*LIVE, COMMAND)
"""Topics that are recorded by default."""
