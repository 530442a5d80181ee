"""Report: numbers with units and spread, displays of objects, and verdicts on models."""
