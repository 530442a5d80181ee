"""The preset "magnav" on the arrays of MagNav.jl's own test, test/test_data/test_data_TL.mat there.

python benchmarks/tolles_lawson.py test_data_TL.mat
"""

import sys

import numpy as np
from scipy.io import loadmat
from scipy.signal import detrend

from magtwin.learn.compensation.tolles_lawson import design_matrix, fit_tolles_lawson

PENALTY = 1e-3
"""Of MagNav.jl's test."""


def main() -> None:
    if len(sys.argv) < 2:
        print("give the path of MagNav.jl's test_data_TL.mat")
        return
    data = loadmat(sys.argv[1], squeeze_me=True)["TL_data"]
    array = {name: np.asarray(data[name].item(), float) for name in data.dtype.names}
    b = np.column_stack([array[f"flux_a_{axis}"] for axis in "xyz"])
    readings, rate_hz = array["mag_1_uc"], float(array["fs"])
    matrix, _ = design_matrix(b, rate_hz, preset="magnav")
    print(f"regressors: largest relative difference {np.abs(matrix / array['A_a'] - 1).max():.1e}")
    for preset in ("magnav", "magtwin"):
        ridge = PENALTY if preset == "magnav" else None
        model = fit_tolles_lawson(readings, b, rate_hz, ridge=ridge, preset=preset)
        modelled = model.interference_nt(b, rate_hz)
        plain = np.std(readings - modelled - array["mag_1_c"])
        detrended = np.std(readings - detrend(modelled) - array["mag_1_c_d"])
        print(f"{preset}: compensated readings differ by {plain:.3f} nT, detrended by {detrended:.3f} nT")


if __name__ == "__main__":
    main()
