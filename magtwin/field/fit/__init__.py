"""Maps from readings: interpolation, Gaussian process, and the checks of a fit."""
