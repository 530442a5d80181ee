"""State of the point-mass filter: what its compiled loops take and return, by name.

A node of the grid is a pose; `logw` has the logarithm of its mass, shape (H Y X,), -inf if it has none. Each
node has a Kalman filter of n linear states given its pose: offset, drift, error of the map if the map has a
variance, and iron cos and sin if the sensor model has them. `state` has their mean and the upper triangle of
their covariance, node after node, shape (H Y X (n + n (n + 1) / 2),). A node weighs by

    nu = z - B(p + R(yaw) arm, yaw) - h b,  S = h P h' + R,  log likelihood = -(nu^2 / S + log S) / 2

A filter of the bank has the mean and the full covariance of x, y, yaw, scale error and the same linear
states, filter after filter, shape (K (n + n n),) with n four more.
"""

from typing import NamedTuple

from magtwin.localization.problem import Array

CUT = 20.0
"""Filters and nodes whose mass is below exp(-CUT) of the greatest are dropped."""

OUTSIDE = 1.0
"""Penalty of a pose outside the extent per reading [nats]."""

WHITE_SHARE = 0.16
"""Share of the map's variance that differs from reading to reading; the rest is correlated along the path."""


class Known(NamedTuple):
    """A reading, and what is known of its errors and of the pose; numbers."""

    z: float  # the reading less the predicted disturbance [nT]; nan: none
    arm_x: float  # sensor in base_link [m]
    arm_y: float
    white: float  # variance of the white noise [nT^2]
    power: float  # exponent of the likelihood
    mapped: float  # 1 if there is a state of the map's error, else 0
    iron: float  # 1 if there are states of the iron, else 0
    wide_mean: float  # mean of the field where it is not known [nT]
    wide_variance: float  # its variance [nT^2]
    x0: float  # extent [m]
    x1: float
    y0: float
    y1: float
    x_ref: float  # pose from which the sums are taken [m, rad]
    y_ref: float
    yaw_ref: float


class Motion(NamedTuple):
    """A motion of the robot and the variances of its noise; numbers."""

    forward: float  # [m]
    left: float  # [m]
    turn: float  # [rad]
    place_variance: float  # along x and along y [m^2]
    yaw_variance: float  # [rad^2]


class Lattice(NamedTuple):
    """Nodes of a grid: a stack of layers, one per heading, with the same axes in all of them.

    Node (h, j, i) lies at x[h] + x_i i + x_j j, y[h] + y_i i + y_j j and has number (h rows + j) columns + i.
    """

    yaw: Array  # heading of each layer [rad], shape (H,)
    x: Array  # its first node [m], shape (H,)
    y: Array
    x_i: float  # distances between neighbours [m]
    x_j: float
    y_i: float
    y_j: float
    step: float  # distance between layers [rad]
    rows: int
    columns: int


class Sums(NamedTuple):
    """Sums over nodes or filters, of mass times d, the distance from the reference pose, and its products."""

    evidence: float  # logarithm of the mean likelihood of the reading
    kept: int  # nodes or filters with mass
    best: int  # the one of most mass
    mass: float
    x: float
    y: float
    yaw: float
    xx: float
    xy: float
    x_yaw: float
    yy: float
    y_yaw: float
    yaw_yaw: float
    offset: float  # mass times the offset [nT]
