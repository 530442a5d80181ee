"""Evaluation of magnetometer models: scores and error budgets."""
