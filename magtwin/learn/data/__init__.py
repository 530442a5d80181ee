"""Data that models learn from: features, labels, splits."""
