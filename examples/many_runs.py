"""Simulate many runs over several sessions, and save them as a data set."""

import magtwin as mt

twin = mt.open_twin(mt.author_scene("lab", out="lab"))
runs = mt.sweep(twin, ["sine", "figure8"], 6, sessions=3, duration_s=20, rate_hz=10)
print(runs.save("runs"))
print(mt.load_run("runs/run_00000.parquet"))
