"""Authoring: a scene from TOML or Python, a robot with its sensors."""
