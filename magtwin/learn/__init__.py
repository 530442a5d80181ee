"""The neural magnetometer: features, networks, training, prediction."""
