"""Anomaly maps as USD layers: in memory or in tiles, with epochs and a coloured floor."""
