"""Two nodes of ROS 2 on loopback, the simulator and the magnetometer: rates, loss, latency, cost and memory.

There is no peer to hold it against; the standards are printed beside the figures. `python benchmarks/ros.py
[seconds]`, 60 unless given; 600 is a soak.
"""

import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from magtwin.files.file import shipped
from magtwin.io.bags.topics import COMMAND, MAGNITUDE, NAMES, POSE, READING, TF, TF_STATIC, Qos
from magtwin.ros.bus import Message, open_bus
from magtwin.ros.commands import command_bytes
from magtwin.ros.diagnostics import KIND
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


def memory_mib(process: subprocess.Popen) -> float:
    """Resident memory of a process [MiB]."""
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def cpu_s(process: subprocess.Popen) -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def unseen(poses: list[int], names: list[Message], readings: list[Message]) -> int:
    """Poses that the cameras did not see, by the flag of the readings: none is sent in a dropout."""
    columns = json.loads(names[-1].read(["data"])["data"])["columns"]
    (place,) = [column["first"] for column in columns if column["name"] == POSE.lost]
    flags = np.array([m.read(["data"])["data"][place] for m in readings], bool)
    when = np.array([m.sent_ns for m in readings])[flags]
    sent = np.array(poses)
    absent = np.rint(np.diff(sent) * 1e-9 * RATES[POSE.name]).astype(int) - 1
    flagged = np.searchsorted(when, sent[1:]) > np.searchsorted(when, sent[:-1])
    return int(absent[flagged].sum())


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
        [*magtwin, "sim", scene, "--magnetometer", "none", "--lidar", "on"], stderr=subprocess.DEVNULL
    )
    bus = open_bus("benchmark", backend="cyclonedds")
    heard: dict[str, list[Message]] = defaultdict(list)
    statuses = {}
    for topic in LIVE:
        if topic in (TF, TF_STATIC) or topic.name in RATES:
            qos = Qos(depth=1000, reliable=topic.qos.reliable)
            bus.subscribe(topic.name, topic.kind, heard[topic.name].append, qos)
    bus.subscribe(
        "/diagnostics", KIND, lambda m: statuses.update({s.name: s for s in m.content.status}), Qos()
    )
    commands = bus.publisher(COMMAND.name, COMMAND.kind, COMMAND.qos)
    bus.subscribe(NAMES.name, NAMES.kind, (names := list[Message]()).append, Qos(latched=True))
    try:
        while len(heard[MAGNITUDE.name]) < 100 or not names:  # both have begun
            bus.spin_once(0.05)
        for messages in heard.values():
            messages.clear()
        begin, sent, before = time.monotonic(), 0.0, (cpu_s(sim), cpu_s(node))
        memory: list[tuple[float, float]] = []
        while (now := time.monotonic()) < begin + SECONDS:
            if now - sent > 0.1:
                sent = now
                commands.publish(command_bytes(COMMAND.kind, 0.2, 0.8 * np.sin(0.7 * (now - begin)), 0))
            bus.spin_once(0.02)
            if now - begin > (len(memory) + 1) * SECONDS / 4:
                memory.append((memory_mib(sim), memory_mib(node)))
        memory.append((memory_mib(sim), memory_mib(node)))
        wall = time.monotonic() - begin
        cost = [after - first for after, first in zip((cpu_s(sim), cpu_s(node)), before, strict=True)]
    finally:
        for process in (sim, node):
            process.terminate()
            process.wait()
        bus.close()
    clock = {int(m.read(["clock"])["clock"]): m.sent_ns for m in heard["/clock"]}
    factor = (max(clock) - min(clock)) / (clock[max(clock)] - clock[min(clock)])
    print(f"{wall:.0f} s, real-time factor {factor:.3f}, load {os.getloadavg()[0]:.1f} of {os.cpu_count()}")
    print(f"{'topic':32s} {'rate':>8s} {'wanted':>8s} {'off':>7s} {'lost':>6s}   standards 2 %, none")
    reliable = {topic.name for topic in LIVE if topic.qos.reliable}
    for name, rate in RATES.items():
        sent = [m.sent_ns for m in heard[name]]
        took, count = (sent[-1] - sent[0]) * 1e-9 * factor, len(sent)
        if name == POSE.name:
            count += unseen(sent, names, heard[READING.name])
        lost = round(took * rate) + 1 - count if name in reliable else ""
        seen = (count - 1) / took
        print(f"{name:32s} {seen:8.2f} {rate:8.2f} {100 * (seen / rate - 1):+6.1f}% {lost:>6}")
    stamps = np.array([int(m.read(["header.stamp"])["header.stamp"]) for m in heard[MAGNITUDE.name]])
    steps = np.rint(np.diff(stamps) * 135e-9)
    print(f"readings missed between the first and the last: {int(np.sum(steps - 1))} of {len(stamps)}")
    # A reading is made at a tick of /clock, the newest of its inputs; stamps are that tick's.
    late = [m.sent_ns - clock[t] for t, m in zip(stamps, heard[MAGNITUDE.name], strict=True) if t in clock]
    p50, p99 = np.percentile(late, [50, 99]) * 1e-6
    values = statuses["magtwin_magnetometer: readings"].values
    own = next(pair.value for pair in values if pair.key == "p99 latency [ms]")
    print(
        f"from newest input to reading: p50 {p50:.2f} ms, p99 {p99:.2f} ms (by the node {own})"
        "   standard 5 ms"
    )
    for name, parts in zip(("simulator", "magnetometer"), zip(*memory, strict=True), strict=True):
        quarters = ", ".join(f"{part:.1f}" for part in parts)
        print(f"memory of the {name} after each quarter [MiB]: {quarters}   standard flat")
    parts = ", ".join(
        f"{name} {100 * s / wall:.0f} %" for name, s in zip(("simulator", "magnetometer"), cost, strict=True)
    )
    print(f"of a core: {parts}, together {100 * sum(cost) / wall:.0f} %   standard 100 %")


if __name__ == "__main__":
    main()
