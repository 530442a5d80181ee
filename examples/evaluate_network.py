"""Compare the shipped networks with the naive model on runs that they never saw."""

import magtwin as mt

lab = mt.author_scene("lab", out="lab")
twin = mt.open_twin(lab, magnetometer="physical")
mt.sweep(twin, ["sine", "lawnmower", "figure8"], 6, seed=900, sessions=3, rate_hz=5).save("runs")

network = twin.scene.robot.magnetometer.network
evaluation = mt.evaluate(network, "runs", anomaly_map=twin.field, baseline="naive")
print(evaluation)
