"""A custom map method: the mean of all readings."""

import numpy as np

import magtwin as mt
from magtwin.extend import map_method


class Constant:
    """A field that is the same everywhere."""

    method = "constant"

    def __init__(self, b_nt):
        self.mean_nt, self.noise_nt2 = float(b_nt.mean()), float(b_nt.var())
        self.variance_nt2 = self.noise_nt2 / len(b_nt)
        self.parameters = {"mean_nt": self.mean_nt}

    def predict(self, p_xy, yaw):
        shape = np.broadcast_shapes(np.shape(p_xy)[:-1], np.shape(yaw))
        return np.full(shape, self.mean_nt), np.full(shape, self.variance_nt2)


@map_method("constant")
def fit_constant(readings):
    return Constant(readings.b_nt[readings.good])


mt.simulate(mt.author_scene("lab", out="lab"), "lawnmower", rate_hz=5).save("drive.parquet")
print(mt.fit_map(mt.read_survey("drive.parquet"), method="constant", spacing_m=0.5))
