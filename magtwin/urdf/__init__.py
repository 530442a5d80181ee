"""URDF to USD articulation and back."""
