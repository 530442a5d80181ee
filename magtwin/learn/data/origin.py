"""Origin: the map and the robot that a network was trained on, and warnings if it is used with others.

A network predicts the field of one robot beyond one map, at the place where its labels used that map. With
another map, place or robot its prediction is off, often by an amount that can be computed.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.field.maps.map import AnomalyMap
from magtwin.frames import into_base
from magtwin.learn.data.recording import plant_name
from magtwin.report.verdict import SEPARATOR
from magtwin.run.run import Metadata
from magtwin.spec.robot import RobotSpec

Array = NDArray[np.float64]

ROBOT_METADATA = ("robot_name", "sensor_m", "platform_sha256", "mocap_offset_m", "mocap_latency_s")
"""Metadata of a run about its robot and its motion capture."""

NOMINAL = "nominal"
"""Name of the plant of a robot without one, in the metadata of a network."""

UNKNOWN, SEVERAL = "unknown", "several"
"""Values in a data set if no recording names its robot, or if they differ."""

SAMPLES = 100
"""Number of poses at which a network keeps its map's values, to compare maps: the RMS is known to 7 %."""

SAME_NT = 1.0  # Maps that differ by less are the same [nT]; samples are rounded to 1 nT
LEAST_SAMPLES = 10  # Least number of poses on both maps for a comparison
TYPICAL_M_S = 0.2  # Speed at which the effect of a latency is computed [m/s], the default of a run
SMALL_SHARE = 0.25  # Effects below this share of the network's own error give no warning


@dataclass(frozen=True)
class Mismatch:
    """A difference between the training of a network and its use."""

    text: str
    """The difference, its expected effect, and what to do, in one line."""

    grave: bool = False
    """Whether predictions are meaningless, as for another robot."""


def shared_metadata(runs: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """Metadata of recordings about their robot: the common value, `UNKNOWN` or `SEVERAL` for each."""
    values: dict[str, set[str]] = {name: set() for name in ROBOT_METADATA}
    for metadata in runs:
        for name in ROBOT_METADATA:
            values[name].add(str(metadata.get(name, UNKNOWN)))
    return {name: next(iter(of)) if len(of) == 1 else SEVERAL for name, of in values.items() if of}


def map_metadata(field: AnomalyMap) -> dict[str, str]:
    """Metadata to compare a map with others: its method, and its values at `SAMPLES` poses."""
    p, yaw = _poses(field.extent)
    values = field.lookup(p, yaw)
    metadata = {
        "map_method": field.method,
        "map_height_m": "" if field.height_m is None else f"{field.height_m:g}",
        "map_extent_m": _text(field.extent),
        "map_samples_nt": " ".join(f"{value:.0f}" for value in values),
    }
    return {name: text for name, text in metadata.items() if text}


def mismatches(
    metadata: Metadata,
    name: str,
    *,
    residual_sd_nt: float,
    field: AnomalyMap,
    map_sha256: str,
    robot: RobotSpec,
    platform_sha256: str,
) -> tuple[Mismatch, ...]:
    """Differences between the training of a network and its use.

    A simulated run looks the map up at the robot's true pose. Labels with fitted lever arm and latency did so
    too, within some mm; labels without used the pose of motion capture.

    Args:
        metadata: Metadata of the network.
        name: What to call the network.
        residual_sd_nt: Its own error [nT]; nan if unknown.
        field: The map that its predictions are added to.
        map_sha256: Checksum of that map's file.
        robot: The robot that it is used on.
        platform_sha256: Checksum of that robot's own field.

    Raises:
        InputError: The network's metadata are invalid.
    """
    each = (
        _robot_mismatch(metadata, name, field, robot, platform_sha256),
        _map_mismatch(metadata, name, field, map_sha256),
        _frame_mismatch(metadata, name, field, residual_sd_nt),
    )
    return tuple(filter(None, each))


def same_robot(learned: Metadata, used: Metadata) -> bool:
    """Whether a network is used on the robot that it was trained on, so that its own intervals hold.

    The robot's platform field and sensor, its plant and the kind of its session must be those of the
    training. Recordings of a real robot do not name these, so they count as those of another robot.
    """
    for name in ("platform_sha256", "sensor_m"):
        ours, its = (str(metadata.get(name, UNKNOWN)) for metadata in (learned, used))
        if ours != its or ours in (UNKNOWN, SEVERAL):
            return False
    plants, sessions = (
        str(learned.get(f"training_{name}", default)).split(SEPARATOR)
        for name, default in (("plants", NOMINAL), ("sessions", ""))
    )
    surveys = used.get("session") == "survey" and "survey" not in sessions
    return (plant_name(used) or NOMINAL) in plants and not surveys


def label_frame(metadata: Metadata, name: str = "") -> tuple[float, float, float] | None:
    """Place where a network's labels used the map, relative to the robot's true pose.

    Labels used p(t - latency) + R l of motion capture's pose, which is the true pose of `a` seconds ago minus
    R o. So the map was looked up l - o forward and left of the true place, and latency + a late.

    Returns:
        Forward [m], left [m] and lateness [s]; all 0 if labels used the true pose. None if the offset and age
        of motion capture are unknown, as for a real robot.
    """
    entries = (("lever_arm_m", 2), ("latency_s", 1), ("mocap_offset_m", 2), ("mocap_latency_s", 1))
    lever, late, offset, age = (_numbers(metadata, name, key, count) for key, count in entries)
    if lever is None or late is None:
        return None
    if metadata.get("poses") == "true":
        offset, age = [0.0, 0.0], [0.0]
    if offset is None or age is None:
        return None
    return lever[0] - offset[0], lever[1] - offset[1], late[0] + age[0]


def displacement_nt(field: AnomalyMap, forward_m: float, left_m: float, late_s: float) -> float:
    """RMS change of a map when it is looked up at a displaced pose [nT].

    First order: the gradient in the robot's axes times (forward - v late, left), at v = `TYPICAL_M_S`, over
    `SAMPLES` poses of the map.
    """
    p, yaw = _poses(field.extent)
    _, gradient = field.lookup_with_gradient(p, yaw)
    slope = into_base(gradient[:, :2], yaw)
    change = slope @ np.array([forward_m - TYPICAL_M_S * late_s, left_m])
    known = np.isfinite(change)
    return float(np.sqrt(np.mean(change[known] ** 2))) if known.any() else math.nan


def same_map(metadata: Metadata, field: AnomalyMap, name: str = "") -> bool:
    """Whether a map has the values that a network keeps of its own map, within `SAME_NT`."""
    rms = _map_difference_nt(metadata, field, name)
    return rms is not None and rms < SAME_NT


def _map_difference_nt(metadata: Metadata, field: AnomalyMap, name: str) -> float | None:
    """RMS difference from the values that a network keeps [nT]; None if unknown, inf if too few overlap."""
    known = _numbers(metadata, name, "map_samples_nt", SAMPLES)
    extent = _numbers(metadata, name, "map_extent_m", 4)
    if known is None or extent is None:
        return None
    low_x, high_x, low_y, high_y = extent
    difference = field.lookup(*_poses((low_x, high_x, low_y, high_y))) - np.array(known)
    both = np.isfinite(difference)
    return math.inf if both.sum() < LEAST_SAMPLES else float(np.sqrt(np.mean(difference[both] ** 2)))


def _map_mismatch(metadata: Metadata, name: str, field: AnomalyMap, map_sha256: str) -> Mismatch | None:
    if "map_sha256" not in metadata:
        return Mismatch(
            f"{name} does not name the map that it was trained on; if that is not {field.name!r}, its field "
            "is off by the difference of the two"
        )
    if metadata["map_sha256"] == map_sha256:
        return None
    learned = f"{metadata.get('map', '')!r}"
    if "map_method" in metadata:
        learned += f" ({metadata['map_method']})"
    here = f"{field.name!r}" + (f" ({field.method})" if field.method else "")
    effect, rms = "the expected effect is unknown", _map_difference_nt(metadata, field, name)
    if rms is not None and rms < SAME_NT:
        return None
    if rms == math.inf:
        effect = "the two cover different floors, and the field is meaningless"
    elif rms is not None:
        effect = f"the two differ by {rms:.0f} nT RMS over the floor, so its predictions may not fit this map"
    return Mismatch(
        f"{name} learned on the map {learned}, and the scene's map is {here}: {effect}; use that map, or "
        "train on this one"
    )


def _frame_mismatch(
    metadata: Metadata, name: str, field: AnomalyMap, residual_sd_nt: float
) -> Mismatch | None:
    frame = label_frame(metadata, name)
    if frame is None:
        return None
    effect = displacement_nt(field, *frame)
    if not effect > SMALL_SHARE * (0.0 if math.isnan(residual_sd_nt) else residual_sd_nt):
        return None
    away, late = 100 * math.hypot(frame[0], frame[1]), 1000 * frame[2]
    return Mismatch(
        f"{name} was trained on labels that took the map {away:.1f} cm and {late:.0f} ms off the robot's "
        f"pose, an error of about {effect:.0f} nT RMS at {TYPICAL_M_S:g} m/s; its stated error includes it. "
        + (
            "Their fit of lever arm and latency is that far off: record more turns at several speeds"
            if metadata.get("alignment") == "fitted"
            else "To avoid it, train on labels with fitted lever arm and latency ("
            "dataset build --alignment fit)"
        )
    )


def _robot_mismatch(
    metadata: Metadata, name: str, field: AnomalyMap, robot: RobotSpec, platform_sha256: str
) -> Mismatch | None:
    learned, sensor = metadata.get("robot_name", UNKNOWN), _numbers(metadata, name, "sensor_m", 3)
    if learned == UNKNOWN:
        return None
    if learned == SEVERAL:
        return Mismatch(f"{name} learned from recordings of several robots, and this one is {robot.name!r}")
    moved = None if sensor is None else np.subtract(robot.p_base_magnetometer, sensor)
    away = 0.0 if moved is None else float(np.linalg.norm(moved))
    here = _text(robot.p_base_magnetometer)
    if learned != robot.name and away > 1e-3:
        size = ""
        if {"label_mean_nt", "label_sd_nt"} <= set(metadata):
            size = f" ({float(metadata['label_mean_nt']):.0f} ± {float(metadata['label_sd_nt']):.0f} nT)"
        return Mismatch(
            f"WRONG ROBOT: {name} learned the robot {learned!r} with its sensor at ({metadata['sensor_m']}) "
            f"m, and this is {robot.name!r} with its sensor at ({here}) m. The disturbance it predicts{size} "
            "is not this robot's, and readings are meaningless; train a network on this robot, or use a "
            "physical magnetometer",
            grave=True,
        )
    if away > 1e-3 and moved is not None:
        effect = displacement_nt(field, float(moved[0]), float(moved[1]), 0.0)
        return Mismatch(
            f"{name} learned {learned!r} with its sensor at ({metadata['sensor_m']}) m, and now it is at "
            f"({here}) m: at least {effect:.0f} nT RMS, by the map's gradient alone; train a network on this "
            "robot"
        )
    learned_platform = metadata.get("platform_sha256", UNKNOWN)
    if learned_platform not in (UNKNOWN, SEVERAL, platform_sha256):
        return Mismatch(
            f"{name} learned {learned!r} with another [platform] than {robot.name!r} has here: what it "
            "predicts of the robot's own field is off by what was changed; train a network on this robot"
        )
    return None


def _poses(extent: tuple[float, float, float, float]) -> tuple[Array, Array]:
    """`SAMPLES` points and headings spread evenly over a floor, by Roberts' R3 sequence (2018)."""
    g = 1.22074408460575947536  # the root of g^4 = g + 1
    at = (0.5 + np.arange(1, SAMPLES + 1)[:, None] * g ** -np.arange(1.0, 4.0)) % 1.0
    low_x, high_x, low_y, high_y = extent
    p = np.array([low_x, low_y]) + at[:, :2] * np.array([high_x - low_x, high_y - low_y])
    return p, 2 * np.pi * at[:, 2]


def _numbers(metadata: Metadata, name: str, key: str, count: int) -> list[float] | None:
    """Numbers of a metadata entry; None if it is missing or unknown."""
    text = str(metadata.get(key, UNKNOWN))
    if text in (UNKNOWN, SEVERAL):
        return None
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) != count:
        raise InputError(f"{name}: its metadata {key!r} must list {count} numbers, got {text[:60]!r}")
    return values


def _text(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)
