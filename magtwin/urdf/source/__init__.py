"""The text of a robot description: XML, xacro, packages and settings."""
