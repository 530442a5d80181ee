"""Rerun recordings: written, read and shown."""
