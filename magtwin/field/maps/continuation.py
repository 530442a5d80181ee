"""Continuation: the field at other heights from the map of one height."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.curvature import interpolation_error_nt2
from magtwin.field.maps.map import AnomalyMap
from magtwin.field.sources.harmonic import HarmonicField

Array = NDArray[np.float64]

LARGEST_STEP_DOWN = 0.25  # Largest step down of a grid, in cells: its shortest waves then grow threefold
GRAIN_M = 1e-6  # Heights closer than this are equal


def at_height(field: AnomalyMap, height_m: float) -> AnomalyMap:
    """The map of the same nodes at another height of the sensor.

    **From a harmonic field** the values are exact: the field of its dipoles at that height, as the survey's
    robot would read it.

    **From the grid alone** each heading's layer is continued by its waves (Blakely, Potential Theory in
    Gravity and Magnetic Applications, 1995, eq. 12.8):

        F[B(z + dz)] = F[B(z)] exp(-dz |k|),  k = (k_x, k_y)

    after subtracting its mean; the layer is mirrored at its border and tapered to zero a layer's width away.
    The filter is exact for harmonic functions. A magnitude is not harmonic, but |B| = F + b . F / F +
    |b_perp|^2 / 2F + ... of an anomaly b on a uniform field F is to first order. So the result holds for b
    small against F; the parameter `second_order_nt`, (sd of the map)^2 / 2F, is the size of the error. Values
    near the border and near masked nodes, which take the nearest valid value, are less certain.

    **Variance.** The filter's kernel K weighs nodes, so a value's variance is at most (sum |K| sd)^2, however
    the errors correlate; the result carries this bound. A masked node or one beyond the border counts with
    its guess error: the RMS slope of the layer times twice the distance to the nearest valid node, at most
    sqrt(2) times the layer's spread.

    A grid can go down by a quarter of a cell, since its noise grows as exp(dz |k|). A harmonic field can go
    down to the floor, but no nearer to a layer of dipoles than their spacing; farther below than a grid can
    go, the result has no variance.
    """
    if not np.isfinite(height_m):
        raise InputError(f"height_m must be a length [m], got {height_m!r}")
    if height_m < 0:
        raise InputError(f"height_m is a height above the floor, 0 m or more, got {height_m!r}")
    height_m = float(height_m)
    if field.height_m is None:
        raise InputError(
            f"the height of map {field.name!r} is unknown, so it cannot be continued; give it when the "
            "survey is read (--height-m)"
        )
    start = field.harmonic.height_m if field.harmonic is not None else field.height_m
    if abs(height_m - start) < GRAIN_M:
        return field
    harmonic, step = field.harmonic, height_m - start
    parameters = {**field.parameters, "continued_from_m": start}
    if harmonic is not None:
        _check_reach(field, harmonic, start, height_m)
        how = "by its harmonic field"
        values = harmonic.magnitude_nt(*field.grid.poses(), height_m=height_m)
        harmonic = replace(harmonic, p_base_sensor=np.append(harmonic.p_base_sensor[:2], height_m))
    else:
        _check_step(field, step, height_m)
        how = "by the waves of its grid (Blakely 1995, eq. 12.8)"
        layers = zip(field.values_nt, field.valid, strict=True)
        values = np.stack([_Layer(v, valid, field.cell_m).continued(step) for v, valid in layers])
        known = field.values_nt[field.valid]
        if (mean := float(known.mean())) > 0:
            parameters["second_order_nt"] = round(float(known.var()) / (2 * mean), 3)
    variance = between = None
    if field.variance_nt2 is not None and step >= -LARGEST_STEP_DOWN * min(field.cell_m):
        nodes = zip(field.values_nt, field.valid, np.sqrt(field.variance_nt2), strict=True)
        sds = [_Layer(v, valid, field.cell_m).deviation(sd, step) for v, valid, sd in nodes]
        variance = np.square(sds)
        if field.between_nt2 is not None:
            between = interpolation_error_nt2(values, field.valid, field.headings_rad)
    text = f"continued from {start:g} to {height_m:g} m {how}"
    return replace(
        field,
        values_nt=values,
        variance_nt2=variance,
        between_nt2=between,
        recorded_yaw=None,
        height_m=height_m,
        method=f"{field.method}; {text}" if field.method else text,
        parameters=parameters,
        harmonic=harmonic,
        made_from=None if field.made_from is None else field.made_from.at_height(height_m),
    )


def _check_reach(field: AnomalyMap, harmonic: HarmonicField, start: float, height_m: float) -> None:
    """Refuse a height at which a harmonic field does not hold: below the floor, or near a layer of dipoles.

    A layer of dipoles with spacing s has ripples of about exp(-2 pi d / s) at distance d: 0.2 % at d = s.
    """
    places = harmonic.p_world_dipole
    below, above = places[places[:, 2] <= start], places[places[:, 2] > start]
    lowest, highest = 0.0, np.inf
    if len(below):
        top = float(below[:, 2].max())
        lowest = max(0.0, top + _apart_m(below[below[:, 2] > top - GRAIN_M]))
    if len(above):
        bottom = float(above[:, 2].min())
        highest = bottom - _apart_m(above[above[:, 2] < bottom + GRAIN_M])
    if height_m < min(lowest, start):
        raise InputError(
            f"height_m {height_m:g} lies too low for map {field.name!r}: below {lowest:.4g} m is the floor, "
            "or its dipoles are so near that each shows by itself"
        )
    if height_m > max(highest, start):
        raise InputError(
            f"height_m {height_m:g} lies too high for map {field.name!r}: above {highest:.4g} m are dipoles, "
            "which stand for iron above the robot, so near that each shows by itself"
        )


def _apart_m(layer: Array) -> float:
    """Median distance of a layer's dipoles to their nearest neighbour [m]."""
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(layer).query(layer, 2)[0][:, 1])) if len(layer) > 1 else GRAIN_M


def _check_step(field: AnomalyMap, step: float, height_m: float) -> None:
    """Refuse a height that is too far from the map of a grid."""
    cell = min(field.cell_m)
    if step < -LARGEST_STEP_DOWN * cell:
        raise InputError(
            f"height_m {height_m:g} lies {-step:g} m below the map {field.name!r}; a grid of {cell:g} m goes "
            f"down by {LARGEST_STEP_DOWN * cell:g} m at most, below that its noise would be field; fit the "
            "readings with --method harmonic, which knows the field down to the floor"
        )
    x0, x1, y0, y1 = field.extent
    if step > max(x1 - x0, y1 - y0):
        raise InputError(
            f"height_m {height_m:g} lies {step:g} m above the map {field.name!r} of {x1 - x0:g} x "
            f"{y1 - y0:g} m; farther above than it is long, what lies beside it makes the field"
        )
    if not field.valid.any(axis=(1, 2)).all():
        raise InputError(f"map {field.name!r} has a heading without a valid node; nothing can be continued")


class _Layer:
    """One heading's field, filled at masked nodes, mirrored at its border, and tapered beyond."""

    def __init__(self, values: Array, valid: NDArray[np.bool_], cell_m: tuple[float, float]) -> None:
        from scipy.ndimage import distance_transform_edt

        self.values, self.valid = values, valid
        self.cell_m = (cell_m[1], cell_m[0])  # along rows, along columns
        self.mean = float(values[valid].mean())
        rows, columns = valid.shape
        self.pads = ((rows, rows), (columns, columns))
        self.inside = (slice(rows, 2 * rows), slice(columns, 2 * columns))
        around = np.pad(valid, self.pads)
        self.distance, nearest = distance_transform_edt(~around, sampling=self.cell_m, return_indices=True)
        inner = nearest[:, self.inside[0], self.inside[1]] - np.array([rows, columns])[:, None, None]
        self.filled = values[tuple(inner)]  # a masked node as its nearest neighbour that is known
        taper = [np.pad(np.ones(n), (n, n), mode="linear_ramp") for n in valid.shape]
        self.taper = np.outer(*(np.sin(np.pi / 2 * t) ** 2 for t in taper))

    def continued(self, step: float) -> Array:
        """The field at `step` above [nT], shape (Y, X)."""
        anomaly = self.taper * np.pad(self.filled - self.mean, self.pads, mode="symmetric")
        return self.mean + self._filtered(anomaly, self._response(step, anomaly.shape))

    def deviation(self, sd: Array, step: float) -> Array:
        """Upper bound of the sd at `step` above, from that of the nodes [nT], shape (Y, X)."""
        along = np.gradient(self.filled, *self.cell_m)
        slope = float(np.sqrt(np.mean(np.square(along).sum(axis=0))))
        spread = np.sqrt(2) * float(self.values[self.valid].std())
        guess = np.minimum(2 * slope * self.distance, spread)
        guess[self.inside][self.valid] = sd[self.valid]
        kernel = np.abs(np.fft.irfft2(self._response(step, guess.shape), guess.shape))
        return self._filtered(guess, np.fft.rfft2(kernel))

    def _response(self, step: float, shape: tuple[int, ...]) -> Array:
        ky = 2 * np.pi * np.fft.fftfreq(shape[0], self.cell_m[0])
        kx = 2 * np.pi * np.fft.rfftfreq(shape[1], self.cell_m[1])
        return np.exp(-step * np.hypot(ky[:, None], kx))

    def _filtered(self, padded: Array, response: NDArray[Any]) -> Array:
        return np.fft.irfft2(np.fft.rfft2(padded) * response, padded.shape)[self.inside]
