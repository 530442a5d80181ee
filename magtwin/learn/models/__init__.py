"""Magnetometer models and their weights."""
