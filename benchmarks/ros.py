"""Two nodes of ROS 2 on loopback, the simulator and the magnetometer: rates, loss, latency and cost.

There is no peer to hold it against; the standards are printed beside the figures. `python benchmarks/ros.py
[seconds]`, 60 unless given.
"""

import os
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from magtwin.files import shipped
from magtwin.io.messages import COMMAND, MAGNITUDE, TF, TF_STATIC, Qos
from magtwin.ros.bus import Message, open_bus
from magtwin.ros.diagnostics import KIND, from_message
from magtwin.ros.follow import command_bytes
from magtwin.ros.topics import LIVE

SECONDS = float(sys.argv[1]) if len(sys.argv) > 1 else 60.0
RATES = {
    "/robot/qtfm/magnitude": 135.0,
    "/robot/qtfm/total_field_nt": 135.0,
    "/clock": 135.0,
    "/magtwin/reading": 135.0,
    "/robot/enu/pose": 120.0,
    "/robot/odom": 62.0,
    "/robot/imu": 62.0,
    "/robot/joint_states": 62.0,
    "/tf": 62.0,
    "/robot/scan": 7.5,
    "/robot/battery_state": 0.5,
}


def cpu_s(process: subprocess.Popen) -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    os.environ |= {
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_DOMAIN_ID": str(100 + os.getpid() % 100),
    }
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    scene = str(shipped("scenes", "lab", "lab.usda"))
    magtwin = [sys.executable, "-m", "magtwin", "ros"]
    node = subprocess.Popen(
        [*magtwin, "magnetometer", scene, "use_sim_time:=true"], stderr=subprocess.DEVNULL
    )
    sim = subprocess.Popen(
        [*magtwin, "sim", scene, "--no-magnetometer", "--lidar", "on"], stderr=subprocess.DEVNULL
    )
    bus = open_bus("benchmark", backend="cyclonedds")
    heard: dict[str, list[Message]] = defaultdict(list)
    statuses = {}
    for topic in LIVE:
        if topic in (TF, TF_STATIC) or topic.name in RATES:
            qos = Qos(depth=1000, reliable=topic.qos.reliable)
            bus.subscribe(topic.name, topic.kind, heard[topic.name].append, qos)
    bus.subscribe(
        "/diagnostics", KIND, lambda m: statuses.update({s.name: s for s in from_message(m)}), Qos()
    )
    commands = bus.publisher(COMMAND.name, COMMAND.kind, COMMAND.qos)
    try:
        while len(heard[MAGNITUDE.name]) < 100:  # both have begun
            bus.spin_once(0.05)
        for messages in heard.values():
            messages.clear()
        begin, sent, before = time.monotonic(), 0.0, (cpu_s(sim), cpu_s(node))
        while (now := time.monotonic()) < begin + SECONDS:
            if now - sent > 0.1:
                sent = now
                commands.publish(command_bytes(COMMAND.kind, 0.2, 0.8 * np.sin(0.7 * (now - begin)), 0))
            bus.spin_once(0.02)
        wall = time.monotonic() - begin
        cost = [after - first for after, first in zip((cpu_s(sim), cpu_s(node)), before, strict=True)]
    finally:
        for process in (sim, node):
            process.terminate()
            process.wait()
        bus.close()
    clock = [m.read(["clock"])["clock"] for m in heard["/clock"]]
    span = (clock[-1] - clock[0]) / 1e9
    print(f"{wall:.0f} s, real-time factor {span / wall:.3f}")
    print(f"{'topic':32s} {'rate':>8s} {'wanted':>8s} {'off':>7s}   standard 2 %")
    for name, rate in RATES.items():
        count = len(heard[name])
        print(f"{name:32s} {count / span:8.2f} {rate:8.2f} {100 * (count / span / rate - 1):+6.1f}%")
    stamps = np.array([m.read(["header.stamp"])["header.stamp"] for m in heard[MAGNITUDE.name]])
    steps = np.rint(np.diff(stamps) * 135e-9)
    print(f"readings missed between the first and the last: {int(np.sum(steps - 1))} of {len(stamps)}")
    told = statuses["magtwin_magnetometer: readings"].values
    half, most = told["median latency [ms]"], told["p99 latency [ms]"]
    print(
        f"magnetometer, from its newest input to its reading: median {half} ms, p99 {most} ms   standard 5 ms"
    )
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    parts = ", ".join(
        f"{name} {100 * s / wall:.0f} %" for name, s in zip(("simulator", "magnetometer"), cost, strict=True)
    )
    print(f"of a core: {parts}, together {100 * sum(cost) / wall:.0f} %   standard 100 %")


if __name__ == "__main__":
    main()
