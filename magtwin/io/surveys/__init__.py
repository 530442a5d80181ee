"""Surveys in tables and bags."""
