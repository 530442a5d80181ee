"""URDF to USD articulation and back."""

from magtwin.urdf.convert import convert_urdf
from magtwin.usd.robot import read_notes

__all__ = ["convert_urdf", "read_notes"]
