"""Reader: one reading at a time, for a robot that drives now.

Features are plain numbers here, and the map and the network run in compiled code. A predictor without a
compiled path predicts its one row as usual, which gives the same numbers more slowly.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magtwin.compiled import Loops
from magtwin.errors import InputError, hint
from magtwin.field.maps import lookup
from magtwin.field.maps.map import AnomalyMap, Outside
from magtwin.learn.data.features import (
    FEATURES,
    carried,
    circle,
    degrees_0_360,
    lags,
    turned,
    turned_lags,
    turned_motion,
    turning_size,
)
from magtwin.learn.data.inputs import Inputs
from magtwin.learn.models.calibration import Spread
from magtwin.learn.models.hybrid import Hybrid
from magtwin.learn.models.linear import Linear
from magtwin.learn.models.network import FieldNet
from magtwin.learn.models.predictor import Predictor
from magtwin.run.run import COLUMNS

Array = NDArray[np.float64]
Signals = Mapping[str, Any]
PredictRow = Callable[[Array], tuple[float, float, bool]]
"""From features, shape (F,), to disturbance [nT], its standard deviation [nT], and whether the row is
outside."""

LOOPS = Loops("magtwin.learn.inference.compiled_row", pays=0)

POSE = ("yaw", "b_map_gradient_nt_m")
"""Columns that follow from the pose and the map; all others are signals of the robot."""


class Reading(NamedTuple):
    """What a magnetometer reads at one pose."""

    b_total_nt: float
    """Field at the sensor [nT]: map plus disturbance; nan off the map or if a signal is nan."""

    b_map_nt: float
    """The map there [nT]."""

    b_disturbance_nt: float
    """Predicted disturbance of the robot [nT]."""

    b_sd_nt: float
    """Standard deviation of the prediction's error [nT]; nan if unknown. A live robot is not the one that was
    trained on, so a predictor that has a `wide` spread gives that."""

    outside_training: bool
    """Whether an input left the range of the training rows."""


class Row(NamedTuple):
    """Inputs of a predictor at one pose."""

    x: Array
    """Features, shape (F,); the next row overwrites them."""

    b_map_nt: float
    """The map at the sensor [nT]; nan off the map."""

    p_xy: tuple[float, float]
    """Place of the sensor in world [m]."""


class Reader:
    """Reads a predictor on a map, pose by pose. Not thread-safe.

    Construction loads compiled code, which takes a second.
    """

    def __init__(
        self, predictor: Predictor, field: AnomalyMap, *, lever_arm_m: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Prepare to read a predictor on a map.

        Args:
            predictor: A predictor of any kind.
            field: The map that its labels were made on.
            lever_arm_m: Place of the sensor forward and left of the map's reference [m], as in the labels.
        """
        self.predictor, self.field = predictor, field
        self._forward, self._left = lever_arm_m
        self._parts, self._order = _plan(predictor.features)
        self._slopes = any(POSE[1] in FEATURES[name].columns for name in predictor.features)
        self._x = np.empty(len(predictor.features))
        self._predict_row: PredictRow | None = None
        try:
            lookup.warm_up()
            self._predict_row = _compiled_path(predictor, LOOPS.open())
        except ImportError:  # without numba: the same numbers, in numpy
            pass

    @property
    def signals(self) -> tuple[str, ...]:
        """Columns of a Run that `read` needs from the robot."""
        columns = dict.fromkeys(c for name in self.predictor.features for c in FEATURES[name].columns)
        return tuple(column for column in columns if column not in POSE)

    def read(
        self, p_xy: Sequence[float], yaw: float, signals: Signals, *, outside: Outside = "nan"
    ) -> Reading:
        """One reading; the arguments are those of `row`."""
        _, field_nt, _ = self.row(p_xy, yaw, signals, outside=outside)
        if self._predict_row is not None:
            mean, sd, beyond = self._predict_row(self._x)
        else:
            row = self._x[None]
            mean, sd = (float(value[0]) for value in self.predictor.predict(row))
            wide = self.predictor.wide_sd_nt(row)
            sd = sd if wide is None else float(wide[0])
            beyond = bool(self.predictor.outside(row)[0])
        return Reading(field_nt + mean, field_nt, mean, sd, beyond)

    def row(self, p_xy: Sequence[float], yaw: float, signals: Signals, *, outside: Outside = "nan") -> Row:
        """Inputs of the predictor at one pose.

        Args:
            p_xy: Position of base_link in world when the field was measured [m]. If the labels have a
                latency, that is the position of that time ago.
            yaw: Heading then [rad].
            signals: Latest values by column name, at least those of `Reader.signals`: a number, or one number
                for each part of the column, in its unit and frame.
            outside: Field off the map: "nan", or "clamp" for that of its border.

        Raises:
            InputError: A signal is missing or has the wrong number of parts.
        """
        x, y = p_xy
        sin, cos = math.sin(yaw), math.cos(yaw)
        x += cos * self._forward - sin * self._left
        y += sin * self._forward + cos * self._left
        slopes = (0.0, 0.0)
        if self._slopes:
            field_nt, along_x, along_y, _ = self.field.at_with_gradient(x, y, yaw, outside=outside)
            slopes = (cos * along_x + sin * along_y, cos * along_y - sin * along_x)
        else:
            field_nt = self.field.at(x, y, yaw, outside=outside)
        values: list[float] = []
        try:
            for make in self._parts:
                values += make(signals, yaw, slopes)
            self._x[:] = values if self._order is None else [values[i] for i in self._order]
        except (KeyError, TypeError, ValueError):
            self._check(signals)
            raise
        return Row(self._x, field_nt, (x, y))

    def _check(self, signals: Signals) -> None:
        """Refuse signals that are missing or have the wrong number of parts."""
        for name in self.signals:
            if name not in signals:
                raise InputError(f"no signal {name!r} to read a field by; {hint(name, signals)}")
            parts = COLUMNS[name].width
            shape = np.shape(signals[name])
            if shape != (() if parts == 1 else (parts,)):
                raise InputError(f"signal {name!r} has {parts} numbers in a row, got shape {shape}")


Make = Callable[[Signals, float, tuple[float, float]], Sequence[float]]
"""From signals, yaw and map slopes to some numbers of a row."""


def _plan(names: Sequence[str]) -> tuple[list[Make], list[int] | None]:
    """Functions that make the numbers of a row, and the features' places among them; None if in order."""
    parts: dict[tuple[Any, ...], tuple[int, Make]] = {}
    order, count = [], 0
    for name in names:
        feature = FEATURES[name]
        key = (feature.convert, feature.columns)
        if key not in parts:
            width, make = _part(feature.convert, feature.columns)
            parts[key] = count, make
            count += width
        order.append(parts[key][0] + (feature.index or 0))
    return [make for _, make in parts.values()], None if order == list(range(count)) else order


def _part(convert: Any, columns: tuple[str, ...]) -> tuple[int, Make]:
    """Width of a conversion of columns of one row, and a function that makes its numbers."""
    get = [_column(name) for name in columns]
    if convert is None:
        return COLUMNS[columns[0]].width, get[0]
    ones = [np.ones((1, COLUMNS[name].width)) for name in columns]
    width = int(np.size(convert(*(one[:, 0] if one.shape[1] == 1 else one for one in ones))))
    if convert in _PLAIN:
        plain = _PLAIN[convert]
        return width, lambda *row: plain(*[column(*row) for column in get])

    def by_arrays(*row: Any) -> Sequence[float]:
        values = [np.array([column(*row)], float) for column in get]
        arrays = [value[:, 0] if value.shape[1] == 1 else value for value in values]
        numbers: list[float] = np.asarray(convert(*arrays)).reshape(-1).tolist()
        return numbers

    return width, by_arrays


def _column(name: str) -> Make:
    """A function that gives the numbers of a column."""
    if name == "yaw":
        return lambda signals, yaw, slopes: (yaw,)
    if name == "b_map_gradient_nt_m":
        return lambda signals, yaw, slopes: slopes
    width = COLUMNS[name].width
    if width == 1:
        return lambda signals, yaw, slopes: (signals[name],)

    def each(signals: Signals, yaw: float, slopes: tuple[float, float]) -> Sequence[float]:
        values = tuple(signals[name])
        if len(values) != width:
            raise ValueError(name)
        return values

    return each


def _degrees(yaw: Sequence[float]) -> Sequence[float]:
    deg = math.degrees(yaw[0]) % 360.0
    return (0.0 if deg >= 360.0 else deg,)


def _circle(yaw: Sequence[float]) -> Sequence[float]:
    once, twice = yaw[0], 2 * yaw[0]
    return math.sin(once), math.cos(once), math.sin(twice), math.cos(twice)


def _lags(
    v_cmd: Sequence[float], w_cmd: Sequence[float], v: Sequence[float], w: Sequence[float]
) -> Sequence[float]:
    return v_cmd[0] - v[0], w_cmd[0] - w[2]


def _turned(yaw: Sequence[float], *signals: Sequence[float]) -> Sequence[float]:
    sin, cos = math.sin(yaw[0]), math.cos(yaw[0])
    return [way * part for signal in signals for part in signal for way in (sin, cos)]


_PLAIN: Mapping[Any, Callable[..., Sequence[float]]] = {
    degrees_0_360: _degrees,
    FEATURES["imu_q_w"].convert: lambda q: [-part for part in q] if q[3] < 0 else q,
    circle: _circle,
    carried: lambda slopes, v: (slopes[0] * v[0], slopes[1] * v[0]),
    lags: _lags,
    turned: _turned,
    turned_motion: lambda yaw, v, w: _turned(yaw, (v[0], w[2], abs(w[2]))),
    turned_lags: lambda yaw, *signals: _turned(yaw, _lags(*signals)),
    turning_size: lambda w: (abs(w[2]),),
}
"""Conversions of one row without arrays, by their versions with arrays. Others use arrays."""


def _compiled_path(predictor: Predictor, code: Any) -> PredictRow | None:
    """The compiled path of a predictor; None if its kind has none."""
    if isinstance(predictor, FieldNet):
        return _net(predictor, code)
    if isinstance(predictor, Linear):
        return _linear(predictor, code, predictor.wide or predictor.spread)
    if isinstance(predictor, Hybrid):
        base, net = predictor.base, predictor.net
        residual = None if net is None else _net(net, code, clip=base.inputs)
        return _linear(base, code, predictor.wide or base.spread.scaled(predictor.sd_factor), residual)
    return None


def _net(net: FieldNet, code: Any, clip: Inputs | None = None) -> PredictRow:
    """A perceptron; its inputs are clipped to the training ranges of `clip` if given."""
    y_mean, y_scale, known, wide = net.y_mean, net.y_scale, net.residual_sd_nt, net.wide
    ranges = _ranges(net.inputs, clip)
    widths = np.array([len(net.features), *net.hidden, 1])
    table = np.concatenate([part.T.reshape(-1) for layer in net.layers for part in layer])
    z, work, out = np.empty(widths[0]), np.empty(2 * int(widths.max()), np.float32), np.empty(1)
    forward = code.perceptron

    def predict(x: Array) -> tuple[float, float, bool]:
        outside = forward(x, ranges, widths, table, z, work, out)
        sd = math.sqrt(wide.floor_nt2 + float(wide.slopes_nt2 @ (z * z))) if wide else known
        return y_mean + y_scale * out.item(), sd, outside

    return predict


def _linear(linear: Linear, code: Any, spread: Spread, residual: PredictRow | None = None) -> PredictRow:
    """A linear model, and the network for its residual."""
    ranges, z, scaled = _ranges(linear.inputs), np.empty(len(linear.features)), code.scaled
    constant, slopes = linear.constant_nt, linear.coefficients_nt
    floor, squares = spread.floor_nt2, spread.slopes_nt2

    def predict(x: Array) -> tuple[float, float, bool]:
        outside = scaled(x, ranges, z)
        mean = constant + float(slopes @ z)
        mean = mean if residual is None else mean + residual(x)[0]
        return mean, math.sqrt(floor + float(squares @ (z * z))), outside

    return predict


def _ranges(inputs: Inputs, clip: Inputs | None = None) -> Array:
    """Means, scales, bounds and training ranges for compiled code, shape (6, F)."""
    infinite = np.full(len(inputs.features), np.inf)
    bounds = (-infinite, infinite) if clip is None else (clip.low, clip.high)
    return np.array([inputs.mean, inputs.scale, *bounds, *inputs.within])
