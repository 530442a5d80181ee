"""Filters on grids of poses: the point-mass filter, and banks of Kalman filters."""
