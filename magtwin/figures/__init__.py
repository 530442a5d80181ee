"""Plots, pages, pictures and films."""
