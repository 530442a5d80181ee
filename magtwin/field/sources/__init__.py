"""Sources of a field: the Earth, magnetised bodies and point dipoles."""
