"""Gazebo: what `<gazebo>` tags of a URDF say that URDF itself cannot, so far friction."""

from dataclasses import dataclass

from magtwin.names import RefusedError
from magtwin.usd.urdf.description import Description


@dataclass(frozen=True)
class Surface:
    """How a link's colliders touch."""

    friction: float = 0.5
    """Coulomb friction, static and sliding; USD's and Gazebo's engines differ in their own default."""

    restitution: float = 0.0
    """Part of the speed that comes back from a bounce."""


READ = ("mu1", "mu2")
"""Tags that are read: mu1 becomes the friction, mu2 (across it) has no place in UsdPhysics."""


def read_surfaces(description: Description) -> dict[str, Surface]:
    """Surfaces by link, from `<gazebo reference="LINK"><mu1>`.

    Every other tag is counted in a note.

    Raises:
        RefusedError: A friction is not a number, or below 0; the text gives the line.
    """
    surfaces, others = {}, 0
    for block in description.xml.findall("gazebo"):
        link, mu = block.get("reference", ""), block.find("mu1")
        if link in description.links and mu is not None:
            where = f"{description.path}:{description.lines[mu]}"
            try:
                friction = float(mu.text or "")
            except ValueError:
                friction = -1.0
            if not friction >= 0:
                raise RefusedError(f"{where}: mu1 of {link!r} must be a number not below 0, got {mu.text!r}")
            surfaces[link] = Surface(friction=friction)
        others += sum(child.tag not in READ for child in block)
    if others:
        description.note(f"{others} elements in <gazebo> tags are not converted; only mu1 is")
    others = len(description.xml.findall("transmission")) + len(description.xml.findall("ros2_control"))
    if others:
        description.note(f"{others} <transmission> and <ros2_control> tags are not converted")
    return surfaces
