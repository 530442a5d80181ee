"""Roles: which topic of a recording is the field, the pose, the odometry and so on.

By the type of its messages, then by its name. All words are data, in `ROLES`.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from re import findall
from typing import TYPE_CHECKING

from magtwin.errors import InputError, find
from magtwin.io.bags.topics import (
    BATTERY,
    COMMAND,
    IMU,
    MAGNITUDE,
    ODOMETRY,
    PATH_KIND,
    POSE,
    SCAN,
    VECTOR,
    Topic,
)

if TYPE_CHECKING:
    from magtwin.io.bags.bag import Bag

LEAST = 2  # Messages from which a topic is a stream. One with fewer has a role only if there is no stream.
NUMBERS = ("f4", "f8")  # Kinds of leaves that can be a field


@dataclass(frozen=True, kw_only=True)
class Role:
    """How the topic of a role is found. Words are beginnings of words in the name of a topic."""

    noun: str
    kinds: tuple[str, ...] = ()  # Message types of this role alone
    named: str = ""  # Words that make a topic of another readable type one of the role
    never: str = ""  # Words of topics that are not of the role
    # Words by rank; topics with a word of an earlier rank go before. "*" is the rank of other topics.
    ranks: tuple[str, ...] = ()
    option: str = ""  # Option that chooses. Default: --remap.
    position: str = ""  # Column of the position of the child frame in that of the header, which is still
    orientation: str = ""  # Orientation of the child frame; without `position`, that of the header
    twist: tuple[str, ...] = ()  # Linear and angular velocity in the child frame
    vectors: tuple[str, ...] = ()  # Vectors in the frame of the header, which is a part of the robot

    def rank(self, name: str) -> int:
        """The rank of a topic by its name, 0 is best."""
        others = self.ranks.index("*") if "*" in self.ranks else len(self.ranks)
        return next((k for k, words in enumerate(self.ranks) if _has(name, words)), others)


TRUE = "vicon mocap optitrack qualisys qtm vrpn natnet truth groundtruth gt leica prism rtk vision simpose"
ESTIMATED = (
    "amcl slam ekf ukf estimate estimated localization localizer odom odometry fused filtered vio vo lio"
)
ROLES: Mapping[Topic, Role] = {
    MAGNITUDE: Role(
        noun="field",
        kinds=(MAGNITUDE.kind, "px4_msgs/msg/VehicleMagnetometer", "px4_msgs/msg/SensorMag"),
        named="mag compass field bfield b_field tesla gauss qtfm fluxgate",
        never="bias offset covariance calib heading hdg temp status std error gain declination image "
        "sensitivity gyro accel acceleration velocity force magtwin",
        ranks=("magnitude total scalar", "*", "raw uncal"),
        option="--field-topic",
        vectors=("magnetic_field",),
    ),
    VECTOR: Role(noun="vector field", kinds=(VECTOR.kind,), never="bias offset covariance calib"),
    POSE: Role(
        noun="pose",
        kinds=tuple(kind for kind in POSE.reads if kind not in ODOMETRY.reads),
        named=TRUE,
        never="goal target initial initialpose setpoint waypoint clicked desired reference cmd command plan",
        ranks=(TRUE, "*", ESTIMATED),
        option="--pose-topic",
        position="mocap_p",
        orientation="mocap_q_xyzw",
    ),
    ODOMETRY: Role(
        noun="odometry",
        kinds=(ODOMETRY.kind, "px4_msgs/msg/VehicleOdometry"),
        never=f"{TRUE} gps global",
        position="odom_p",
        orientation="odom_q_xyzw",
        twist=("odom_v", "odom_w"),
        ranks=(
            "filtered ekf ukf fused",
            "*",
            "wheel wheels raw visual laser lidar encoder rf2o icp vo lio t265 zed rgbd",
        ),
    ),
    IMU: Role(
        noun="IMU",
        kinds=(IMU.kind, "px4_msgs/msg/SensorCombined"),
        orientation="imu_q_xyzw",
        vectors=("imu_w", "imu_a"),
        ranks=("*", "raw", "camera realsense d435 d455 t265 zed oak lidar ouster livox velodyne mag"),
    ),
    BATTERY: Role(noun="battery", kinds=(BATTERY.kind,)),
    COMMAND: Role(
        noun="commands",
        named="cmd command",
        ranks=("*", "unstamped stamped", "nav teleop joy smooth smoothed raw safe mux out in setpoint"),
    ),
    SCAN: Role(
        noun="scan", kinds=(SCAN.kind,), ranks=("*", "filtered front", "rear back left right depth camera")
    ),
}
"""Topics that are read from a robot's recording."""

VITAL = (MAGNITUDE, POSE, ODOMETRY, VECTOR)  # A fault of others leaves them out with a warning


def role_of(columns: Iterable[str]) -> Role | None:
    """The role of messages of some columns; None if none has axes, as a magnitude or a scan's time."""
    moved = (role for role in ROLES.values() if role.position or role.vectors)
    return next((role for role in moved if {role.position or role.vectors[0]} & set(columns)), None)


def _words(name: str) -> list[str]:
    """Words of a topic's name, and its parts."""
    name = name.lower()
    return [*findall("[a-z]+[0-9]*", name), *name.strip("/").split("/")]


def _has(name: str, words: str) -> bool:
    """Whether a name has one of some words, or a word that begins with one of four letters or more."""
    known = words.split()
    long = tuple(word for word in known if len(word) > 2)
    return any(word in known or (word.startswith(long) if long else False) for word in _words(name))


def candidates(role: Topic, bag: "Bag", taken: Collection[str] = ()) -> list[str]:
    """The topics of a bag that can have a role, by their types and names."""
    sought = ROLES[role]
    names = [name for name in bag.kinds if name not in taken and not _has(name, sought.never)]
    alone = [name for name in names if bag.kinds[name] in sought.kinds]
    named = [name for name in names if name not in alone and _has(name, sought.named)]
    named = [name for name in named if can_be(role, bag, name)]
    if role is POSE:
        poses = [name for name in alone + named if bag.kinds[name] != PATH_KIND]
        driven = [] if {ODOMETRY.kind} & {*bag.kinds.values()} else alone
        return poses or driven
    return alone or named


def chosen(role: Topic, names: Collection[str], near: str = "") -> list[str]:
    """The topics of the best rank; of several, the one in the namespace of another topic."""
    ranks = {name: ROLES[role].rank(name) for name in names}
    best = [name for name in names if ranks[name] == min(ranks.values())]
    space = near.strip("/").split("/")[0]
    inside = [name for name in best if space and name.strip("/").split("/")[0] == space]
    usual = [name for name in best if name.rpartition("/")[2] == role.name.rpartition("/")[2]]
    robots = [name for name in best if _has(name, "robot base body vehicle rover")]
    for fewer in (inside, usual, robots if role is POSE else []):
        if len(best) > 1 and len(fewer) == 1:
            best = fewer
    return best


def can_be(role: Topic, bag: "Bag", name: str) -> bool:
    """Whether the type of a topic's messages can give the columns of a role."""
    try:
        kind, reading = bag.kinds[name], reads_of(role, bag, name)
        if kind == PATH_KIND:
            return role is POSE
        known = {leaf.name for leaf in bag.layout(name)} if kind in reading.reads else set()
        return bool(known) and known.issuperset(reading.leaves(kind))
    except Exception:
        return False


def reads_of(role: Topic, bag: "Bag", name: str) -> Topic:
    """The role with what it reads of a topic, whose type may be one that only the bag defines.

    A field is a vector of three numbers, or else the only number of a message.
    """
    kind = bag.kinds[name]
    if kind in role.reads or role not in (MAGNITUDE, VECTOR) or not kind:
        return role
    leaves = {leaf.name: leaf for leaf in bag.layout(name) if leaf.kind in NUMBERS}
    threes = [leaf for leaf in leaves if leaves[leaf].count == 3]
    begins = [leaf[:-1] for leaf in leaves if leaf == "x" or leaf.endswith((".x", "_x"))]
    axes = [(begin + "x", begin + "y", begin + "z") for begin in begins]
    axes = [three for three in axes if leaves.keys() >= set(three)]
    found = _best(threes) or (axes[0] if len(axes) == 1 else None)
    if found is None and role is MAGNITUDE:
        found = _best([leaf for leaf in leaves if leaves[leaf].count == 1])
    if found is None:
        return role
    return replace(role, reads={**role.reads, kind: {"magnetic_field": found}})


def _best(leaves: list[str]) -> str | None:
    """The only leaf, or the only one that is named as a field."""
    named = [leaf for leaf in leaves if _has(leaf.replace(".", "/"), ROLES[MAGNITUDE].named)]
    return leaves[0] if len(leaves) == 1 else named[0] if len(named) == 1 else None


def check_roles(topics: Iterable[str]) -> None:
    """Refuse topics that are not those of roles, by their names in `TOPICS`."""
    for name in topics:
        find("topic", name, {topic.name: topic for topic in ROLES})


def check_kind(role: Topic, bag: "Bag", name: str) -> None:
    """Refuse a topic that was chosen for a role and is missing or of another type."""
    if name not in bag.kinds:
        raise bag.missing(name)
    if not can_be(role, bag, name):
        fit = " or ".join(role.reads)
        kind = bag.kinds[name] or "message without a type"
        raise InputError(f"{bag.path}: topic {name} is a {kind}; it must be {fit}")
