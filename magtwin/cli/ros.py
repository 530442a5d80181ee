"""`magtwin ros`: the twin and its sensors as ROS 2 nodes."""

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

from magtwin.cli import options as opt
from magtwin.cli.app import app
from magtwin.cli.terminal import Done, announce, named, progress, silence, step
from magtwin.errors import InputError

if TYPE_CHECKING:
    from magtwin.ros.bus import Bus

ros_app = App(name="ros", help="Run the twin and its sensors as ROS 2 nodes.")
app.command(ros_app)

LONGEST_S = 1e8
"""Longest duration of a node that ends by itself [s]: three years."""


@dataclass(frozen=True, kw_only=True)
class Node:
    """A node's place in the ROS network."""

    namespace: str | None = None
    """Namespace of the topics; "" is the root. Default: robot. Several robots have one each, by their names,
    below it or the root."""

    node_name: str | None = None
    """Name of the node. Default: magtwin_sim and so on. Two nodes need different names."""

    remap: tuple[str, ...] = ()
    """Name of a topic on the network, as OURS:=THEIRS: odom:=/wheel/odom. May be repeated."""

    domain: opt.Whole | None = None
    """ROS domain, 0 to 232. Default: ROS_DOMAIN_ID."""

    backend: Literal["auto", "rclpy", "cyclonedds"] = "auto"
    """ROS client library. auto: rclpy if it can be imported, else cyclonedds."""

    discovery: Literal["localhost", "subnet"] | None = None
    """Which machines find the node: this one, or all of the network. Default:
    ROS_AUTOMATIC_DISCOVERY_RANGE, else localhost."""

    @contextmanager
    def bus(
        self, name: str, *, sim_time: bool = False, duration_s: float | None = None, several: bool = False
    ) -> "Iterator[Bus]":
        """The node of one robot or several, until the end of the block or Ctrl-C."""
        if duration_s is not None and not duration_s > 0:
            raise InputError(f"--duration-s must be above 0 s, got {duration_s!r}")
        if duration_s is not None and duration_s > LONGEST_S:
            raise InputError(f"--duration-s is at most {LONGEST_S:g} s; leave it out to go on until Ctrl-C")
        from magtwin.compiled import steady
        from magtwin.ros.bus import names_of, open_bus
        from magtwin.ros.bus.names import interfaces

        space = ("" if several else "robot") if self.namespace is None else self.namespace
        place: Any = {"backend": self.backend, "domain": self.domain, "discovery": self.discovery}
        names = names_of(space, self.remap)
        bus = open_bus(self.node_name or name, names=names, sim_time=sim_time, **place)
        if bus.reach == "subnet":
            hosts = ", ".join(interfaces()) or "none"
            _warn(f"every host on the network can find this node and send to it (interfaces: {hosts})")
        else:
            announce("only this machine can find this node; --discovery subnet opens it to the network")
        signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a script ignore it
        try:
            with suppress(KeyboardInterrupt), steady():
                yield bus
        finally:
            bus.close()


Where = Annotated[Node, Parameter(name="*")]
HERE = Node()
WallS = Annotated[float | None, Parameter(help="Duration in real time [s]. Default: until Ctrl-C.")]
SimTime = Annotated[bool, Parameter(negative="", help="Use the time of /clock, for a simulated robot.")]
Commands = Annotated[
    Literal["auto", "Twist", "TwistStamped"],
    Parameter(
        help="Type of cmd_vel. auto: what the robot subscribes to; if both, what ROS_DISTRO's robots take."
    ),
]
Stamps = Annotated[
    Literal["header", "arrival"],
    Parameter(help="Time of poses and odometry: the stamps of their headers, or their arrival at this node."),
]
FramePrefix = Annotated[
    str | None, Parameter(help="Prefix of the names of the robot's frames, such as tb4/. Default: none.")
]
Asset = Annotated[
    Path | None, Parameter(help="USD asset of the robot, whose limits are kept. Default: the TurtleBot 4.")
]


@ros_app.command(name="sim")
def sim(
    scene: opt.Scene,
    *,
    where: Where = HERE,
    lab: opt.Lab = "",
    map_layer: opt.MapLayer = None,
    pace: float = 1.0,
    duration_s: float | None = None,
    seed: opt.Seed = 0,
    session: opt.Session = None,
    plant: opt.Plant = None,
    network: opt.Network = None,
    magnetometer: Literal["physical", "neural", "map-only", "none"] | None = None,
    model_error: opt.ModelError = True,
    rate_hz: opt.RateHz = None,
    out_unit: opt.OutUnit = None,
    lidar: opt.Lidar = "schedule",
    frame_prefix: FramePrefix = None,
    tf: Literal["all", "odom", "none"] = "odom",
) -> Done:
    """Simulate a scene's robots in real time: the topics of real robots, and /clock.

    cmd_vel, a Twist or a TwistStamped, drives a robot; it stops after half a second without one. A message on
    reset (std_msgs/Empty) puts the robots back to their start. Of several robots, each has its name as
    namespace and before its frames: /ann/odom, ann/base_link. Ctrl-C ends it.

    Parameters
    ----------
    pace
        Simulated seconds per second.
    duration_s
        Duration in simulated time [s]. Default: until Ctrl-C.
    magnetometer
        What the magnetometer reads: physical, neural or map-only, as for `magtwin run`; or none, which leaves
        its topics to `magtwin ros magnetometer`. Default: the scene's.
    tf
        Transforms of the drive on /tf. odom: odom to base_link, beside a localizer that publishes map to
        odom. all: also map to odom, by the true pose. none: neither, beside a filter that publishes both. The
        true pose is on ground_truth, and unless all, it is the frame ground_truth in the map.
    """
    from magtwin.ros.simulate import Simulator
    from magtwin.twin import open_twin, with_plant

    opt.check_pace(pace)
    announce(f"opening {scene}")
    kind = None if magnetometer == "none" else magnetometer
    opening: Any = {"network": network, "magnetometer": kind, "model_error": model_error}
    twin = with_plant(open_twin(scene, lab=lab, map_layer=map_layer, **opening), plant)
    with where.bus("magtwin_sim", duration_s=duration_s, several=bool(twin.scene.others)) as bus:
        options: Any = {"seed": seed, "session": session, "speed": pace, "rate_hz": rate_hz, "lidar": lidar}
        options |= {"units": out_unit or "T", "frame_prefix": frame_prefix, "tf": tf, "say": announce}
        node = Simulator(twin, bus, magnetometer=magnetometer != "none", **options)
        announce(f"simulating by {bus.backend} at {pace:g} x real time; Ctrl-C ends")
        with progress("Simulating", "s") if duration_s else silence() as advance:

            def reported() -> bool:
                if advance is not None:
                    advance(node.online.t, duration_s)
                return False

            node.run(reported, duration_s=duration_s)
    return Done()


@ros_app.command(name="magnetometer", usage="Usage: magtwin ros magnetometer [OPTIONS] SCENE [SETTING...]")
def magnetometer(
    scene: opt.Scene,
    *settings: str,
    where: Where = HERE,
    lab: opt.Lab = "",
    map_layer: opt.MapLayer = None,
    network: opt.Network = None,
    online: str | None = None,
    measured: str | None = None,
    frame_prefix: FramePrefix = None,
    duration_s: WallS = None,
) -> Done:
    """Run the magnetometer alone: read a robot's sensors through map and network, and publish the field.

    It reads pose (/robot/enu/pose), odometry, IMU, battery and scans, as far as the network needs them. It
    publishes qtfm/magnitude and qtfm/total_field_nt while its inputs are fresh, and its state in
    /diagnostics. Inputs may come and go. Settings have the form of ROS, name:=value: rate_hz (135), units
    (T or nT), use_sim_time, max_age_s (0.5), battery_max_age_s (30), stamps (header, arrival), lidar (scan,
    on, off), outside (silent, clamp); with --online also buffer_s (60), pose_sd_m (0), map_frame (map).

    Parameters
    ----------
    settings
        Settings, such as units:=nT use_sim_time:=true.
    online
        Topic of late poses, by which a mixed model follows its session: PoseStamped,
        PoseWithCovarianceStamped, TransformStamped or Odometry, whose stamps may lie some seconds in the
        past. Readings are then published on predicted/magnitude and predicted/total_field_nt. If the scene
        has no mixed model, that which ships with magtwin is used.
    measured
        Topic of the field that a real sensor measures, for --online: MagneticField or Float64, in T or nT.
        Default: qtfm/magnitude.
    """
    from magtwin.ros.magnetometer import PARAMETERS, Magnetometer, following
    from magtwin.ros.parameters import settings as settings_of
    from magtwin.twin import open_twin

    values = settings_of(PARAMETERS, settings)
    announce(f"opening {scene}")
    opening: Any = {"lab": lab, "map_layer": map_layer, "network": network}
    twin = open_twin(scene, model_error=False, **opening)  # it predicts for a robot that reads
    if online is not None and network is None:
        twin = following(twin)
    with where.bus("magtwin_magnetometer", sim_time=values["use_sim_time"], duration_s=duration_s) as bus:
        options: Any = {"online": online, "measured": measured, "frame_prefix": frame_prefix or ""}
        Magnetometer(twin, bus, values, say=announce, **options)
        announce(f"reading by {bus.backend}; Ctrl-C ends")
        spin(bus, duration_s)
    return Done()


@ros_app.command(name="follow")
def follow(
    path: str,
    *,
    where: Where = HERE,
    asset: Asset = None,
    speed: float = 0.2,
    controller: Literal["follower", "release"] = "follower",
    source: Literal["truth", "estimate", "odometry"] = "truth",
    laps: opt.Whole = 1,
    continuous: opt.Flag = False,
    sim_time: SimTime = False,
    commands: Commands = "auto",
    stamps: Stamps = "header",
) -> Done:
    """Drive a robot along a path by its reported pose; it stops at the end, and while the pose is lost.

    Parameters
    ----------
    path
        Name of a path, or a CSV file of x, y [m].
    speed
        Forward speed on straight parts [m/s].
    controller
        What steers: magtwin's follower, or the released package's controller.
    source
        Source of the pose: truth (enu/pose), estimate (estimate/pose) or odometry.
    laps
        Number of times to drive the path; an open path is driven back and forth.
    continuous
        Drive until Ctrl-C.
    """
    from magtwin.files.file import shipped
    from magtwin.path import resolve_path
    from magtwin.ros.follow import Follower
    from magtwin.usd.robot import load_robot

    way = resolve_path(path)
    drive = load_robot(asset or shipped("robots", "turtlebot4", "turtlebot4.usda")).drive
    with where.bus("magtwin_follow", sim_time=sim_time) as bus:
        options: Any = {"speed": speed, "controller": controller, "source": source, "laps": laps}
        options |= {"continuous": continuous, "commands": commands, "stamps": stamps, "say": announce}
        node = Follower(way, drive, bus, **options)
        announce(f"driving {way.name}, {way.length:.1f} m, by {bus.backend}; Ctrl-C ends")
        try:
            with progress(f"Driving {way.name}") as advance:
                while not node.done:
                    bus.spin_once(0.1)
                    total = None if continuous else laps
                    advance(node.laps, total, f"{node.rms_m:.3f} m RMS off it")
        finally:
            node.stop()
    text = f"{node.laps} times along {way.name}, {node.rms_m:.3f} m RMS off it"
    return Done(text=text, data={"path": way.name, "laps": node.laps, "rms_m": node.rms_m})


@ros_app.command(name="record")
def record(
    out: Path,
    *,
    topic: tuple[str, ...] = (),
    where: Where = HERE,
    duration_s: WallS = None,
    sim_time: SimTime = False,
    force: opt.Force = False,
) -> Done:
    """Record a robot's topics as a rosbag2, which magtwin convert, info, report and dataset read as a run.

    Topics may come and go, and may have any type of ROS 2's common packages. Ctrl-C ends it, and so does a
    time that jumps back, as after a reset of the simulator. The exit status is 1 if a topic that was asked
    for was not recorded.

    Parameters
    ----------
    out
        Folder to make, or a file (.mcap).
    topic
        Topic to record beside those of the robot, such as /scan_2. May be repeated.
    """
    from magtwin.io.bags import RawBagWriter
    from magtwin.ros.record import Recorder

    out = named(out, force=force)
    writer = RawBagWriter(out, force=force)
    try:
        with where.bus("magtwin_record", sim_time=sim_time, duration_s=duration_s) as bus:
            announce(f"recording by {bus.backend}; Ctrl-C ends")
            recorder = Recorder(bus, writer, topic, sim_time=sim_time, say=_warn)
            with progress("Recording", "messages") as advance:
                recorder.run(lambda: advance(sum(writer.counts.values()), None), duration_s=duration_s)
    finally:
        counts = dict(writer.counts)
        writer.close()
    if not sum(counts.values()):
        raise InputError("nothing was recorded: no node offers these topics; check --domain and --namespace")
    lines = [f"{count:8d}  {name}" for name, count in counts.items()]
    missing = recorder.missing()
    for name, why in missing.items():
        _warn(f"{name} was not recorded: {why}")
    data = {"messages": counts, "missing": missing}
    following = (("magtwin", "info", out),)
    return Done(lines=lines, data=data, wrote=out, next=following, status=1 if missing else 0)


@ros_app.command(name="replay")
@opt.reads_recordings
def replay(
    run: opt.AnyRun,
    *,
    topic: tuple[str, ...] = (),
    scene: Path | None = None,
    where: Where = HERE,
    pace: float = 1.0,
    stamps: Literal["run", "wall"] = "run",
    out_unit: opt.OutUnit = None,
    frame_prefix: FramePrefix = None,
    tf: Literal["all", "odom", "none"] = "odom",
) -> Done:
    """Publish a recorded run on its robot's ROS topics, in real time.

    Parameters
    ----------
    topic
        Topic to publish. May be repeated. Default: all.
    scene
        Scene of the run, for frames, covariances, /tf_static and the robot's description. Default: none.
    pace
        Seconds of the run per second.
    stamps
        Time of the messages and of /clock: that of the run, or wall time, for programs without use_sim_time.
    tf
        Transforms of the drive on /tf, as for `magtwin ros sim`.
    """
    from magtwin.io.formats import read_run
    from magtwin.ros.record import Player
    from magtwin.twin import open_twin

    opt.check_pace(pace)
    whole = read_run(run)
    twin = None if scene is None else open_twin(scene, model_error=False)
    with where.bus("magtwin_replay") as bus:
        options: Any = {"units": out_unit or "T", "topics": topic, "stamps": stamps, "tf": tf}
        player = Player(whole, bus, twin, frame_prefix=frame_prefix or "", **options)
        announce(f"replaying {whole['t'][-1] - whole['t'][0]:.0f} s by {bus.backend}; Ctrl-C ends")
        step("Replaying")
        count = player.run(speed=pace)
    return Done(text=f"{count} messages", data={"messages": count})


def spin(bus: "Bus", duration_s: float | None) -> None:
    """Run a node until it ends, or for a time [s]."""
    begin = time.monotonic()
    with progress("Reading", "s") if duration_s else silence() as advance:
        while duration_s is None or (gone := time.monotonic() - begin) < duration_s:
            bus.spin_once(0.1)
            if duration_s is not None:
                advance(gone, duration_s)


def _warn(text: str) -> None:
    announce(f"warning: {text}")
