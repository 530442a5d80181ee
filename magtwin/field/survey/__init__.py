"""Surveys: readings at known poses, gridded surveys, stuck and outlying readings."""
