"""The harmonic fit: dipoles, a uniform field and a platform that explain a survey."""
