"""APRILab's released nodes, unmodified, beside the simulated robot: they get their inputs, and read what we read."""

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import pytest
from nodes import DOMAINS, SLOWEST_S, spin
from places import ROOT

from magtwin.cli import main
from magtwin.io.bags.topics import COMMAND, MAGNITUDE, POSE, Qos
from magtwin.ros.bus import Bus, Message, open_bus

pytest.importorskip("cyclonedds", reason="extra ros is not installed")

PYTHON = ROOT / "build" / "ros-jazzy" / "bin" / "python"
OLD_NUMPY = ROOT / "build" / "ros-jazzy" / "numpy1"
"""The released follower turns arrays of one number into a float, which NumPy 2 refuses."""

DRIVEN_S = float(os.environ.get("MAGTWIN_RELEASED_S", "12"))
"""Simulated time of the comparison [s]."""

PACE = float(os.environ.get("MAGTWIN_RELEASED_PACE", "0.5"))
"""Simulated seconds a second: half, so that a busy machine keeps up."""

NODE = "from nn_magnetometer.nn_magnetometer import main; main()"
FOLLOWER = """
from nn_magnetometer import path_follower
path_follower.PathFollower.use_estimate = False  # it reads this attribute and sets it nowhere
path_follower.main()
"""
MANY = Qos(depth=1000)


@pytest.fixture(scope="module")
def scene(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The real lab with the released network, by the commands of the README."""
    if not PYTHON.exists():
        pytest.skip("no rclpy of jazzy: `make ros` installs it into build/ros-jazzy")
    real, out = real_data / "aprilab", tmp_path_factory.mktemp("aprilab")
    network = real / "models" / "nn_magnetometer_model_v0.0.1.pth"
    main(["map", "import", str(real / "maps"), "--out", str(out / "map.usdc"), "--quiet"])
    main(["network", "convert", str(network), "--out", str(out / "net.safetensors"), "--quiet"])
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


def test_the_released_node_reads_what_ours_reads_and_its_follower_drives(
    scene: Path, share: Path, real_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    domain = next(DOMAINS)
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    for name in ("CYCLONEDDS_URI", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOCALHOST_ONLY"):
        monkeypatch.delenv(name, raising=False)
    ours = [sys.executable, "-m", "magtwin", "ros"]
    libraries = str(Path(np.__file__).parents[1])  # torch, scipy and scikit-learn
    package = str(real_data / "aprilab" / "ros2")
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
    follower += ["-p", "use_sim_time:=true"]
    reader = [*ours, "magnetometer", str(scene), "use_sim_time:=true", "units:=nT", "lidar:=off"]
    reader += ["--remap", "qtfm/magnitude:=ours/magnitude", "--remap", "qtfm/total_field_nt:=ours/nt"]
    robot = [*ours, "sim", str(scene), "--magnetometer", "none", "--lidar", "off", "--pace", str(PACE)]
    heard: dict[str, dict[int, float]] = {"ours/magnitude": {}, MAGNITUDE.name: {}}
    places: list[np.ndarray] = []
    bus = open_bus("ear", backend="cyclonedds", domain=domain)

    def keep(name: str, message: Message) -> None:
        read = message.read(["header.stamp", "magnetic_field"])
        heard[name][int(read["header.stamp"])] = float(read["magnetic_field"][0])

    for name in heard:
        bus.subscribe(name, MAGNITUDE.kind, lambda m, name=name: keep(name, m), MANY.heard)
    bus.subscribe(POSE.name, POSE.kind, lambda m: places.append(m.read(["pose.position"])["pose.position"]), MANY.heard)  # fmt: skip
    with ExitStack() as stack:
        start = lambda what, env, name: stack.enter_context(process(what, env, tmp_path / name))  # noqa: E731
        started = [
            start(reader, os.environ, "ours.log"),
            start(node, {**theirs, "PYTHONPATH": os.pathsep.join([libraries, package])}, "theirs.log"),
            start(
                follower,
                {**theirs, "PYTHONPATH": os.pathsep.join([str(OLD_NUMPY), package])},
                "follower.log",
            ),
        ]
        stack.callback(bus.close)
        waited = lambda: bus.types(MAGNITUDE.name) and bus.types("ours/magnitude") and bus.types(COMMAND.name)  # noqa: E731
        until(waited, bus, started, tmp_path, 4 * SLOWEST_S)
        started.append(start(robot, os.environ, "robot.log"))
        last_ns = lambda: max(heard[MAGNITUDE.name], default=0)  # noqa: E731
        until(lambda: len(heard[MAGNITUDE.name]) > 1, bus, started, tmp_path, 4 * SLOWEST_S)
        first = last_ns()
        until(lambda: last_ns() > first + DRIVEN_S * 1e9, bus, started, tmp_path, 4 * SLOWEST_S + 2 * DRIVEN_S / PACE)
    theirs_read, ours_read = heard[MAGNITUDE.name], heard["ours/magnitude"]
    stamps = np.array(sorted(stamp for stamp in theirs_read if stamp >= first))
    rate = (len(stamps) - 1) / (stamps[-1] - stamps[0]) * 1e9
    equal = sorted(theirs_read.keys() & ours_read.keys())
    off = np.abs([theirs_read[stamp] - ours_read[stamp] for stamp in equal])
    median, p99 = np.percentile(off, (50, 99))
    driven = float(np.hypot(*np.diff(np.array(places)[::120, :2], axis=0).T).sum())
    print(
        f"{rate:.1f} Hz, {len(equal)} of {len(stamps)} stamps equal, median {median:.4f} nT, p99 {p99:.3f} nT, "
        f"most {off.max():.1f} nT, {driven:.1f} m driven"
    )
    assert rate >= 130
    assert len(equal) > 0.5 * len(stamps)
    assert median <= 0.01
    assert p99 <= 5
    assert driven > 0.1 * DRIVEN_S


def until(holds, bus: Bus, started, logs: Path, longest_s: float) -> None:
    """Spin until something holds, while every process runs."""
    import time

    last = time.monotonic() + longest_s
    while not holds():
        for each in started:
            assert each.poll() is None, "\n".join(log.read_text()[-1500:] for log in logs.glob("*.log"))
        assert time.monotonic() < last, "\n".join(log.read_text()[-1500:] for log in logs.glob("*.log"))
        bus.spin_once(0.02)
