"""Drive the shipped lab's robot along a path, and save the run in three formats."""

import magtwin as mt

twin = mt.open_twin(mt.author_scene("lab", out="lab"))
run = mt.simulate(twin, "lawnmower", session=0, seed=1)
print(run)
for suffix in (".rrd", ".parquet", ".mcap"):
    run.save(f"run{suffix}", twin=twin)
error = run["b_measured_nt"] - run["b_map_nt"]
print(f"Disturbance: {error.mean():.0f} nT on average, {error.std():.0f} nT standard deviation")
