"""Arrays: files of named arrays, MATLAB's (.mat) and HDF5 with groups of own names, as tables by group.

An array is a column, or the three columns of a field or a place, by its name. Arrays of one group and one
length are a table; those without a clock of their own join the table of their length that has one.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magtwin.errors import InputError
from magtwin.tables.labels import meaning_of, split_label
from magtwin.tables.table import Column, Table

Named = tuple[str, NDArray[Any], str]  # Name with points between its parts, values and unit

ARRAYS = (".mat", ".h5", ".hdf5", ".hdf")  # Suffixes of such files
PLACES = "pos position positions place xyz xy p translation location coordinates coords".split()  # noqa: SIM905
MEASURED = ("mag", "magnetometer", "magnetic", "fluxgate", "b")
"""Words of arrays of places, and of groups whose arrays of three are a field if nothing else is said."""

OTHERS = "acc accel acceleration gyro gyr rate velocity vel bias offset quat std cov".split()  # noqa: SIM905
LEAST_ROWS = 8  # Shorter arrays are settings
MOST_PARTS = 9  # Most columns of an array


def tables_of_arrays(path: Path) -> dict[str, Table]:
    """The tables in a file of arrays, by group and number of rows."""
    try:
        found = list(_of_hdf5(path) if _is_hdf5(path) else _of_matlab(path))
    except ImportError:
        raise InputError(f"{path}: such a file needs h5py: pip install 'magtwin[vehicles]'") from None
    except Exception as error:  # the libraries raise whatever a damaged file leads to
        raise InputError(f"{path}: damaged, or no file of arrays ({str(error)[:120]})") from None
    groups = dict[tuple[str, int], dict[str, NDArray[Any]]]()
    for name, array, unit in found:
        values = np.squeeze(array)
        if values.dtype.kind not in "fiub" or not values.size or not 0 < values.ndim < 3:
            continue
        if values.ndim == 2:
            values = values if values.shape[0] > values.shape[1] else values.T
        group, _, last = name.rpartition(".")
        if len(values) >= LEAST_ROWS and (values.ndim == 1 or values.shape[1] <= MOST_PARTS):
            parts = values.reshape(len(values), -1).T
            labels = [f"{label} [{unit}]" if unit else label for label in _labels(group, last, len(parts))]
            some = groups.setdefault((group, len(values)), {})
            if some.keys() & set(labels):  # another array of this kind, such as mag and mag_raw
                labels = [f"{last} {label}" for label in labels]
            some |= zip(labels, parts, strict=True)
    timed = {key for key, some in groups.items() if any(meaning_of(label, "t") for label in some)}
    for key in [key for key in groups if key not in timed]:
        same = [other for other in groups if other[1] == key[1]]
        other = next((one for one in same if one in timed), same[0])
        if other != key:
            for label, part in groups.pop(key).items():
                groups[other].setdefault(label if label not in groups[other] else f"{key[0]} {label}", part)
    if not groups:
        held = ", ".join(name for name, *_ in found)[:200] or "none"
        raise InputError(f"{path}: no arrays of numbers of {LEAST_ROWS} rows or more; it holds {held}")
    names = [group or path.stem for group, _ in groups]
    keys = (f"{n} {rows}" if names.count(n) > 1 else n for n, (_, rows) in zip(names, groups, strict=True))
    return {
        key: Table(tuple(Column(label, part, path, None) for label, part in some.items()))
        for key, some in zip(keys, groups.values(), strict=True)
    }


def _labels(group: str, name: str, count: int) -> list[str]:
    """Names of the columns of an array: bx, by, bz of a field, x, y, z of a place, and of quaternions only
    if their order is told by the name; else numbers.
    """
    words = set(split_label(name).words)
    if count == 1:
        return [name]
    if count in (2, 3) and words & {*PLACES}:
        return list("xyz"[:count])
    of_field = meaning_of(name, "field") or (
        set(split_label(group).words) & {*MEASURED} and not words & {*PLACES}
    )
    if count == 3 and (of_field or words & {*MEASURED}) and not words & {*OTHERS}:
        return ["bx", "by", "bz"]
    order = next((order for order in ("xyzw", "wxyz") if count == 4 and name.lower().endswith(order)), "")
    return [f"q{letter}" for letter in order] or [f"{name}_{k}" for k in range(1, count + 1)]


def _is_hdf5(path: Path) -> bool:
    """Whether a file is HDF5, as those of MATLAB 7.3 are, behind a text."""
    with path.open("rb") as file:
        return b"\x89HDF\r\n\x1a\n" in file.read(520)


def _of_hdf5(path: Path) -> Iterator[Named]:
    import h5py

    with h5py.File(path, "r") as file:
        names = list[str]()
        file.visit(names.append)
        for name in names:
            item = file[name]
            if isinstance(item, h5py.Dataset) and not name.startswith("#") and item.dtype.kind in "fiub":
                unit = item.attrs.get("units", item.attrs.get("unit", ""))
                unit = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else str(unit)
                yield name.replace("/", "."), np.asarray(item[()]), unit.split(" since ")[0].strip()


def _of_matlab(path: Path) -> Iterator[Named]:
    from scipy.io import loadmat

    def inside(name: str, value: Any) -> Iterator[Named]:
        if hasattr(value, "_fieldnames"):
            for field in value._fieldnames:
                yield from inside(f"{name}.{field}", getattr(value, field))
        elif isinstance(value, np.ndarray):
            yield name, value, ""

    for name, value in loadmat(path, squeeze_me=True, struct_as_record=False).items():
        yield from inside(name, value) if not name.startswith("__") else ()
