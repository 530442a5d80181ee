"""Runs: one robot, many robots, robots that share a lab, live robots."""
