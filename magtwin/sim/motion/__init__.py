"""Motion of a robot: paths, controllers, drive and closed loop."""
