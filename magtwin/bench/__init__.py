"""The testbed: localizers on scenarios, their metrics, results and reports."""
