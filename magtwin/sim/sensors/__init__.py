"""Sensors of a robot, one module each."""
