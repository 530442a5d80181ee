"""The field of a lab: maps, surveys, magnetised things, the Earth."""
