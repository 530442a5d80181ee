"""Mixed models: linear models whose coefficients differ between sessions."""
