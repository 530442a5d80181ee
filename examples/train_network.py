"""Label recordings on a map, and train a magnetometer model on them."""

import magtwin as mt

twin = mt.open_twin(mt.author_scene("lab", out="lab"), magnetometer="physical")
mt.sweep(twin, seeds=10, sessions=5, duration_s=60, rate_hz=5).save("drives")

dataset = mt.build_dataset("drives", out="set", anomaly_map=twin.field, alignment="fit")
result = mt.train(dataset, model="linear", features="platform", out="model.safetensors")
print(result)
print(mt.load_predictor("model.safetensors"))
