"""Validation of stages: rules of magtwin, of Isaac Sim and of other validators."""
