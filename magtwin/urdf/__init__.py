"""URDF to USD articulation and back."""

from magtwin.urdf.convert import convert_urdf, read_notes

__all__ = ["convert_urdf", "read_notes"]
