"""Authoring and reading USD."""
