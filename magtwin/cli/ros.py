"""`magtwin ros`: the twin and its sensors as nodes of ROS 2."""

import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from magtwin.cli.app import app
from magtwin.cli.terminal import Force, Seed, Session, Whole, announcer, progress, say, silence, step
from magtwin.errors import InputError

if TYPE_CHECKING:
    from magtwin.ros.bus import Bus

ros_app = App(name="ros", help="The twin and its sensors as nodes of ROS 2.")
app.command(ros_app)


@dataclass(frozen=True, kw_only=True)
class Node:
    """Where a node stands."""

    namespace: str = "robot"
    """Namespace of its topics; "" is the root."""

    name: str | None = None
    """Its name, magtwin_sim and so on unless given; two of one name cannot be told apart."""

    remap: tuple[str, ...] = ()
    """A name that it has on the network instead, as odom:=/wheel/odom; may be given several times."""

    domain: Whole | None = None
    """ROS domain, 0 to 232; ROS_DOMAIN_ID unless given."""

    backend: Literal["auto", "rclpy", "cyclonedds"] = "auto"
    """What carries it: rclpy where it can be imported, else cyclonedds."""

    @contextmanager
    def bus(self, name: str, *, sim_time: bool = False, duration: float | None = None) -> "Iterator[Bus]":
        """The node, until the end or Ctrl-C.

        Raises:
            InputError: It cannot be there, or not for a `duration` [s].
        """
        if duration is not None and not duration > 0:
            raise InputError(f"duration must be above 0 s, got {duration!r}")
        from magtwin.ros.bus import names_of, open_bus

        bus = open_bus(
            self.name or name,
            names=names_of(self.namespace, self.remap),
            sim_time=sim_time,
            backend=self.backend,
            domain=self.domain,
        )
        signal.signal(signal.SIGINT, signal.default_int_handler)  # which a script's jobs begin without
        try:
            with suppress(KeyboardInterrupt):
                yield bus
        finally:
            bus.close()


Where = Annotated[Node, Parameter(name="*")]
HERE = Node()
Profile = Literal["ros", "aprilab"]

UNITS: Mapping[Profile, Literal["T", "nT"]] = MappingProxyType({"ros": "T", "aprilab": "nT"})
"""Unit of fields by profile: tesla as ROS has it, or what programs expect that were written against APRILab's
release."""


@ros_app.command(name="sim")
def sim(
    scene: Path,
    *,
    where: Where = HERE,
    speed: float = 1.0,
    duration: float | None = None,
    seed: Seed = 0,
    session: Session = None,
    net: Path | None = None,
    model_error: bool = True,
    rate_hz: float | None = None,
    profile: Profile = "ros",
    units: Literal["T", "nT"] | None = None,
    lidar: Literal["schedule", "on", "off"] = "schedule",
    stamps: Literal["sim", "wall"] = "sim",
    stamped_commands: bool = False,
    magnetometer: bool = True,
) -> None:
    """Simulate a scene's robot in real time: the topics of the real one, and /clock.

    It is driven by cmd_vel, and stops where none has come for half a second. A message on reset
    (std_msgs/Empty) puts it back to its start. Ctrl-C ends.

    Parameters
    ----------
    scene
        USD stage to simulate.
    where
        Where the node stands.
    speed
        Sim time for each wall time.
    duration
        How long, in sim time [s]; without an end unless given.
    seed
        Seed of all noise.
    session
        As for `magtwin run`.
    net
        Weights to use in place of the scene's; "none" for a physical magnetometer.
    model_error
        As for `magtwin run`.
    rate_hz
        Readings of the magnetometer a second [Hz]; the scene's unless given.
    profile
        Conventions: ros, fields in tesla; aprilab, in nT, for programs written against APRILab's release.
    units
        Unit of fields, T or nT; the profile's unless given.
    lidar
        Whether the LiDAR follows its schedule, or stays on or off.
    stamps
        Whether messages are stamped by sim time, from 0 on, or by the wall's.
    stamped_commands
        Take cmd_vel as TwistStamped, and not as Twist.
    magnetometer
        Say what its magnetometer reads, or leave that to magtwin ros magnetometer.
    """
    from magtwin.ros.simulate import Simulator
    from magtwin.twin import open_twin

    tell = announcer(quiet=False)
    tell(f"opening {scene}")
    twin = open_twin(scene, network=net, model_error=model_error)
    with where.bus("magtwin_sim", duration=duration) as bus:
        node = Simulator(
            twin,
            bus,
            seed=seed,
            session=session,
            speed=speed,
            rate_hz=rate_hz,
            units=units or UNITS[profile],
            lidar=lidar,
            stamps=stamps,
            stamped_commands=stamped_commands,
            magnetometer=magnetometer,
            say=tell,
        )
        tell(f"simulating by {bus.backend} at {speed:g} x real time; Ctrl-C ends")
        with progress("Simulating", "s") if duration else silence() as advance:

            def told() -> bool:
                if advance is not None:
                    advance(node.online.t, duration)
                return False

            node.run(told, duration_s=duration)


@ros_app.command(name="magnetometer")
def magnetometer(
    scene: Path,
    *settings: str,
    where: Where = HERE,
    net: Path | None = None,
    profile: Profile = "ros",
    duration: float | None = None,
) -> None:
    """Read a robot's sensors through map and network: the magnetometer alone, for any robot or simulator.

    It takes pose (/robot/enu/pose), odometry, IMU, battery and scans, as far as the network reads them, and
    publishes qtfm/magnitude and qtfm/total_field_nt while its inputs are fresh, and its state in
    /diagnostics.
    Inputs may come and go. Settings are those of ROS, name:=value: rate_hz (135), units (T or nT),
    use_sim_time, max_age_s (0.5), battery_max_age_s (30), lidar (scan, on or off), outside (silent or clamp).

    Parameters
    ----------
    scene
        USD stage that names the map, the network and the robot.
    settings
        Settings, such as units:=nT use_sim_time:=true.
    where
        Where the node stands.
    net
        Weights to use in place of the scene's.
    profile
        Conventions, unless settings say otherwise: ros, fields in tesla; aprilab, in nT, for programs written
        against APRILab's release.
    duration
        How long, by the wall [s]; without an end unless given.
    """
    from magtwin.ros.magnetometer import PARAMETERS, Magnetometer
    from magtwin.ros.parameters import settings as settings_of
    from magtwin.twin import open_twin

    values = settings_of(PARAMETERS, (f"units:={UNITS[profile]}", *settings))
    tell = announcer(quiet=False)
    tell(f"opening {scene}")
    twin = open_twin(scene, network=net, model_error=False)  # it predicts, for a robot that reads
    sim_time = values["use_sim_time"]
    with where.bus("magtwin_magnetometer", sim_time=sim_time, duration=duration) as bus:
        Magnetometer(twin, bus, values, say=tell)
        tell(f"reading by {bus.backend}; Ctrl-C ends")
        spin(bus, duration)


@ros_app.command(name="follow")
def follow(
    path: str,
    *,
    where: Where = HERE,
    robot: Path | None = None,
    speed: float = 0.2,
    controller: Literal["follower", "release", "stanley", "pure_pursuit"] = "follower",
    source: Literal["truth", "estimate", "odometry"] = "truth",
    laps: Whole = 1,
    continuous: bool = False,
    flip: bool = False,
    sim_time: bool = False,
    stamped_commands: bool = False,
) -> None:
    """Drive a robot along a path by its reported pose; it stops at the end, and while the pose is lost.

    Parameters
    ----------
    path
        Name of a path, or a CSV file of x, y [m].
    where
        Where the node stands.
    robot
        Asset of the robot, whose limits are kept; the TurtleBot 4 unless given.
    speed
        Forward speed where the path is straight [m/s].
    controller
        What steers: magtwin's, the released package's with its gain, Stanley's or pure pursuit.
    source
        What tells the pose: truth (enu/pose), estimate (estimate/pose) or odometry.
    laps
        How often to drive it; an open path is driven back and forth.
    continuous
        Drive on without an end.
    flip
        Drive it from its end to its beginning.
    sim_time
        Go by /clock, as when the robot is simulated.
    stamped_commands
        Send cmd_vel as TwistStamped, and not as Twist.
    """
    from magtwin.author.robot import read_robot
    from magtwin.files import shipped
    from magtwin.path import resolve_path
    from magtwin.ros.follow import Follower

    tell = announcer(quiet=False)
    way = resolve_path(path)
    drive = read_robot(robot or shipped("robots", "turtlebot4", "turtlebot4.usda")).drive
    with where.bus("magtwin_follow", sim_time=sim_time) as bus:
        node = Follower(
            way,
            drive,
            bus,
            speed=speed,
            controller=controller,
            source=source,
            laps=laps,
            continuous=continuous,
            flip=flip,
            stamped_commands=stamped_commands,
            say=tell,
        )
        tell(f"driving {way.name}, {way.length:.1f} m, by {bus.backend}; Ctrl-C ends")
        try:
            with progress(f"Driving {way.name}") as advance:
                while not node.done:
                    bus.spin_once(0.1)
                    advance(
                        node.progress.laps,
                        None if continuous else laps,
                        f"{node.progress.rms_m:.3f} m RMS off it",
                    )
        finally:
            node.stop()
            say(f"{node.progress.laps} times along {way.name}, {node.progress.rms_m:.3f} m RMS off it")


@ros_app.command(name="teleop")
def teleop(
    *,
    where: Where = HERE,
    robot: Path | None = None,
    gamepad: Path | None = None,
    out: Path | None = None,
    stamped_commands: bool = False,
    sim_time: bool = False,
    force: Force = False,
) -> None:
    """Drive a robot by hand, and record it on the way.

    Keys: w/s or up/down for speed, a/d or left/right for turning, x to go straight on, space to stop, q to
    end.

    Parameters
    ----------
    where
        Where the node stands.
    robot
        Asset of the robot, whose limits are kept; the TurtleBot 4 unless given.
    gamepad
        A gamepad of Linux to drive with, such as /dev/input/js0, in place of the keyboard: the left stick
        drives, Start ends.
    out
        Bag to record the robot's topics into, as magtwin ros record does.
    stamped_commands
        Send cmd_vel as TwistStamped, and not as Twist.
    sim_time
        Date messages by /clock, as when the robot is simulated.
    force
        Replace what exists.
    """
    from contextlib import ExitStack

    from magtwin.author.robot import read_robot
    from magtwin.cli.drive import device
    from magtwin.files import existing, shipped
    from magtwin.io.bags.raw import RawBagWriter
    from magtwin.ros.record import Recorder
    from magtwin.ros.teleop import Teleop
    from magtwin.sim.motion.manual import HELP, Gamepad, Hand, Keyboard

    if gamepad is not None:
        existing(gamepad, "gamepad")
    drive = read_robot(robot or shipped("robots", "turtlebot4", "turtlebot4.usda")).drive
    hand: Hand = Keyboard(drive) if gamepad is None else Gamepad(drive)
    with ExitStack() as stack:
        writer = None
        if out is not None:
            writer = RawBagWriter(out, force=force)
            stack.callback(writer.close)
        bus = stack.enter_context(where.bus("magtwin_teleop", sim_time=sim_time))
        recorder = None if writer is None else Recorder(bus, writer, say=_warn, sim_time=sim_time)
        source = stack.enter_context(device(gamepad))
        announcer(quiet=False)(HELP if gamepad is None else "left stick drives, Start ends")
        node = Teleop(bus, hand, source, stamped_commands=stamped_commands)
        with silence(), suppress(KeyboardInterrupt):
            node.run(recorder.step if recorder else lambda: None)
        node.stop()
    say(f"{node.sent} commands" + ("" if out is None else f"; wrote {out}"))


@ros_app.command(name="record")
def record(
    out: Path,
    *,
    topic: tuple[str, ...] = (),
    where: Where = HERE,
    duration: float | None = None,
    sim_time: bool = False,
    force: Force = False,
) -> None:
    """Record a robot's topics as a rosbag2, which is a run: magtwin convert, info, report and train take it.

    Topics may come and go; Ctrl-C ends.

    Parameters
    ----------
    out
        Folder to make, or a file that ends in .mcap or .db3.
    topic
        A topic to record; may be given several times. All of the robot's unless given.
    where
        Where the node stands.
    duration
        How long, by the wall [s]; without an end unless given.
    sim_time
        Date messages by /clock, as when the robot is simulated.
    force
        Replace what exists.
    """
    from magtwin.io.bags.raw import RawBagWriter
    from magtwin.ros.record import Recorder

    writer = RawBagWriter(out, force=force)
    try:
        with where.bus("magtwin_record", sim_time=sim_time, duration=duration) as bus:
            announcer(quiet=False)(f"recording by {bus.backend}; Ctrl-C ends")
            recorder = Recorder(bus, writer, topic, sim_time=sim_time, say=_warn)
            with progress("Recording", "messages") as advance:
                recorder.run(lambda: advance(sum(writer.counts.values()), None), duration_s=duration)
    finally:
        counts = dict(writer.counts)
        writer.close()
    if not sum(counts.values()):
        raise InputError("nothing was recorded: nobody offered a topic; look at --domain and --namespace")
    for name, count in counts.items():
        say(f"{count:8d}  {name}")
    say(f"Wrote {out}; magtwin info {out}")


@ros_app.command(name="replay")
def replay(
    run: Path,
    *,
    topic: tuple[str, ...] = (),
    scene: Path | None = None,
    where: Where = HERE,
    speed: float = 1.0,
    units: Literal["T", "nT"] = "T",
) -> None:
    """Publish a recorded run on its robot's ROS topics, in real time.

    Parameters
    ----------
    run
        A run of any format.
    topic
        A topic to say; may be given several times. All unless given.
    scene
        Scene that the run came from: gives frames, covariances, /tf_static and the robot's description.
    where
        Where the node stands.
    speed
        Sim time for each wall time.
    units
        Unit of fields: T, as ROS has them, or nT, as APRILab's robot publishes them.
    """
    from magtwin.io.formats import read_run
    from magtwin.ros.record import Player
    from magtwin.twin import open_twin

    if not speed > 0:
        raise InputError(f"speed must be above 0, got {speed!r}")
    whole = read_run(run)
    twin = None if scene is None else open_twin(scene, model_error=False)
    with where.bus("magtwin_replay") as bus:
        player = Player(whole, bus, twin, units=units, topics=topic)
        announcer(quiet=False)(
            f"replaying {whole['t'][-1] - whole['t'][0]:.0f} s by {bus.backend}; Ctrl-C ends"
        )
        step("Replaying")
        count = player.run(speed=speed)
    say(f"{count} messages")


def spin(bus: "Bus", duration_s: float | None) -> None:
    """Have a node do what it does, without an end or for a time by the wall [s]."""
    begin = time.monotonic()
    with progress("Reading", "s") if duration_s else silence() as advance:
        while duration_s is None or (gone := time.monotonic() - begin) < duration_s:
            bus.spin_once(0.1)
            if duration_s is not None:
                advance(gone, duration_s)


def _warn(text: str) -> None:
    announcer(quiet=False)(f"warning: {text}")
