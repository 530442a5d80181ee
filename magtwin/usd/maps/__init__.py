"""Anomaly maps as USD layers, with a coloured floor."""
