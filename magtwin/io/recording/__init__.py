"""Recordings: what a robot recorded, as roles, frames and one timeline."""
