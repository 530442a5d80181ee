"""URDF to a USD articulation: `convert_urdf` is the door, one noun a module behind it."""

from magtwin.urdf.convert import convert_urdf, read_notes

__all__ = ["convert_urdf", "read_notes"]
