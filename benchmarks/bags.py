"""A run of 600 s as a bag and back, against rosbags on the same messages, in one process.

81,000 readings of the shipped lab's robot with all of its topics, some 500,000 messages, in MCAP.
The peer writes the same messages with rosbags' Writer, given as bytes already, and reads and decodes them
again. For scale: numpy's savez of the same columns. Seconds by the clock and of all processors, medians over
repetitions of ours, one of the peer.

    python benchmarks/bags.py [--seconds 600] [--repetitions 3]
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from magtwin.files.file import shipped
from magtwin.io.bags import read_bag, write_bag
from magtwin.twin import open_twin, scan, simulate

STORE = get_typestore(Stores.ROS2_HUMBLE)


def seconds(work: Callable[[], object], repetitions: int) -> tuple[float, float]:
    """What it takes by the clock, and of all processors."""
    wall, cpu = [], []
    for _ in range(repetitions):
        start, spent = time.perf_counter(), time.process_time()
        work()
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - spent)
    return statistics.median(wall), statistics.median(cpu)


def rosbags_write(folder: Path, messages: list) -> None:
    with Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        known = {
            (topic, kind): writer.add_connection(topic, kind, typestore=STORE)
            for topic, kind in dict.fromkeys((topic, kind) for topic, kind, _, _ in messages)
        }
        for topic, kind, t, data in messages:
            writer.write(known[topic, kind], t, data)


def rosbags_read(path: Path) -> None:
    with Reader(path) as reader:
        for connection, _, data in reader.messages():
            STORE.deserialize_cdr(data, connection.msgtype)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--repetitions", type=int, default=3)
    options = parser.parse_args()
    twin = open_twin(shipped("scenes", "lab", "lab.usda"))
    run = simulate(twin, "figure8", duration_s=options.seconds)
    scans = scan(twin, run)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        saved = seconds(lambda: np.savez(folder / "run.npz", **run.columns), options.repetitions)
        print(f"{run.rows} rows; numpy's savez {saved[0]:.2f} s, {saved[1]:.2f} s of all processors")
        bag, peer_bag = folder / "run", folder / "peer"
        ours = (
            seconds(lambda: write_bag(run, bag, twin, scans=scans, force=True), options.repetitions),
            seconds(lambda: read_bag(bag), options.repetitions),
        )
        with Reader(bag) as reader:
            messages = [(c.topic, c.msgtype, t, bytes(data)) for c, t, data in reader.messages()]
        peer = seconds(lambda: rosbags_write(peer_bag, messages), 1), seconds(lambda: rosbags_read(bag), 1)
        for what, mine, theirs in zip(("write", "read"), ours, peer, strict=True):
            print(
                f"{what:5} {len(messages)} messages: ours {mine[0]:.2f} s ({mine[1]:.2f} s of all CPUs), "
                f"rosbags {theirs[0]:.2f} s ({theirs[1]:.2f} s), {theirs[1] / mine[1]:.1f} times as much"
            )


if __name__ == "__main__":
    main()
