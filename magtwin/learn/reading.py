"""Reader: one reading at a time, as it comes, for a robot that drives now.

A run's rows are worth arrays, one row is not: here features are plain numbers, the map is looked up by
compiled code, and the network goes without the units that ReLU has zeroed. A predictor for which there is no
such way is asked for its one row, which gives the same and takes longer.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from magtwin.errors import InputError, hint
from magtwin.field.maps import lookup
from magtwin.field.maps.map import AnomalyMap
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
from magtwin.learn.models.ensemble import Ensemble
from magtwin.learn.models.heads import LIMIT
from magtwin.learn.models.hybrid import Hybrid
from magtwin.learn.models.linear import Linear
from magtwin.learn.models.network import FieldNet
from magtwin.learn.models.perceptron import Layer
from magtwin.learn.models.predictor import Predictor
from magtwin.run.run import COLUMNS

Array = NDArray[np.float64]
Signals = Mapping[str, Any]
Say = Callable[[Array], tuple[float, float, bool]]
"""Disturbance, its standard deviation [nT] and whether a row is outside, from features, shape (F,)."""

POSE = ("yaw", "b_map_gradient_nt_m")
"""Columns that the pose and the map give; every other one is a signal."""


class Reading(NamedTuple):
    """What a magnetometer reads at one pose."""

    b_total_nt: float
    """Field at the sensor [nT]: map plus disturbance; nan where the map knows none, or a signal is nan."""

    b_map_nt: float
    """The map there [nT]."""

    b_disturbance_nt: float
    """What the predictor says that the robot adds [nT]."""

    b_sd_nt: float
    """Standard deviation of its error [nT]; nan where unknown."""

    outside_training: bool
    """Whether an input left the range of the training rows."""


class Reader:
    """Reads a predictor and a map, one pose after the other; one thread at a time may use it.

    Its construction opens compiled code, which takes a second. Against float64 throughout, a reading of the
    released network errs by under 0.01 nT.
    """

    def __init__(
        self, predictor: Predictor, field: AnomalyMap, *, lever_arm_m: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """A reader of a predictor on a map.

        Args:
            predictor: Of any kind. One that looks back over earlier rows looks at those that were read
                before: read it once every `predictor.step_s`, and make a reader for each run.
            field: The map that its labels were made on.
            lever_arm_m: Sensor's place forward and left of where the map has it [m], as its labels had it.
        """
        self.predictor, self.field = predictor, field
        self._forward, self._left = lever_arm_m
        self._parts, self._order = _plan(predictor.features)
        self._slopes = any(POSE[1] in FEATURES[name].columns for name in predictor.features)
        self._x = np.empty(len(predictor.features))
        self._say: Say | None = None
        try:
            lookup.warm_up()
            from magtwin.learn.models import compiled

            self._say = _compiled_way(predictor, compiled)
        except ImportError:  # the same numbers, in numpy and torch
            pass
        self._rows: deque[Array] = deque(maxlen=predictor.context + 1)

    @property
    def signals(self) -> tuple[str, ...]:
        """Columns of a Run that `read` wants of the robot."""
        columns = dict.fromkeys(c for name in self.predictor.features for c in FEATURES[name].columns)
        return tuple(column for column in columns if column not in POSE)

    def read(self, p_xy: Sequence[float], yaw: float, signals: Signals) -> Reading:
        """One reading.

        Args:
            p_xy: Where base_link was in world when the field was [m]: by the latency of the labels, if they
                have one, ago.
            yaw: Heading then [rad].
            signals: By name of a column of a Run, what is known by now: a number, or as many numbers as the
                column has parts, in their units and frames. Those of `Reader.signals`; others are not read.

        Raises:
            InputError: A signal is missing, or has another number of parts.
        """
        x, y = p_xy
        sin, cos = math.sin(yaw), math.cos(yaw)
        x += cos * self._forward - sin * self._left
        y += sin * self._forward + cos * self._left
        slopes = (0.0, 0.0)
        if self._slopes:
            field_nt, along_x, along_y, _ = self.field.at_with_gradient(x, y, yaw)
            slopes = (cos * along_x + sin * along_y, cos * along_y - sin * along_x)
        else:
            field_nt = self.field.at(x, y, yaw)
        values: list[float] = []
        try:
            for make in self._parts:
                values += make(signals, yaw, slopes)
            self._x[:] = values if self._order is None else [values[i] for i in self._order]
        except (KeyError, TypeError, ValueError):
            self._refuse(signals)
            raise
        mean, sd, outside = self._told()
        return Reading(field_nt + mean, field_nt, mean, sd, outside)

    def _told(self) -> tuple[float, float, bool]:
        """Disturbance, standard deviation and whether a row is outside, of the features at hand."""
        if self._say is not None:
            return self._say(self._x)
        row, whole = self._x.copy(), bool(np.isfinite(self._x).all())
        outside = bool(self.predictor.outside(row[None])[0])
        if not whole and self.predictor.context:  # to later rows it is as the last whole one
            self._rows.extend(list(self._rows)[-1:])
            return math.nan, math.nan, outside
        self._rows.append(row)
        means, sds = self.predictor.predict(np.array(self._rows))
        return float(means[-1]), float(sds[-1]), outside

    def _refuse(self, signals: Signals) -> None:
        """Say which signal is not as it should be."""
        for name in self.signals:
            if name not in signals:
                raise InputError(f"no signal {name!r} to read a field by; {hint(name, signals)}")
            parts = COLUMNS[name].width
            shape = np.shape(signals[name])
            if shape != (() if parts == 1 else (parts,)):
                raise InputError(f"signal {name!r} has {parts} numbers in a row, got shape {shape}")


def _plan(names: Sequence[str]) -> tuple[list[Callable[..., Sequence[float]]], list[int] | None]:
    """What makes the numbers of a row, and in which order they are its features; none where they come so."""
    parts: dict[tuple[Any, ...], tuple[int, Callable[..., Sequence[float]]]] = {}
    order, count = [], 0
    for name in names:
        feature = FEATURES[name]
        key = (feature.convert, feature.columns)
        if key not in parts:
            wide, make = _part(feature.convert, feature.columns)
            parts[key] = count, make
            count += wide
        order.append(parts[key][0] + (feature.index or 0))
    as_they_come = order == list(range(count))
    return [make for _, make in parts.values()], None if as_they_come else order


def _part(convert: Any, columns: tuple[str, ...]) -> tuple[int, Callable[..., Sequence[float]]]:
    """How many numbers a conversion makes of columns of one row, and what makes them."""
    get = [_column(name) for name in columns]
    if convert is None:
        return COLUMNS[columns[0]].width, get[0]
    ones = [np.ones((1, COLUMNS[name].width)) for name in columns]
    wide = int(np.size(convert(*(one[:, 0] if one.shape[1] == 1 else one for one in ones))))
    if convert in _PLAIN:
        plain = _PLAIN[convert]
        if len(get) == 1:
            one = get[0]
            return wide, lambda *at: plain(one(*at))
        return wide, lambda *at: plain(*[column(*at) for column in get])

    def by_arrays(*at: Any) -> Sequence[float]:
        rows = [np.array([column(*at)], float) for column in get]
        arrays = [row[:, 0] if row.shape[1] == 1 else row for row in rows]
        found: list[float] = np.asarray(convert(*arrays)).reshape(-1).tolist()
        return found

    return wide, by_arrays


def _column(name: str) -> Callable[[Signals, float, tuple[float, float]], Sequence[float]]:
    """What gives the numbers of a column, as many as it has."""
    if name == "yaw":
        return lambda signals, yaw, slopes: (yaw,)
    if name == "b_map_gradient_nt_m":
        return lambda signals, yaw, slopes: slopes
    width = COLUMNS[name].width
    if width == 1:
        return lambda signals, yaw, slopes: (signals[name],)
    if width == 3:

        def three(signals: Signals, yaw: float, slopes: tuple[float, float]) -> Sequence[float]:
            x, y, z = signals[name]
            return x, y, z

        return three

    def each(signals: Signals, yaw: float, slopes: tuple[float, float]) -> Sequence[float]:
        values = tuple(signals[name])
        if len(values) != width:
            raise ValueError(name)
        return values

    return each


def _degrees(yaw: Sequence[float]) -> Sequence[float]:
    deg = math.degrees(yaw[0]) % 360.0
    return (0.0 if deg >= 360.0 else deg,)


def _canonical(q: Sequence[float]) -> Sequence[float]:
    return [-part for part in q] if q[3] < 0 else q


def _circle(yaw: Sequence[float]) -> Sequence[float]:
    once, twice = yaw[0], 2 * yaw[0]
    return math.sin(once), math.cos(once), math.sin(twice), math.cos(twice)


def _carried(slopes: Sequence[float], v: Sequence[float]) -> Sequence[float]:
    return slopes[0] * v[0], slopes[1] * v[0]


def _lags(
    v_cmd: Sequence[float], w_cmd: Sequence[float], v: Sequence[float], w: Sequence[float]
) -> Sequence[float]:
    return v_cmd[0] - v[0], w_cmd[0] - w[2]


def _turned(yaw: Sequence[float], *signals: Sequence[float]) -> Sequence[float]:
    sin, cos = math.sin(yaw[0]), math.cos(yaw[0])
    return [way * part for signal in signals for part in signal for way in (sin, cos)]


def _turned_motion(yaw: Sequence[float], v: Sequence[float], w: Sequence[float]) -> Sequence[float]:
    return _turned(yaw, (v[0], w[2], abs(w[2])))


_PLAIN: Mapping[Any, Callable[..., Sequence[float]]] = {
    degrees_0_360: _degrees,
    FEATURES["imu_q_w"].convert: _canonical,
    circle: _circle,
    carried: _carried,
    lags: _lags,
    turned: _turned,
    turned_motion: _turned_motion,
    turned_lags: lambda yaw, *of: _turned(yaw, _lags(*of)),
    turning_size: lambda w: (abs(w[2]),),
}
"""Conversions of one row without arrays, by those with; a conversion that is not here goes by an array."""


def _compiled_way(predictor: Predictor, code: Any) -> Say | None:
    """The compiled way of a predictor; none where there is no such way."""
    if isinstance(predictor, FieldNet):
        return _net(predictor, code)
    if isinstance(predictor, Linear):
        return _linear(predictor, code)
    if isinstance(predictor, Hybrid):
        return _hybrid(predictor, code)
    if isinstance(predictor, Ensemble):
        return _ensemble(predictor, code)
    return None


def _net(net: FieldNet, code: Any, held: Inputs | None = None) -> Say:
    """A perceptron, its inputs held within the training ranges of `held` if that is given."""
    layers = [(layer.weight, layer.bias) for layer in net.linears]
    forward, out = _perceptron(layers, _ranges(net.inputs, held), code)
    y_mean, y_scale, sd = float(net.y_mean), float(net.y_scale), net.residual_sd_nt

    def say(x: Array) -> tuple[float, float, bool]:
        outside = forward(x)
        return y_mean + y_scale * out.item(), sd, outside

    return say


def _linear(linear: Linear, code: Any) -> Say:
    ranges, z, scaled = _ranges(linear.inputs), np.empty(len(linear.features)), code.scaled
    constant, slopes = linear.constant_nt, linear.coefficients_nt
    floor, squares = linear.spread.floor_nt2, linear.spread.slopes_nt2

    def say(x: Array) -> tuple[float, float, bool]:
        outside = scaled(x, ranges, z)
        return constant + float(slopes @ z), math.sqrt(floor + float(squares @ (z * z))), outside

    return say


def _hybrid(hybrid: Hybrid, code: Any) -> Say:
    base, factor = _linear(hybrid.base, code), hybrid.sd_factor
    more = None if hybrid.net is None else _net(hybrid.net, code, held=hybrid.base.inputs)

    def say(x: Array) -> tuple[float, float, bool]:
        mean, sd, outside = base(x)
        return mean + more(x)[0] if more else mean, factor * sd, outside

    return say


def _ensemble(ensemble: Ensemble, code: Any) -> Say:
    ranges, count = _ranges(ensemble.inputs), ensemble.net.members
    members = [_perceptron(ensemble.member(i), ranges, code) for i in range(count)]
    y_mean, y_scale, factor = ensemble.y_mean_nt, ensemble.y_scale_nt, ensemble.sd_factor

    def say(x: Array) -> tuple[float, float, bool]:
        total = squares = own = 0.0
        outside = False
        for forward, out in members:
            outside = forward(x)
            mean, log = out.tolist()
            total += mean
            squares += mean * mean
            own += math.exp(min(max(log, -LIMIT), LIMIT)) if log == log else math.nan
        mean = total / count
        variance = own / count + max(squares / count - mean * mean, 0.0)
        return y_mean + y_scale * mean, factor * y_scale * math.sqrt(variance), outside

    return say


def _perceptron(layers: Sequence[Layer], ranges: Array, code: Any) -> tuple[Callable[[Array], bool], Array]:
    """What takes a row through layers and tells whether it is outside, and where its outputs then are."""
    widths = np.array([ranges.shape[1], *(len(bias) for _, bias in layers)])
    parts = [part.detach().t().reshape(-1) for layer in layers for part in layer]
    table = torch.cat(parts).numpy()
    z, work = np.empty(ranges.shape[1]), np.empty(2 * int(widths.max()), np.float32)
    out, forward = np.empty(int(widths[-1])), code.perceptron

    def through(x: Array) -> bool:
        outside: bool = forward(x, ranges, widths, table, z, work, out)
        return outside

    return through, out


def _ranges(inputs: Inputs, held: Inputs | None = None) -> Array:
    """Means, scales, bounds and training ranges, as compiled code wants them, shape (6, F)."""
    anything = np.full(len(inputs.features), np.inf)
    bounds = (-anything, anything) if held is None else (held.low, held.high)
    return np.array([inputs.mean, inputs.scale, *bounds, *inputs.within])
