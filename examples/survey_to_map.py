"""Fit a map to a survey, and look up the field with its standard deviation."""

import magtwin as mt

twin = mt.open_twin(mt.author_scene("lab", out="lab"), magnetometer="physical")
mt.simulate(twin, "lawnmower", session="survey", rate_hz=2, seed=2).save("drive.parquet")

survey = mt.read_survey("drive.parquet")  # also CSV, bags and folders of runs
field = mt.fit_map(survey, method="gp")
field.save("map.usdc")
mean, sd = field.lookup_with_sd([[0.0, 0.0], [1.0, 0.5]], [0.0, 1.57])
print(field)
print(f"{mean[0]:.0f} nT, standard deviation {sd[0]:.0f} nT at the origin")
