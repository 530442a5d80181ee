"""Axes: vectors in the axes of the robot, and whether vectors and headings contradict each other."""

import numpy as np
from numpy.typing import NDArray

from magtwin.field.survey.readings import Readings
from magtwin.frames import quat_conjugate, quat_from_yaw, rotate, yaw_from_quat

Array = NDArray[np.float64]

TURNED = 0.7  # Length of the mean unit vector of the headings above which a survey hardly turned
ALIGNED = 0.8  # Ratio of the mean level field to its size above which it keeps one direction
CLEARLY = 0.3  # Difference of these ratios from which one is mirrored. Hard iron does not look so.
LEAST_READINGS = 8  # Fewest readings from which headings are judged


def levelled(vector_nt: Array, turn: Array, axes: str) -> Array:
    """Vectors in the axes of a robot that stands upright: forward, left, up; shape (N, 3).

    `turn` are headings [rad], shape (N,), or orientations xyzw of the body in world, shape (N, 4); `axes` are
    those of `vector_nt`.
    """
    if turn.ndim == 1:
        return vector_nt if axes == "body" else rotate(quat_conjugate(quat_from_yaw(turn)), vector_nt)
    world = rotate(turn, vector_nt) if axes == "body" else vector_nt
    return rotate(quat_conjugate(quat_from_yaw(yaw_from_quat(turn))), world)


def other_axes(vector_nt: Array, turn: Array, said: str) -> tuple[str, float]:
    """Axes in which vectors keep one direction and in those that were said do not; and the share that does.

    With the level part v as a complex number and the heading h, a field that keeps its direction in world
    axes has a constant v exp(ih) for vectors in body axes, v for vectors in world axes, and v exp(-ih) for
    headings that turn the other way, and for vectors that are forward, right, down ("mirrored"). Vectors have
    the shape (N, 3), `turn` is that of `levelled`. It is "" if the axes that were said, body or world, are
    right, or nothing tells axes apart.
    """
    yaw = turn if turn.ndim == 1 else yaw_from_quat(turn)
    spin = np.exp(1j * yaw)
    if abs(spin.mean()) > TURNED:
        return "", 0.0  # one heading
    body = levelled(vector_nt, turn, "body")[:, :2] @ np.array([1, 1j])
    kept = {"body": _kept_direction(body * spin), "mirrored": _kept_direction(body / spin)}
    kept["world"] = _kept_direction(vector_nt[:, :2] @ np.array([1, 1j]))
    best = max((axes for axes in kept if axes != said), key=lambda axes: kept[axes])
    least = kept[best] - CLEARLY if best == "mirrored" else ALIGNED / 2
    return ("", 0.0) if kept[best] <= ALIGNED or kept[said] >= least else (best, kept[best])


def vector_doubts(readings: Readings) -> list[str]:
    """The doubt about vectors that keep no direction in world axes, though the robot turned."""
    good = readings.good
    if readings.b_body_nt is None or np.count_nonzero(good) < LEAST_READINGS:
        return []
    spin = np.exp(1j * readings.yaw[good])
    kept = _kept_direction(readings.b_body_nt[good, :2] @ np.array([1, 1j]) * spin)
    if kept >= ALIGNED or np.abs(spin.mean()) > TURNED:
        return []
    return [
        f"vectors keep no direction in world axes ({100 * kept:.0f} %): headings and vectors contradict each "
        "other, or the robot's own field is as strong as the Earth's"
    ]


def _kept_direction(level: NDArray[np.complex128]) -> float:
    """Length of the mean of level vectors by the mean of their lengths; 1 if all have one direction."""
    size = float(np.abs(level).mean())
    return float(abs(level.mean())) / size if size > 0 else 1.0
