"""What moves a robot: the kinematic engine, Newton, or a recorded run."""
