"""Anomaly maps: the field by position and heading, its lookup and differences."""
