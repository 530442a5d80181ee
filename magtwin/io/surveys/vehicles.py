"""Vehicles: the field and the places in logs of PX4, ArduPilot and aircraft.

A log becomes columns at the times of its magnetometer: t [s]; x, y [m], east and north, or lon, lat [deg];
yaw [rad], counter-clockwise from east; bx, by, bz [nT], forward, left and up in axes that are level. The
libraries come with `pip install 'magtwin[vehicles]'`.
"""

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.frames import enu_from_ned, quat_from_rpy, xyzw_from_wxyz, yaw_from_quat
from magtwin.io.surveys.axes import levelled
from magtwin.io.surveys.places import between

Array = NDArray[np.float64]
Columns = dict[str, Array]

FLIGHT = {
    "t": ("tt", "t", "time"),
    "x [m]": ("utm_x", "x", "easting"),
    "y [m]": ("utm_y", "y", "northing"),
    "lon": ("lon", "longitude"),
    "lat": ("lat", "latitude"),
    "field [nT]": ("mag_1_uc", "mag_1_c", "mag", "tmi", "mag_1"),
}
"""Names of the data sets of a flight, the best first. Those of SGL's flights for MagNav are the first ones,
of which mag_1_uc is the magnetometer on the tail, not compensated."""


def columns_of_log(path: Path) -> Columns:
    """The columns of a log, by its suffix."""
    readers = {".ulg": (_px4, "pyulog"), ".bin": (_ardupilot, "pymavlink")}
    read, library = readers.get(path.suffix.lower(), (_flight, "h5py"))
    try:
        import_module(library)
    except ImportError:
        text = f"such a log is read with {library}: pip install 'magtwin[vehicles]'"
        raise InputError(f"{path}: {text}") from None
    try:
        return read(path)
    except InputError:
        raise
    except Exception as error:  # the libraries raise whatever a damaged file leads to
        raise InputError(f"{path}: damaged, or no log of this kind ({str(error)[:120]})") from None


def _px4(path: Path) -> Columns:
    """ULog: the magnetometer, the local position and the attitude that PX4 estimated."""
    from pyulog import ULog

    three = [f"magnetometer_ga[{k}]" for k in range(3)]
    sensors = {"vehicle_magnetometer": three, "sensor_combined": three, "sensor_mag": ["x", "y", "z"]}
    topics: dict[str, Any] = {}
    for data in ULog(str(path), [*sensors, "vehicle_local_position", "vehicle_attitude"]).data_list:
        topics.setdefault(data.name, data.data)
    for name, labels in sensors.items():
        if labels[0] in topics.get(name, ()):
            t = topics[name]["timestamp"] / 1e6
            gauss = np.column_stack([topics[name][label] for label in labels])
            break
    else:
        raise InputError(f"{path}: no magnetometer in it; it holds {', '.join(sorted(topics)) or 'none'}")
    columns = {"t": t}
    if place := topics.get("vehicle_local_position"):
        at = place["timestamp"] / 1e6
        columns |= {"x [m]": between(t, at, place["y"]), "y [m]": between(t, at, place["x"])}
    if (turn := topics.get("vehicle_attitude")) is None:
        return columns | {"field [nT]": 1e5 * np.linalg.norm(gauss, axis=1)}
    q = np.column_stack([turn[f"q[{k}]"] for k in range(4)])  # w, x, y, z: body to north, east, down
    q *= np.cumprod(np.where(np.sum(q * np.roll(q, 1, axis=0), axis=1) < 0, -1, 1))[:, None]
    q = np.column_stack([between(t, turn["timestamp"] / 1e6, part) for part in q.T])
    return columns | _levelled(1e5 * gauss, xyzw_from_wxyz(q / np.linalg.norm(q, axis=1, keepdims=True)))


def _ardupilot(path: Path) -> Columns:
    """DataFlash: the first compass [mG], the position and the attitude that ArduPilot estimated."""
    from pymavlink.DFReader import DFReader_binary

    labels = {"MAG": ("MagX", "MagY", "MagZ"), "POS": ("Lng", "Lat"), "ATT": ("Roll", "Pitch", "Yaw")}
    rows: dict[str, list[list[float]]] = {kind: [] for kind in labels}
    log = DFReader_binary(str(path))
    while (message := log.recv_match(type=list(rows))) is not None:
        kind = message.get_type()
        if not getattr(message, "I", 0):
            rows[kind].append([float(getattr(message, label)) for label in ("TimeUS", *labels[kind])])
    log.data_map.close()
    log.filehandle.close()
    if not rows["MAG"]:
        raise InputError(f"{path}: no message MAG in it, which holds the compass")
    t, *mag = np.array(rows["MAG"]).T
    columns = {"t": t / 1e6}
    if rows["POS"]:
        at, lon, lat = np.array(rows["POS"]).T
        columns |= {"lon": between(t, at, lon), "lat": between(t, at, lat)}
    b = 1e2 * np.column_stack(mag)
    if not rows["ATT"]:
        return columns | {"field [nT]": np.linalg.norm(b, axis=1)}
    at, *degrees = np.array(rows["ATT"]).T
    angles = [np.radians(between(t, at, part, 360.0)) for part in degrees]
    return columns | _levelled(b, quat_from_rpy(np.column_stack(angles)))


def _flight(path: Path) -> Columns:
    """HDF5: the data sets that `FLIGHT` names, all of one length; none if its groups have others."""
    import h5py

    columns: Columns = {}
    with h5py.File(path, "r") as file:
        inside = any(isinstance(item, h5py.Group) for item in file.values())
        known = {str(name).lower(): item for name, item in file.items() if isinstance(item, h5py.Dataset)}
        for label, names in FLIGHT.items():
            found = next((known[name] for name in names if name in known and known[name].ndim == 1), None)
            if found is not None:
                columns[label] = np.asarray(found[()], float)
    if "field [nT]" not in columns or (inside and not {"x [m]", "lon"} & columns.keys()):
        return {}
    rows = len(columns["field [nT]"])
    if "x [m]" in columns:
        columns.pop("lon", None), columns.pop("lat", None)
    return {label: values for label, values in columns.items() if len(values) == rows}


def _levelled(b: Array, q_ned_body: Array) -> Columns:
    """Vectors forward, right, down as level ones forward, left, up, and headings from east.

    Orientations xyzw are those of a body forward, right, down in axes north, east, down.
    """
    q = enu_from_ned(q_ned_body)
    bx, by, bz = levelled(b * (1.0, -1.0, -1.0), q, "body").T
    return {"yaw [rad]": yaw_from_quat(q), "bx [nT]": bx, "by [nT]": by, "bz [nT]": bz}
