"""Where runs go: tables, Rerun recordings, pictures."""
