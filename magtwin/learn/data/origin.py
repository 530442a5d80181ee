"""Origin: the map and the robot that a network learned on, and whether it is used with others.

A network predicts what a robot reads beyond one map, at the place where its labels took that map. With
another map, at another place or on another robot its prediction is off, often by an amount that can be
computed.
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
from magtwin.run.run import Metadata
from magtwin.spec.robot import RobotSpec

Array = NDArray[np.float64]

ROBOT_METADATA = ("robot_name", "sensor_m", "platform_sha256", "mocap_offset_m", "mocap_latency_s")
"""Metadata of a run that tell which robot drove, and how motion capture saw it."""

UNKNOWN, SEVERAL = "unknown", "several"
"""What a data set says of its robot where no recording tells, or where they differ."""

SAMPLES = 100
"""Poses at which a map is kept with a network, to compare it with another: an RMS to 7 %."""

SAME_NT = 1.0
"""Maps that differ by less are the same map [nT]: samples are kept to the nT."""

LEAST_SAMPLES = 10
"""Fewer poses that both maps know tell nothing of their difference."""

TYPICAL_M_S = 0.2
"""Speed for which the effect of a latency is told [m/s], the default of a run."""

SMALL_SHARE = 0.25
"""An effect below this share of the network's own error is not worth a warning."""


@dataclass(frozen=True)
class Mismatch:
    """Something that a network is used with and did not learn on."""

    text: str
    """What it is, the expected effect, and what to do, in a line."""

    grave: bool = False
    """Whether predictions are meaningless: another robot."""


def shared_metadata(runs: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """What the metadata of recordings tell of their robot: one value, `UNKNOWN` or `SEVERAL` for each."""
    told: dict[str, set[str]] = {name: set() for name in ROBOT_METADATA}
    for metadata in runs:
        for name in ROBOT_METADATA:
            told[name].add(str(metadata.get(name, UNKNOWN)))
    return {
        name: next(iter(values)) if len(values) == 1 else SEVERAL for name, values in told.items() if values
    }


def map_metadata(field: AnomalyMap) -> dict[str, str]:
    """What is kept of a map to compare others with it: its method, and its values at `SAMPLES` poses."""
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
    """What a network is used with and did not learn on.

    A simulated run takes the map at the robot's true pose. Labels with fitted lever arm and latency took it
    there too, to some mm; labels without took it where motion capture saw the robot.

    Args:
        metadata: Those of the network.
        name: What to call the network.
        residual_sd_nt: Its own error [nT]; nan where unknown.
        field: The map that its predictions are added to.
        map_sha256: Checksum of that map's file.
        robot: The robot that it is used on.
        platform_sha256: Checksum of what makes that robot's own field.

    Returns:
        One for each thing that differs; none where everything is as it learned it.

    Raises:
        InputError: Metadata of the network are not what they should be.
    """
    found = [
        _robot_mismatch(metadata, name, field, robot, platform_sha256),
        _map_mismatch(metadata, name, field, map_sha256),
        _frame_mismatch(metadata, name, field, residual_sd_nt),
    ]
    return tuple(one for one in found if one is not None)


def label_frame(metadata: Metadata, name: str = "") -> tuple[float, float, float] | None:
    """Where a network's labels took the map, seen from the robot's true pose.

    Labels took it at p(t - latency) + R l of what motion capture saw, which is the true pose of `a` seconds
    ago less R o. So the map was read l - o forward and left of the true place, and latency + a late.

    Args:
        metadata: Those of the network.
        name: What to call the network, in a refusal.

    Returns:
        Forward [m], left [m] and lateness [s]; all 0 where labels took the true pose. None where the robot
        does not tell how motion capture saw it, as a real one.
    """
    lever, late = _numbers(metadata, name, "lever_arm_m", 2), _numbers(metadata, name, "latency_s", 1)
    offset, age = (
        _numbers(metadata, name, "mocap_offset_m", 2),
        _numbers(metadata, name, "mocap_latency_s", 1),
    )
    if lever is None or late is None:
        return None
    if metadata.get("poses") == "true":
        offset, age = [0.0, 0.0], [0.0]
    if offset is None or age is None:
        return None
    return lever[0] - offset[0], lever[1] - offset[1], late[0] + age[0]


def displacement_nt(field: AnomalyMap, forward_m: float, left_m: float, late_s: float) -> float:
    """Root mean square of what a map changes by when it is read at a displaced pose [nT].

    First order: the gradient in the robot's axes times (forward - v late, left), at v = `TYPICAL_M_S`, over
    `SAMPLES` poses of the map.
    """
    p, yaw = _poses(field.extent)
    _, gradient = field.lookup_with_gradient(p, yaw)
    slope = into_base(gradient[:, :2], yaw)
    change = slope @ np.array([forward_m - TYPICAL_M_S * late_s, left_m])
    known = np.isfinite(change)
    return float(np.sqrt(np.mean(change[known] ** 2))) if known.any() else math.nan


def _map_mismatch(metadata: Metadata, name: str, field: AnomalyMap, map_sha256: str) -> Mismatch | None:
    if "map_sha256" not in metadata:
        return Mismatch(
            f"{name} does not say which map it was trained on; if that was not {field.name!r}, its field "
            "errs by the difference of the two"
        )
    if metadata["map_sha256"] == map_sha256:
        return None
    learned = f"{metadata.get('map', '')!r}"
    if "map_method" in metadata:
        learned += f" ({metadata['map_method']})"
    here = f"{field.name!r}" + (f" ({field.method})" if field.method else "")
    effect, known = "the expected effect is unknown", _numbers(metadata, name, "map_samples_nt", SAMPLES)
    extent = _numbers(metadata, name, "map_extent_m", 4)
    if known is not None and extent is not None:
        low_x, high_x, low_y, high_y = extent
        difference = field.lookup(*_poses((low_x, high_x, low_y, high_y))) - np.array(known)
        both = np.isfinite(difference)
        if both.sum() < LEAST_SAMPLES:
            effect = "the two cover different floors, and the field is meaningless"
        else:
            rms = float(np.sqrt(np.mean(difference[both] ** 2)))
            if rms < SAME_NT:
                return None
            effect = (
                f"the two differ by {rms:.0f} nT RMS over the floor, so its predictions may not fit this map"
            )
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
            else "To avoid it, train on labels with fitted lever arm and latency (dataset build --align fit)"
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
            f"m, "
            f"and this is {robot.name!r} with its sensor at ({here}) m. The disturbance it predicts{size} is "
            "not this robot's, and readings are meaningless; train a network on this robot, or use a "
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
    told = metadata.get("platform_sha256", UNKNOWN)
    if told not in (UNKNOWN, SEVERAL, platform_sha256):
        return Mismatch(
            f"{name} learned {learned!r} with another [platform] than {robot.name!r} has here: what it "
            "predicts of the robot's own field is off by what was changed; train a network on this robot"
        )
    if learned != robot.name:
        same = "same" if told == platform_sha256 else "at the same place"
        return Mismatch(
            f"{name} learned the robot {learned!r}, and this is {robot.name!r}; its sensor is {same}, so no "
            "effect is expected if only the name differs"
        )
    return None


def _poses(extent: tuple[float, float, float, float]) -> tuple[Array, Array]:
    """`SAMPLES` poses spread evenly over a floor and all headings: Roberts' R3 sequence (2018).

    Args:
        extent: Least and greatest x, least and greatest y [m].

    Returns:
        Points [m], shape (SAMPLES, 2), and headings [rad], shape (SAMPLES,).
    """
    g = 1.22074408460575947536  # the root of g^4 = g + 1
    at = (0.5 + np.arange(1, SAMPLES + 1)[:, None] * g ** -np.arange(1.0, 4.0)) % 1.0
    low_x, high_x, low_y, high_y = extent
    p = np.array([low_x, low_y]) + at[:, :2] * np.array([high_x - low_x, high_y - low_y])
    return p, 2 * np.pi * at[:, 2]


def _numbers(metadata: Metadata, name: str, key: str, count: int) -> list[float] | None:
    """Numbers that a fact lists; None where it is not there, or says that they are not known.

    Raises:
        InputError: It is there and lists something else.
    """
    text = str(metadata.get(key, UNKNOWN))
    if text in (UNKNOWN, SEVERAL):
        return None
    try:
        values = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) != count:
        raise InputError(f"{name}: its fact {key!r} must list {count} numbers, got {text[:60]!r}")
    return values


def _text(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)
