"""Localization on the magnetic field: protocols, filters, smoothers, bounds and scores."""
