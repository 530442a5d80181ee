"""Run: one table on one clock; resampling and comparison."""
