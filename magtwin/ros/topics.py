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
    MAGNITUDE,
    NAMES,
    ODOMETRY,
    POSE,
    READING,
    SCAN,
    TF,
    TF_STATIC,
    TOTAL_FIELD,
    VECTOR,
    Topic,
)

TICKS = replace(CLOCK, sent="each")
"""/clock at each reading, so that timers in simulated time are as fine as the readings."""

SAMPLED: Mapping[str, Topic] = {"odometry": ODOMETRY, "imu": IMU, "mocap": POSE, "battery": BATTERY}
"""Topics that are sent sample by sample on arrival, stamped with the sampling time; by sensor name."""

READ = (TICKS, JOINTS, TF, MAGNITUDE, VECTOR, TOTAL_FIELD)
"""Topics that are sent at readings of the magnetometer."""

LIVE = (*READ, *SAMPLED.values(), SCAN, TF_STATIC, DESCRIPTION, NAMES, READING)
"""Topics of a simulated robot."""

RECORDED = (*LIVE, COMMAND)
"""Topics that are recorded by default."""
