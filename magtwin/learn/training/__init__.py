"""Training of magnetometer models: configuration, data, fitters, results."""
