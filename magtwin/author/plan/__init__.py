"""Floor plans: drawings and occupancy grids, made the TOML of a scene."""
