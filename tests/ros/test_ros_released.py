"""APRILab's released nodes, unmodified, beside the simulated robot: they read what our magnetometer reads."""

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nodes import DOMAINS, SLOWEST_S
from places import ROOT

from magtwin.cli import main
from magtwin.io.bags.topics import CLOCK, COMMAND, MAGNITUDE, Qos
from magtwin.ros.bus import Bus, Message, Publisher, open_bus
from magtwin.ros.simulate import Simulator
from magtwin.twin import open_twin

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

PYTHON = ROOT / "build" / "ros-jazzy" / "bin" / "python"
OLD_NUMPY = ROOT / "build" / "ros-jazzy" / "numpy1"
"""The released follower turns arrays of one number into a float, which NumPy 2 refuses."""

DRIVEN_S = 60.0
"""Simulated time of the comparison [s]."""

BEFORE_S = 0.001
"""Wall time before each /clock, in which the messages before it arrive [s]."""

SILENT_S = 2.0
"""Wall time after which our magnetometer, which is slower at no tick, has nothing to say [s]."""

NODE = "from nn_magnetometer.nn_magnetometer import main; main()"
FOLLOWER = """
from nn_magnetometer import path_follower
path_follower.PathFollower.use_estimate = False  # it reads this attribute and sets it nowhere
path_follower.main()
"""


@pytest.fixture(scope="module")
def scene(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The real lab with the released network, by the commands of the README."""
    if not (PYTHON.exists() and OLD_NUMPY.exists()):
        pytest.skip("no rclpy of jazzy: `make ros` installs it into build/ros-jazzy")
    real, out = real_data / "aprilab", tmp_path_factory.mktemp("aprilab")
    network = real / "models" / "nn_magnetometer_model_v0.0.1.pth"
    main(["map", "import", str(real / "maps"), "--out", str(out / "map.usdc"), "--quiet"])
    main(["model", "convert", str(network), "--out", str(out / "net.safetensors"), "--quiet"])
    named = ["--map", str(out / "map.usdc"), "--network", str(out / "net.safetensors")]
    main(["scene", "aprilab", *named, "--out", str(out / "scene"), "--quiet"])
    return out / "scene" / "aprilab.usda"


@pytest.fixture(scope="module")
def share(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The released package as colcon would install it."""
    real, prefix = real_data / "aprilab", tmp_path_factory.mktemp("prefix")
    index = prefix / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    (index / "nn_magnetometer").touch()
    data = prefix / "share" / "nn_magnetometer" / "data"
    data.mkdir(parents=True)
    for name, folder in (("models", "models"), ("map", "maps"), ("path", "paths")):
        (data / name).symlink_to(real / folder)
    return prefix


@contextmanager
def process(command: list[str], env: Mapping[str, str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process that is ended with the block; its output is in a file."""
    with log.open("wb") as out, subprocess.Popen(command, env=env, stdout=out, stderr=out) as started:
        try:
            yield started
        finally:
            started.terminate()
            try:
                started.wait(5)
            except subprocess.TimeoutExpired:
                started.kill()


class Lockstep:
    """A node whose /clock waits for the readings of both magnetometers, however busy the machine is."""

    def __init__(self, bus: Bus, ear: Bus, alive: Callable[[], None]) -> None:
        self._bus, self._ear, self._alive = bus, ear, alive
        self.ticks: list[int] = []
        self._heard = True
        """Whether ours had a reading at the last tick: not where the survey's sensor had lost lock."""
        self.read: tuple[dict[int, float], dict[int, float]] = {}, {}
        for name, kept in zip((MAGNITUDE.name, "ours/magnitude"), self.read, strict=True):
            ear.subscribe(name, MAGNITUDE.kind, partial(self._keep, kept), Qos(depth=1000).heard)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)

    def publisher(self, topic: str, kind: str, qos: Qos) -> Publisher:
        made = self._bus.publisher(topic, kind, qos)
        return made if topic != CLOCK.name else replace(made, publish=lambda data: self._tick(made, data))

    def _keep(self, kept: dict[int, float], message: Message) -> None:
        read = message.read(["header.stamp", "magnetic_field"])
        kept[int(read["header.stamp"])] = float(read["magnetic_field"][0])

    def _tick(self, clock: Publisher, data: bytes) -> None:
        time.sleep(BEFORE_S)
        clock.publish(data)
        stamp = int(Message(CLOCK.kind, data, 0, 0).read(["clock"])["clock"])
        self.ticks.append(stamp)
        begun, now = all(self.read), time.monotonic()
        last = now + (SLOWEST_S if begun else 0.01)
        silent = now + (SILENT_S if self._heard else 0.01)
        while not all(stamp in kept for kept in self.read) and time.monotonic() < last:
            self._ear.spin_once(0.001)
            if begun and stamp in self.read[0] and time.monotonic() > silent:
                break
        self._heard = stamp in self.read[1]
        self._alive()


@pytest.mark.slow
def test_the_released_node_reads_what_ours_reads_and_its_follower_drives(
    scene: Path, share: Path, real_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    domain = next(DOMAINS)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    for name in ("CYCLONEDDS_URI", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY"):
        monkeypatch.delenv(name, raising=False)
    package = str(real_data / "aprilab" / "ros2")
    libraries = str(Path(np.__file__).parents[1])  # torch, scipy and scikit-learn
    theirs = {
        **os.environ,
        "AMENT_PREFIX_PATH": str(share),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "TORCH_FORCE_NO_WEIGHTS_ONLY_LOAD": "1",
        "OMP_NUM_THREADS": "1",
    }
    node = [str(PYTHON), "-c", NODE, "--ros-args", "-p", "is_sim:=false", "-p", "use_sim_time:=true"]
    follower = [str(PYTHON), "-c", FOLLOWER, "--ros-args", "-p", "path_file:=/data/path/figure8_path.csv"]
    follower += ["-p", "linear_velocity:=0.2", "-p", "continuous:=true", "-p", "do_loop:=true"]
    ours = [sys.executable, "-m", "magtwin", "ros", "magnetometer", str(scene), "use_sim_time:=true"]
    ours += ["units:=nT", "lidar:=off", "--remap", "qtfm/magnitude:=ours/magnitude"]
    ours += ["--remap", "qtfm/total_field_nt:=ours/nt"]
    started: list[subprocess.Popen[bytes]] = []

    def alive() -> None:
        for each in started:
            assert each.poll() is None, "\n".join(log.read_text()[-1500:] for log in tmp_path.glob("*.log"))

    bus, ear = (open_bus(name, backend="cyclonedds", domain=domain) for name in ("sim", "ear"))
    lockstep = Lockstep(bus, ear, alive)
    simulator = Simulator(open_twin(scene), lockstep, magnetometer=False, lidar="off")  # type: ignore[arg-type]
    with ExitStack() as stack:
        stack.callback(bus.close)
        stack.callback(ear.close)
        for name, command, env in (
            ("ours", ours, os.environ),
            ("node", node, {**theirs, "PYTHONPATH": os.pathsep.join([libraries, package])}),
            ("follower", follower, {**theirs, "PYTHONPATH": os.pathsep.join([str(OLD_NUMPY), package])}),
        ):
            started.append(stack.enter_context(process(command, env, tmp_path / f"{name}.log")))
        last = time.monotonic() + 4 * SLOWEST_S
        while not all(map(ear.types, (MAGNITUDE.name, "ours/magnitude", COMMAND.name))):
            ear.spin_once(0.05)
            alive()
            assert time.monotonic() < last, "a node did not start"
        simulator.run(lambda: all(lockstep.read), duration_s=5.0)
        assert all(lockstep.read), "a node had no reading"
        first, place = lockstep.ticks[-1], simulator.online.pose
        simulator.run(duration_s=simulator.online.t + DRIVEN_S)
    theirs_read, ours_read = ({t: b for t, b in kept.items() if t > first} for kept in lockstep.read)
    assert len(theirs_read) >= 130 * DRIVEN_S
    equal = theirs_read.keys() & ours_read.keys()  # ours is silent where the survey's sensor had lost lock
    assert len(equal) > 0.5 * len(theirs_read)
    off = np.abs([theirs_read[stamp] - ours_read[stamp] for stamp in equal])
    assert np.median(off) <= 0.01
    assert np.percentile(off, 99) <= 5.0
    assert math.dist(place[:2], simulator.online.pose[:2]) > 0.5
