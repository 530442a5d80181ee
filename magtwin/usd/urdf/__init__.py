"""URDF to a USD articulation."""
