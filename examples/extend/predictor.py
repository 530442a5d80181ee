"""A custom kind of predictor: the mean label, whatever the robot does."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

import magtwin as mt
from magtwin.extend import predictor
from magtwin.learn.data.inputs import inputs_from, inputs_of, scaler_tensors
from magtwin.learn.models.predictor import Fit, Predictor


@dataclass(kw_only=True, repr=False)
class Mean(Predictor):
    """A constant disturbance with a constant standard deviation."""

    values: np.ndarray
    """Mean and standard deviation of the labels [nT]."""

    kind: ClassVar[str] = "mean"
    layers_text, parameters_count = "a constant", 2

    def predict(self, x):
        return tuple(np.full(len(x), value) for value in self.values)

    def tensors(self):
        return {**self.inputs.tensors(), "values": self.values}

    def settings(self):
        return {}

    def figures(self):
        return []


@predictor("mean")
class MeanKind:
    """How `Mean` is fitted and loaded."""

    description, options = "The mean label", {"features": "circular"}

    @staticmethod
    def fit(task):
        inputs = inputs_of(task.train.x, task.features)
        return Fit(Mean(inputs=inputs, values=np.array([task.train.y.mean(), task.train.y.std()])))

    @staticmethod
    def load(weights):
        like = {**scaler_tensors(len(weights.features)), "values": np.ones(2)}
        tensors = weights.fit(like)
        inputs = inputs_from(weights.features, tensors, weights.path)
        return Mean(inputs=inputs, values=tensors["values"])


twin = mt.open_twin(mt.author_scene("lab", out="lab"), magnetometer="physical")
mt.sweep(twin, seeds=6, sessions=3, duration_s=20, rate_hz=5).save("drives")
dataset = mt.build_dataset("drives", out="set", anomaly_map=twin.field)
mt.train(dataset, model="mean", out="mean.safetensors")
print(mt.load_predictor("mean.safetensors"))
