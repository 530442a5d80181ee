"""URDF to a USD articulation: `convert_urdf` is the door, one noun a module behind it."""
