"""Commands on anomaly maps."""
