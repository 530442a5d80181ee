"""The simulator: kinematics, controllers, sensors, the platform's own field."""
