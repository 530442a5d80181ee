"""Compensation of the platform's field by linear models of its attitude."""
