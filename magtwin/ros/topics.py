"""Topics of a live robot, in the order in which it says them where it says several at one time."""

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
"""/clock at each reading, so that timers in sim time are as fine as those."""

SAMPLED: Mapping[str, Topic] = {"odometry": ODOMETRY, "imu": IMU, "mocap": POSE, "battery": BATTERY}
"""What is said sample by sample, when each arrives, stamped by when it was taken; by the sensors' names."""

READ = (TICKS, JOINTS, TF, MAGNITUDE, VECTOR, TOTAL_FIELD)
"""What is said of readings of the magnetometer."""

LIVE = (*READ, *SAMPLED.values(), SCAN, TF_STATIC, DESCRIPTION, NAMES, READING)
"""What a simulated robot says."""

RECORDED = (*LIVE, COMMAND)
"""What is recorded unless others are named."""
