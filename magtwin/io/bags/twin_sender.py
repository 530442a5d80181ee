"""The sender of a twin's robot, with the links and the description of its asset."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magtwin.errors import InputError
from magtwin.frames import quat_from_rpy
from magtwin.io.bags.sender import FixedFrame, Sender, Unit, WheelJoint, sender_of

if TYPE_CHECKING:
    from magtwin.twin import Twin

FOOTPRINT = "base_footprint"  # Name of the frame below base_link on the floor, as in REP 120


def sender_for(twin: "Twin | None", unit: Unit, rate_hz: Any = None) -> Sender:
    """The sender of a twin's robot; without a twin, a robot of default frames and unknown noise."""
    if unit not in ("T", "nT"):
        raise InputError(f'units of a bag must be "T" or "nT", got {unit!r}')
    if twin is None:
        return Sender(unit=unit)
    from magtwin.author.robot import read_description
    from magtwin.usd.geometry import BASE_LINK, read_links
    from magtwin.usd.robot import description_names

    robot = twin.scene.robot
    links, names = description_names(robot.asset)
    sides, senses = robot.drive.sides, dict[str, int]()
    frames: dict[str, FixedFrame] = {}  # by joint; links that do not turn by name
    for link in read_links(robot.asset).values():
        if link.name != BASE_LINK:
            axis = link.rolling_axis or (0.0, 0.0, 1.0)
            name = links.get(link.name, link.name)
            frame = FixedFrame(BASE_LINK, name, link.p_base_link, link.q_base_link_xyzw, axis)
            frames[link.joint if link.joint in sides else f"/{name}"] = frame
            senses[link.joint] = link.sense
    wheels = tuple(frames.pop(joint) for joint in sides if joint in frames)
    joints = (WheelJoint(names.get(n, n), side, senses.get(n, 1)) for n, side in sides.items())
    description = read_description(robot.asset)
    below = _footprint(description) if f"/{FOOTPRINT}" not in frames else ()
    mounts = {"magnetometer": robot.magnetometer, "imu": robot.imu, "lidar": robot.lidar}
    called: dict[str, Any] = {
        n: replace(mount, link=links.get(mount.link, mount.link)) for n, mount in mounts.items()
    }
    return sender_of(
        replace(robot, **called),
        unit=unit,
        rate_hz=float(rate_hz) if isinstance(rate_hz, int | float) and rate_hz > 0 else None,
        links=(*frames.values(), *below),
        wheels=wheels if len(wheels) == len(sides) else (),
        wheel_joints=tuple(joints),
        description=description,
    )


def _footprint(description: str) -> tuple[FixedFrame, ...]:
    """The frame base_footprint of a URDF whose root is base_link. It has no body, so stages have no link."""
    if not description:
        return ()
    from magtwin.urdf.description.model import origin_numbers
    from magtwin.urdf.source.markup import parse_markup

    for joint in parse_markup(description.encode(), Path("robot_description")).root.findall("joint"):
        ends = [element.get("link") for element in (*joint.findall("parent"), *joint.findall("child"))]
        if joint.get("type") == "fixed" and ends == ["base_link", FOOTPRINT]:
            origin = joint.find("origin")
            xyz, rpy, given = origin_numbers(joint if origin is None else origin)
            q = quat_from_rpy(rpy) if given is None else given
            return (FixedFrame("base_link", FOOTPRINT, tuple(xyz.tolist()), tuple(q.tolist())),)
    return ()
