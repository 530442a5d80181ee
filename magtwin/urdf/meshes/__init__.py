"""Mesh files of a robot description, and their colliders."""
