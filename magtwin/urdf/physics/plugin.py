"""Plugin: the mobile base that a Gazebo plugin defines.

Follows the documentation of gz-sim's DiffDrive, MecanumDrive and AckermannSteering, and of gazebo_plugins'
diff_drive, skid_steer_drive, planar_move and ackermann_drive.
"""

from dataclasses import dataclass

from magtwin.errors import InputError, hint
from magtwin.urdf.description.tag import Element, Tags
from magtwin.urdf.physics.mobile_base import Kind, MobileBase


@dataclass(frozen=True)
class _Plugin:
    """A kind of plugin."""

    words: tuple[str, ...]
    """Words in its name or file."""

    kind: Kind

    wheels: tuple[tuple[str, ...], ...]
    """Tags of each wheel's joint; the first that is there counts. May be repeated."""

    required: bool = True
    """Whether the wheels must be there."""


DIFFERENTIAL = (("left_joint", "leftJoint"), ("right_joint", "rightJoint"))
CORNERS = (
    ("front_left_joint", "leftFrontJoint"),
    ("front_right_joint", "rightFrontJoint"),
    ("back_left_joint", "rear_left_joint", "leftRearJoint"),
    ("back_right_joint", "rear_right_joint", "rightRearJoint"),
)
PLUGINS = (
    _Plugin(("diff_drive", "diff-drive", "diffdrive"), "differential", DIFFERENTIAL),
    _Plugin(("skid_steer", "skid-steer", "skidsteer"), "skid-steer", CORNERS),
    _Plugin(("mecanum-drive", "mecanumdrive"), "mecanum", CORNERS),
    _Plugin(("ackermann", "ackermannsteering"), "car", (*CORNERS[2:], *DIFFERENTIAL)),
    _Plugin(("planar_move", "planar-move", "velocity-control"), "holonomic", CORNERS, required=False),
)

FIGURES = {
    "wheel_separation_m": ("wheel_separation", "wheelSeparation"),
    "wheel_radius_m": ("wheel_radius",),
    "v_max": ("max_linear_velocity", "max_velocity", "max_speed"),
    "w_max": ("max_angular_velocity",),
    "alpha_max": ("max_angular_acceleration",),
}
OR_ZERO = {
    "a_max": ("max_linear_acceleration", "max_acceleration", "max_wheel_acceleration", "wheelAcceleration"),
    "odometry_rate_hz": (
        "odom_publish_frequency",
        "odometry_rate",
        "odometryRate",
        "update_rate",
        "updateRate",
    ),
}
"""Names of each parameter in a plugin; 0 leaves out those in OR_ZERO."""

DIAMETER = ("wheel_diameter", "wheelDiameter")
WHEELBASE, STEERING = ("wheel_base", "wheelbase"), ("steering_limit", "max_steer")
STEERED = ("left_steering_joint", "right_steering_joint")


def base_of_plugin(tags: Tags) -> MobileBase | None:
    """The mobile base that a plugin of the description defines; None if none does, or not completely."""
    for block in tags.blocks("gazebo"):
        for plugin in block.findall("plugin"):
            label = f"{plugin.get('name', '')} {plugin.get('filename', '')}".lower()
            filename = plugin.get("filename", "").lower()
            for kind in PLUGINS:
                # The file decides where it is one of these; else the name, which users choose.
                if any(word in filename for word in kind.words) or (
                    not _known(filename) and any(word in label for word in kind.words)
                ):
                    try:
                        return _base(tags, tags.read(plugin), kind)
                    except IncompleteDriveError as error:
                        leave_out(tags, plugin, error)
                        return None
    return None


class IncompleteDriveError(InputError):
    """A drive that lacks a joint; `element` is the tag with the fault."""

    def __init__(self, text: str, element: Element) -> None:
        super().__init__(text)
        self.element = element


def leave_out(tags: Tags, element: Element | None, error: InputError) -> None:
    """Report a drive that cannot be used, and let its tag be kept as text."""
    about = error.element if isinstance(error, IncompleteDriveError) else element
    tags.description.repair("drive-incomplete", f"{error}: the drive is kept as text", about)
    if element is not None:
        tags.forget(element)


def known_joint(tags: Tags, name: str, element: Element) -> str:
    """`name`, if a joint has it.

    Raises:
        IncompleteDriveError: None has.
    """
    names = tags.description.joint_names
    if name not in names:
        raise IncompleteDriveError(f"<{element.tag}>: no joint {name!r}; {hint(name, names)}", element)
    return name


def _known(filename: str) -> bool:
    return any(word in filename for plugin in PLUGINS for word in plugin.words)


def _base(tags: Tags, plugin: Element, kind: _Plugin) -> MobileBase:
    """The base of a plugin."""
    where, wheels = tags.description.where(plugin), list[str]()
    for names in kind.wheels:
        elements = [e for name in names for e in tags.findall(plugin, name)]
        wheels += [known_joint(tags, (e.text or "").strip(), e) for e in elements]
    if kind.required and len(wheels) < 2:
        tag = next(n[0] for n in kind.wheels if not any(plugin.find(name) is not None for name in n))
        raise IncompleteDriveError(f"the drive plugin has no <{tag}>", plugin)
    steered = [e for name in STEERED for e in tags.findall(plugin, name)] if kind.kind == "car" else []
    figures = {field: tags.number(plugin, *names, above=0.0) for field, names in FIGURES.items()}
    figures |= {field: tags.number(plugin, *names, least=0.0) or None for field, names in OR_ZERO.items()}
    diameter, wheelbase = (
        tags.number(plugin, *DIAMETER, above=0.0),
        tags.number(plugin, *WHEELBASE, above=0.0),
    )
    if figures["wheel_radius_m"] is None and diameter is not None:
        figures["wheel_radius_m"] = diameter / 2
    separation = figures["wheel_separation_m"]
    if kind.kind == "mecanum" and separation is not None:
        figures["wheel_separation_m"] = None if wheelbase is None else separation + wheelbase
    return MobileBase(
        kind="skid-steer" if kind.kind == "differential" and len(set(wheels)) > 2 else kind.kind,
        source=f"the plugin at {where.rpartition('/')[2]}",
        element=plugin,
        wheels=tuple(dict.fromkeys(wheels)),
        steered=tuple(known_joint(tags, (e.text or "").strip(), e) for e in steered),
        figures={name: figure for name, figure in figures.items() if figure is not None},
        wheelbase_m=wheelbase,
        steering_limit=tags.number(plugin, *STEERING, above=0.0),
    )
