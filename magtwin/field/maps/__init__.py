"""Anomaly maps: the field by position and heading, its lookup, epochs and differences."""
