"""Extensions: what is read of `<gazebo>` tags, as one table, beside that of URDF in `vocabulary`.

Sources: SDFormat's URDF extensions (sdformat.org); the documentation of gz-sim's DiffDrive, MecanumDrive and
AckermannSteering, and of gazebo_plugins' diff_drive, skid_steer_drive, planar_move and ackermann_drive.
"""

from collections.abc import Mapping
from dataclasses import dataclass

MODULES: Mapping[str, str] = {
    "plugin": "magtwin.urdf.physics.controller",
    "sensor": "magtwin.urdf.equipment",
    "drive": "magtwin.urdf.physics.contact",
    "proof": "magtwin.urdf.proof",
}
"""Module that reads a tag below `<gazebo>`, or that a drive or a proof needs; loaded only then."""


@dataclass(frozen=True)
class Figure:
    """A number of a tag."""

    paths: tuple[str, ...]
    """Paths below the tag; the first that is there counts."""

    least: float = -float("inf")
    """A smaller number is raised to it."""

    above: float = -float("inf")
    """A number that is not above it counts as not given."""


SURFACE: Mapping[str, Figure] = {
    "friction": Figure(("mu1", "mu", "collision/surface/friction/ode/mu"), least=0.0),
    "across": Figure(("mu2", "collision/surface/friction/ode/mu2"), least=0.0),
    "restitution": Figure(("collision/surface/bounce/restitution_coefficient",), least=0.0),
    "stiffness": Figure(("kp", "collision/surface/contact/ode/kp"), least=0.0),
    "damping": Figure(("kd", "collision/surface/contact/ode/kd"), least=0.0),
}
"""Of `<gazebo reference="LINK">`."""

DRIVE: Mapping[str, Figure] = {
    "wheel_separation_m": Figure(("wheel_separation", "wheelSeparation"), above=0.0),
    "wheel_radius_m": Figure(("wheel_radius",), above=0.0),
    "wheel_diameter_m": Figure(("wheel_diameter", "wheelDiameter"), above=0.0),
    "wheelbase_m": Figure(("wheel_base", "wheelbase"), above=0.0),
    "steering_limit": Figure(("steering_limit", "max_steer"), above=0.0),
    "v_max": Figure(("max_linear_velocity", "max_velocity", "max_speed"), above=0.0),
    "w_max": Figure(("max_angular_velocity",), above=0.0),
    "alpha_max": Figure(("max_angular_acceleration",), above=0.0),
    "a_max": Figure(
        ("max_linear_acceleration", "max_acceleration", "max_wheel_acceleration", "wheelAcceleration"),
        least=0.0,
    ),
    "odometry_rate_hz": Figure(
        ("odom_publish_frequency", "odometry_rate", "odometryRate", "update_rate", "updateRate"), least=0.0
    ),
}
"""Of a drive plugin; 0 counts as not given."""

SIDES = (("left_joint", "leftJoint"), ("right_joint", "rightJoint"))
CORNERS = (
    ("front_left_joint", "leftFrontJoint"),
    ("front_right_joint", "rightFrontJoint"),
    ("back_left_joint", "rear_left_joint", "leftRearJoint"),
    ("back_right_joint", "rear_right_joint", "rightRearJoint"),
)
STEERED = ("left_steering_joint", "right_steering_joint")
PLUGINS = (
    (("diff_drive", "diff-drive", "diffdrive"), "differential", SIDES),
    (("skid_steer", "skid-steer", "skidsteer"), "skid-steer", CORNERS),
    (("mecanum-drive", "mecanumdrive"), "mecanum", CORNERS),
    (("ackermann", "ackermannsteering"), "car", (*CORNERS[2:], *SIDES)),
    (("planar_move", "planar-move", "velocity-control"), "holonomic", CORNERS),
)
"""Kinds of drive plugins: words in its name or file, steering, and tags of each wheel's joint."""
