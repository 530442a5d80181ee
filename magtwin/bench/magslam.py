"""Recorded loops for SLAM without a map: the model ship and the hand-held loops.

Model ship: Viset, Helmons and Kok 2022, An extended Kalman filter for magnetic field SLAM using Gaussian
process regression, Sensors 22(8), 2833; files `Aligned_SquareLoop_1.mat` to `_4.mat` of
github.com/fridaviset/EKFMagSLAM, which has no licence. Hand-held: Kok and Solin 2024, Online one-dimensional
magnetic field SLAM with loop-closure detection, `eight.mat` and `square.mat`, MIT licence.
magtwin ships neither; give the folder that holds them.
"""

import io
import math
import os
import sys
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magtwin.bench.case import Case, Truth
from magtwin.errors import InputError
from magtwin.files.budget import check_decoded, decoded_limit
from magtwin.files.children import run
from magtwin.files.file import existing_file
from magtwin.frames import yaw_from_quat
from magtwin.localization.problem import OdometryModel, Prior, Problem, SensorModel
from magtwin.run.run import Run

Array = NDArray[np.float64]

_N = 1 << 60
"""Stands for the number of readings in shapes of arrays."""

SHIP_UNIT_NT = 50_000.0
"""Field that one unit of the ship's normalised readings is taken for [nT]. No result depends on it."""

SHIP_STEP_VARIANCE_M2, SHIP_HEIGHT_VARIANCE_M2, SHIP_TURN_VARIANCE = 1.01e-3, 1e-7, 1e-5
"""Variances of the ship's odometry a step, as published: x and y, z [m^2], each axis of rotation [rad^2]."""

SHIP_BIAS_M = (0.003, 0.003, 0.0)
"""Constant error of the ship's odometry a step, as published [m]."""

SHIP_NOISE, SHIP_LENGTH_M, SHIP_POTENTIAL_SD, SHIP_UNIFORM_SD = 0.1, 0.8, 1.0, 1.0
"""Published noise, length scale, sd of the potential and sd of the uniform field, in units of the ship."""

SHIP_FUNCTIONS = {1: 50, 2: 50, 3: 100, 4: 50}
"""Published number of eigenfunctions of each loop."""

HAND_LOOPS = ("eight", "square")
"""Names of the hand-held loops, by which a suite numbers them from 1."""

HAND_NOISE_NT = 2_000.0
"""Noise assumed for the hand-held loops [nT]."""

HAND_POSITION_STD_S, HAND_TURN_STD_S = 0.05, 1e-3
"""Random walks assumed for the odometry of the hand-held loops [m/sqrt(s), rad/sqrt(s)]."""


def ship_case(folder: str | os.PathLike[str], loop: int, seed: int) -> Case:
    """A loop of the model ship with the published random odometry.

    Each increment of the position in world axes is the true one plus the bias `SHIP_BIAS_M` and normal noise;
    each increment of the rotation in world axes is the true one plus normal noise. The start is known. The
    extent is that of the true positions, as published.

    Args:
        folder: Folder of the files.
        loop: 1 to 4.
        seed: Seed of the odometry's noise. An odd seed has the noise of the one before with the opposite sign
            (antithetic pairs), which makes means over an even number of seeds more precise.

    Raises:
        InputError: There is no such loop, or its file is missing or wrong.
    """
    if loop not in SHIP_FUNCTIONS:
        raise InputError(f"loop must be 1, 2, 3 or 4, got {loop}", parameter="loop")
    path = Path(folder) / f"Aligned_SquareLoop_{loop}.mat"
    data = _matlab(path, _SHIP)
    p, rotation, dt = data["p"].T, _rotation(data["q"].T, path), float(data["T"].item())
    if not dt > 0:
        raise InputError(
            f"{path}: the time 'T' between readings is {dt:g} s, not positive; get the file again"
        )
    y_nt = SHIP_UNIT_NT * data["y_mag"].T
    rng, sign = np.random.default_rng([loop, seed // 2]), 1 - 2 * (seed % 2)
    sd = np.sqrt([SHIP_STEP_VARIANCE_M2, SHIP_STEP_VARIANCE_M2, SHIP_HEIGHT_VARIANCE_M2])
    moved = np.diff(p, axis=0) + SHIP_BIAS_M + sign * sd * rng.standard_normal((len(p) - 1, 3))
    turned = (rotation[1:] * rotation[:-1].inv()).as_rotvec()
    turned += sign * math.sqrt(SHIP_TURN_VARIANCE) * rng.standard_normal(turned.shape)
    p0, R0 = data["p_0"][:, 0], _rotation(data["q_0"].T, path)[0]
    odom_p = np.vstack([p0, p0 + np.cumsum(moved, axis=0)])
    odom_q = _accumulated(R0, Rotation.from_rotvec(turned))
    problem = Problem(
        belief=None,
        extent=(p[:, 0].min(), p[:, 0].max(), p[:, 1].min(), p[:, 1].max()),
        prior=_start(p0, R0),
        sensor=_sensor(SHIP_NOISE * SHIP_UNIT_NT, drift_s=1.0),
        odometry=_odometry(math.sqrt(SHIP_STEP_VARIANCE_M2 / dt), math.sqrt(SHIP_TURN_VARIANCE / dt)),
        map_length_m=SHIP_LENGTH_M,
        rate_hz=1 / dt,
        seed=seed,
    )
    t = np.asarray(dt * np.arange(len(p)), float)
    return Case(problem, _readings(t, odom_p, odom_q, y_nt), _truth(t, p, rotation.as_quat()))


def ship_options(loop: int | None = None) -> dict[str, Any]:
    """The published settings as options of the SLAM methods.

    Args:
        loop: Also give the published number of functions of this loop.
    """
    options: dict[str, Any] = {
        "length_m": SHIP_LENGTH_M,
        "sd_nt": SHIP_POTENTIAL_SD / SHIP_LENGTH_M * SHIP_UNIT_NT,
        "uniform_sd_nt": SHIP_UNIFORM_SD * SHIP_UNIT_NT,
        "odometry_axes": "world",
    }
    if loop is not None:
        options["functions"] = SHIP_FUNCTIONS[loop]
    return options


def hand_case(folder: str | os.PathLike[str], name: str) -> Case:
    """A hand-held loop: smoothed visual-inertial odometry, three axes of a telephone.

    The files have no true pose. The reference is the telephone's own visual-inertial tracking, which corrects
    itself when it sees a place again (`dPos`); odometry is the same without these corrections
    (`dPosSmooth`). Orientations are those of the telephone in both. The magnetometer's axes are turned by
    90 deg about z from those of the orientation: of the 24 right-handed ways this one makes the field in
    world axes vary least, in both files.

    Args:
        folder: Folder of the files.
        name: "eight" or "square".

    Raises:
        InputError: There is no such loop, or its file is missing or wrong.
    """
    if name not in HAND_LOOPS:
        raise InputError(f"name must be eight or square, got {name!r}", parameter="name")
    path = Path(folder) / f"{name}.mat"
    data = _matlab(path, _HAND)
    start, t, rotation = data["initPos"][0], data["t"][:, 0], _rotation(data["quat"], path)
    if not (np.diff(t) > 0).all():
        raise InputError(f"{path}: the times 't' do not rise; get the file again")
    reference, odometry = (
        np.vstack([start, start + np.cumsum(data[key], axis=0)]) for key in ("dPos", "dPosSmooth")
    )
    x, y, z = 1e3 * data["m"].T  # from microtesla
    low, high = odometry.min(axis=0), odometry.max(axis=0)
    problem = Problem(
        belief=None,
        extent=(low[0], high[0], low[1], high[1]),
        prior=_start(start, rotation[0]),
        sensor=_sensor(HAND_NOISE_NT),
        odometry=_odometry(HAND_POSITION_STD_S, HAND_TURN_STD_S),
        map_length_m=SHIP_LENGTH_M,
        rate_hz=(len(t) - 1) / (t[-1] - t[0]),
    )
    readings = _readings(t, odometry, rotation.as_quat(), np.column_stack([-y, x, z]))
    return Case(problem, readings, _truth(t, reference, rotation.as_quat()))


_LOAD = """
import sys, numpy, scipy.io
try:
    import resource
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[2]) + 2**30, hard))
except (ImportError, ValueError):
    pass
read = scipy.io.loadmat(sys.argv[1], variable_names=sys.argv[3:])
arrays = {name: numpy.asarray(read[name]) for name in sys.argv[3:] if name in read}
plain = {name: array for name, array in arrays.items() if array.dtype.kind in "biuf"}
numpy.savez(sys.stdout.buffer, **plain)
"""
"""What the process of `_matlab` runs: from a file, a limit of memory and names to an npz of the arrays."""

_SHIP = {"p": (3, _N), "q": (4, _N), "p_0": (3, 1), "q_0": (4, 1), "T": (1, 1), "y_mag": (3, _N)}
_HAND = {"m": (_N, 3), "quat": (_N, 4), "t": (_N, 1), "initPos": (1, 3)}
_HAND |= dict.fromkeys(("dPos", "dPosSmooth"), (_N - 1, 3))
"""Shapes of the arrays in a file; `_N` stands for the number of readings."""

_LARGEST = 1e9
"""Bound of the numbers in a file: coordinates [m], fields [uT], times [s]."""


def _matlab(path: Path, shapes: Mapping[str, tuple[int, int]]) -> dict[str, Array]:
    """Arrays of a MATLAB file, of finite numbers and of these shapes, the first of which has `_N`.

    scipy reads it in a process of its own, which a damaged file can crash.
    """
    about = existing_file(path, "MATLAB file", "recording").stat()
    data = _numbers(path.resolve(), tuple(shapes), about.st_size, about.st_mtime_ns)
    arrays, readings = {}, 0
    for name, shape in shapes.items():
        if name not in data:
            raise InputError(f"{path}: has no array of numbers {name!r}")
        array = np.asarray(data[name], float)
        readings = readings or max(array.shape, default=0)
        wanted = tuple(readings + size - _N if size > _N // 2 else size for size in shape)
        if array.shape != wanted or readings < 3 or not (np.abs(array) < _LARGEST).all():
            raise InputError(
                f"{path}: array {name!r} of shape {array.shape} must hold numbers below {_LARGEST:g}, of "
                f"shape {wanted}, of 3 readings at least; get the file again"
            )
        arrays[name] = array
    return arrays


@lru_cache(4)
def _numbers(path: Path, names: tuple[str, ...], size: int, changed_ns: int) -> dict[str, Array]:
    """Arrays of numbers of a MATLAB file that had this size, and was changed at this time."""
    command = [sys.executable, "-P", "-c", _LOAD, str(path), str(decoded_limit(size)), *names]
    done = run(command, text=False, errors=None)
    if done.returncode:
        lines = done.stderr.decode(errors="replace").split("\n")
        reason = next((line.strip() for line in reversed(lines) if line.strip()), "the reader crashes on it")
        raise InputError(f"{path}: cannot be read as a MATLAB file ({reason}); get the file again")
    arrays = dict(np.load(io.BytesIO(done.stdout), allow_pickle=False))
    check_decoded(path, size, sum(8 * array.size for array in arrays.values()))  # they become doubles
    return arrays


def _rotation(wxyz: Array, path: Path) -> Rotation:
    if (abs(np.linalg.norm(wxyz, axis=1) - 1) > 0.01).any():
        raise InputError(f"{path}: a quaternion's length is not 1; get the file again")
    return Rotation.from_quat(wxyz[:, [1, 2, 3, 0]])


def _accumulated(first: Rotation, increments: Rotation) -> Array:
    """Orientations x, y, z, w after increments in world axes, shape (N + 1, 4)."""
    R = [first.as_matrix()]
    for increment in increments.as_matrix():
        R.append(increment @ R[-1])
    return np.asarray(Rotation.from_matrix(np.array(R)).as_quat())


def _start(p: Array, R: Rotation) -> Prior:
    m = R.as_matrix()
    return Prior(mean=(float(p[0]), float(p[1]), math.atan2(m[1, 0], m[0, 0])), sd=(1e-3, 1e-3, 1e-3))


def _sensor(noise_nt: float, drift_s: float = SensorModel.drift_s) -> SensorModel:
    """White noise, and an offset as large."""
    return SensorModel(white_nt=noise_nt, drift_nt=0.0, drift_s=drift_s, offset_nt=noise_nt)


def _odometry(position_std_s: float, yaw_std_s: float) -> OdometryModel:
    """Random walks over time alone."""
    none = dict.fromkeys(("position_std", "yaw_std", "turn_std", "scale_std"), 0.0)
    return OdometryModel(**none, position_std_s=position_std_s, yaw_std_s=yaw_std_s)


def _readings(t: Array, p: Array, q: Array, y_nt: Array) -> Run:
    return Run(
        {
            "t": t,
            "odom_p": p,
            "odom_q_xyzw": q,
            "b_measured_nt": np.linalg.norm(y_nt, axis=1),
            "b_vector_measured_nt": y_nt,
        }
    )


def _truth(t: Array, p: Array, q: Array) -> Truth:
    return Truth(t, np.column_stack([p[:, :2], np.unwrap(yaw_from_quat(q))]))
