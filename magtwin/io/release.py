"""Recordings of the released package, which its node writes with `save_json`, read as a Run.

Such a file is a list of frames, one JSON object for every message, with the latest value of everything:

    timestamp                wall clock [s]
    nn_magnetic_magnitude    reading of the magnetometer [nT]; 0.0 in a frame without a reading
    map_magnetic_magnitude   the map there [nT]
    pose_data                motion capture: x, y [m], yaw [rad]
    odom                     linear velocity xyz [m/s], angular velocity xyz [rad/s]
    imu_data                 orientation xyzw, angular velocity xyz [rad/s], acceleration xyz [m/s2]
    battery_data             voltage [V], charge 0 to 1
    lidar                    0 or 1

Every frame ends in a comma, also the last one. A killed node leaves no closing bracket, or half a frame; such
files are read too.
"""

import json
import math
import os
import re
from array import array
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError, hint
from magtwin.files.file import read_text, sha256
from magtwin.frames import canonical, quat_from_yaw, wrap_angle
from magtwin.run.run import COLUMNS, Run

_BETWEEN = re.compile(r"[\s,]*")  # Characters between frames
_STUMP = re.compile(r"[A-Za-z-]{0,9}\s*")  # An incomplete word or sign at the end of half a frame

_SIZES = {
    "timestamp": 1,
    "nn_magnetic_magnitude": 1,
    "map_magnetic_magnitude": 1,
    "pose_data": 3,
    "odom": 6,
    "imu_data": 10,
    "battery_data": 2,
    "lidar": 1,
}
"""Numbers of each entry of a frame; they may be in several lists."""

_WIDTH = sum(_SIZES.values())  # Numbers in a frame


def read_release(path: str | os.PathLike[str]) -> Run:
    """Read a recording of the released node's `save_json`.

    Each frame with a reading is a row; its other values are the latest ones before it. t is the wall clock
    since the first reading, whose time is `start_s` in the metadata. Values that are not known yet, which the
    node leaves out or writes as empty lists, are nan; z of poses is 0, as it is not recorded. Of two readings
    at the same time the later one counts. The metadata hold the number of frames and how the file ended.
    Errors give the number and position of a frame that is not as above.
    """
    path = Path(path)
    text, at, table, last = *_opened(path), array("d"), -math.inf
    for number in count(1):
        at = _BETWEEN.match(text, at).end()  # type: ignore[union-attr]
        where = f"{path}, frame {number} (at character {at})"
        frame, at = _frame(text, at, number, where)
        if isinstance(frame, str):
            break
        row = _numbers(frame, where)
        if row[0] < last:
            text = "was it set while recording? cut the file in two there"
            raise InputError(f"{where}: its clock goes back from {last!r} to {row[0]!r} s; {text}")
        if row[1] == 0.0 or math.isnan(row[1]):
            continue  # a message of another sensor; the next reading holds its values too
        if row[0] == last:
            del table[-_WIDTH:]
        table.extend(row)
        last = row[0]
    if not table:
        text = (
            "none carries a reading (nn_magnetic_magnitude is 0 in all); was the magnetometer's node running?"
        )
        raise InputError(f"{path}: {number - 1} frames, and {text}")
    rows = np.frombuffer(table, float).reshape(-1, _WIDTH)
    metadata: dict[str, Any] = {"recording": path.name, "recording_sha256": sha256(path)}
    metadata |= {"frames": number - 1, "start_s": float(rows[0, 0]), "recording_end": frame}
    return Run(_columns(rows), {**metadata, "truth": "motion capture"})


def _columns(rows: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """Columns of a Run from numbers in the order of `_SIZES`."""
    ends = np.cumsum([*_SIZES.values()])[:-1]
    clock, field, on_map, pose, odom, imu, battery, lidar = np.split(rows, ends, axis=1)
    yaw, q = wrap_angle(pose[:, 2]), canonical(quat_from_yaw(pose[:, 2]))
    p = np.column_stack([pose[:, :2], np.where(np.isfinite(pose[:, 0]), 0.0, np.nan)])
    columns: dict[str, NDArray[Any]] = {
        "t": clock[:, 0] - clock[0, 0],
        "p_world_base": p,
        "q_world_base_xyzw": q,
        "yaw": yaw,
        "odom_v": odom[:, :3],
        "odom_w": odom[:, 3:],
        "imu_q_xyzw": canonical(imu[:, :4]),
        "imu_w": imu[:, 4:7],
        "imu_a": imu[:, 7:],
        "mocap_p": p,
        "mocap_q_xyzw": q,
        "battery_v": battery[:, 0],
        "battery_fraction": battery[:, 1],
        "lidar_on": lidar[:, 0] > 0.5,
        "b_map_nt": np.where(on_map[:, 0] == 0.0, np.nan, on_map[:, 0]),
        "b_measured_nt": field[:, 0],
    }
    return {name: np.ascontiguousarray(columns[name]) for name in COLUMNS if name in columns}


def _numbers(frame: dict[str, Any], where: str) -> list[float]:
    """The numbers of a frame in the order of `_SIZES`; nan if not known yet."""
    row: list[float] = []
    for key, size in _SIZES.items():
        if key not in frame:
            known = list(frame)[:20]
            raise InputError(f"{where}: no {key!r} in it, which `save_json` writes; {hint(key, known)}")
        row += _flat(frame[key], size, key, where)
    if not math.isfinite(row[0]):
        raise InputError(f"{where}: timestamp must be a time [s], got {_quoted(frame['timestamp'])}")
    if row[-1] not in (0.0, 1.0) and not math.isnan(row[-1]):
        raise InputError(f"{where}: lidar must be 0 or 1, got {_quoted(frame['lidar'])}")
    return row


def _flat(value: Any, size: int, key: str, where: str) -> list[float]:
    """The numbers of an entry, in one list or several; nan where they are not known."""
    parts = value if isinstance(value, list) else [value]
    flat = [number for part in parts for number in (part if isinstance(part, list) else [part])]
    if not flat or value is None:
        return [math.nan] * size
    if len(flat) != size:
        raise InputError(f"{where}: {key} must be {size} numbers here, got {_quoted(value)}")
    return [_number(number, key, where) for number in flat]


def _number(value: Any, key: str, where: str) -> float:
    if value is None:
        return math.nan
    with suppress(OverflowError):
        if isinstance(value, int | float) and not math.isinf(value):
            return float(value)
    raise InputError(f"{where}: {key} must be a finite number, got {_quoted(value)}")


def _quoted(value: Any) -> str:
    """A value, shortened for messages."""
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:60] + " ..."


def _opened(path: Path) -> tuple[str, int]:
    """The text of a file, and where its list of frames begins."""
    text = read_text(path, "recording", "recording", "utf-8-sig")
    begin = text.lstrip()[:20]
    if not begin.startswith("["):
        seen = _quoted(begin) if begin else "nothing"
        raise InputError(f"{path}: a recording of the release begins with '[', this with {seen}")
    return text, text.index("[") + 1


def _frame(text: str, at: int, number: int, where: str) -> tuple[dict[str, Any] | str, int]:
    """The frame at a character, and its end; in place of the last frame, how the file ended.

    The list is split by hand, as its commas are not JSON's; each frame is JSON.
    """
    if at == len(text):
        return "without its bracket", at
    if text[at] == "]":
        if rest := text[at + 1 :].strip():
            text = f"with {_quoted(rest[:20])}; are these two recordings? cut them apart"
            raise InputError(f"{where.partition(', frame')[0]}: goes on after the end of its list, {text}")
        return "whole", at
    if text[at] != "{":
        raise InputError(f"{where}: a frame begins with '{{', this with {text[at]!r}")
    try:
        return json.JSONDecoder().raw_decode(text, at)
    except (ValueError, RecursionError) as error:
        if isinstance(error, json.JSONDecodeError) and (
            error.msg.startswith("Unterminated string") or _STUMP.fullmatch(text, error.pos)
        ):
            return f"within frame {number}", at
        raise InputError(f"{where}: not JSON: {error}") from error
