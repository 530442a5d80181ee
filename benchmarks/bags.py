"""A run of 600 s as a bag and back, against rosbags on the same messages, in one process.

81,000 readings of the shipped lab's robot with all of its topics, some 500,000 messages, in both storages.
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

from magtwin.files import shipped
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


def rosbags_write(folder: Path, storage: str, messages: list) -> None:
    with Writer(folder, version=8, storage_plugin=StoragePlugin[storage.upper()]) as writer:
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
        for storage in ("mcap", "sqlite3"):
            bag = folder / storage

            def write(bag: Path = bag, storage: str = storage) -> None:
                write_bag(run, bag, twin, storage=storage, scans=scans, force=True)  # type: ignore[arg-type]

            def read(bag: Path = bag) -> None:
                read_bag(bag)

            ours = seconds(write, options.repetitions), seconds(read, options.repetitions)
            with Reader(bag) as reader:
                messages = [(c.topic, c.msgtype, t, bytes(data)) for c, t, data in reader.messages()]

            def peer_writes(bag: Path = bag, storage: str = storage, messages: list = messages) -> None:
                rosbags_write(bag.with_name(f"peer_{storage}"), storage, messages)

            def peer_reads(bag: Path = bag) -> None:
                rosbags_read(bag)

            peer = seconds(peer_writes, 1), seconds(peer_reads, 1)
            for what, mine, theirs in zip(("write", "read"), ours, peer, strict=True):
                ratio = theirs[1] / mine[1]
                print(
                    f"{storage:8} {what:5} {len(messages)} messages: ours {mine[0]:.2f} s "
                    f"({mine[1]:.2f} s of all processors), rosbags {theirs[0]:.2f} s ({theirs[1]:.2f} s), "
                    f"{ratio:.1f} times as much"
                )


if __name__ == "__main__":
    main()
