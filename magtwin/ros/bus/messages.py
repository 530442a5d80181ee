"""Messages: one live message in CDR and back, by the typestore of rosbags.

Fields are named by leaf, as in `magtwin.io.bags.types.layout`: `pose.position`, `header.stamp`,
`transforms.0.child_frame_id`. `magtwin.io.bags.cdr` encodes whole columns of a bag with the same names.
"""

import operator
from collections.abc import Callable, Iterable, Mapping
from functools import cache, lru_cache
from threading import Lock
from typing import Any

import numpy as np

from magtwin.errors import InputError, hint
from magtwin.io.bags.cdr import NS
from magtwin.io.bags.types import TIMES, fields_of, typestore

_DTYPES = {"bool": np.bool_, "byte": np.uint8, "char": np.uint8}
_LOCK = Lock()
"""Templates are filled and encoded by one thread at a time."""


def to_bytes(kind: str, fields: Mapping[str, Any]) -> bytes:
    """One message in CDR.

    Args:
        kind: Its type, such as `sensor_msgs/msg/Imu`.
        fields: Values by leaf name, also arrays of one row; stamps in whole nanoseconds. A sequence of
            structures is given by its length (`transforms`), and its elements by their number
            (`transforms.0.child_frame_id`). Default: zero or empty.

    Raises:
        InputError: The type or a field is unknown, or a value has the wrong size.
    """
    names = tuple(fields)
    lengths = tuple(int(_item(fields[name])) for name in _sequences(kind, names))
    message, setters = _template(kind, names, lengths)
    with _LOCK:
        for (name, value), setter in zip(fields.items(), setters, strict=True):
            try:
                setter(value)
            except (TypeError, ValueError) as error:
                raise InputError(f"{kind}: field {name} cannot be {value!r}: {error}") from error
        return bytes(typestore().serialize_cdr(message, kind, little_endian=True))


def content_of(kind: str, data: bytes) -> Any:
    """A message as an object of rosbags, with an attribute for each field.

    Raises:
        InputError: The type is unknown, or the message has another length or is not plain CDR.
    """
    from rosbags.serde import SerdeError

    fields_of(kind)
    try:
        return typestore().deserialize_cdr(data, kind)
    except SerdeError as error:
        raise InputError(f"a message is no {kind}: {error}") from error


def leaves_of(kind: str, content: Any, wanted: Iterable[str]) -> dict[str, Any]:
    """Values of some leaves of a message: numbers, arrays, strings; stamps in whole nanoseconds.

    A sequence of structures is its length.

    Raises:
        InputError: A sequence has no such element, or the type has no such field.
    """
    try:
        return {name: _getter(kind, name)(content) for name in wanted}
    except IndexError as error:
        raise InputError(f"a {kind} has too few elements: {error}") from error


def _item(value: Any) -> Any:
    """The number in an array of one number; other values as they are."""
    return value.reshape(-1)[0].item() if isinstance(value, np.ndarray) else value


def _described(kind: str, name: str) -> tuple[list[str | int], Any]:
    """The steps to a leaf, and the rosbags description of it.

    Raises:
        InputError: The type has no such field.
    """
    from rosbags.interfaces import Nodetype

    steps: list[str | int] = []
    here: Any = (Nodetype.NAME, kind)
    for part in name.split("."):
        node, content = here
        if node in (Nodetype.SEQUENCE, Nodetype.ARRAY) and part.isdigit():
            here = content[0]
            steps.append(int(part))
            continue
        known = dict(fields_of(content)) if node is Nodetype.NAME else {}
        if part not in known:
            raise InputError(f"{kind} has no field {name!r}; {hint(part, known)}")
        here = known[part]
        steps.append(part)
    return steps, here


@lru_cache(maxsize=1024)
def _sequences(kind: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Those leaves that are sequences of structures."""
    from rosbags.interfaces import Nodetype

    described = {name: _described(kind, name)[1] for name in names}
    return tuple(n for n, (node, c) in described.items() if node is Nodetype.SEQUENCE and _named(c[0]))


def _named(described: Any) -> bool:
    from rosbags.interfaces import Nodetype

    return bool(described[0] is Nodetype.NAME)


@lru_cache(maxsize=256)
def _template(
    kind: str, names: tuple[str, ...], lengths: tuple[int, ...]
) -> tuple[Any, tuple[Callable[[Any], None], ...]]:
    """A message with sequences of these lengths, and what sets each field of it."""
    message = _empty(kind)
    sequences = _sequences(kind, names)
    for name, length in sorted(zip(sequences, lengths, strict=True), key=lambda s: s[0].count(".")):
        steps, described = _described(kind, name)
        elements = [_default(described[1][0]) for _ in range(length)]
        setattr(_at(message, steps[:-1], kind), str(steps[-1]), elements)
    return message, tuple(
        (lambda value: None) if name in sequences else _setter(message, kind, name) for name in names
    )


def _at(message: Any, steps: Iterable[str | int], kind: str) -> Any:
    """A part of a message."""
    for step in steps:
        try:
            message = message[step] if isinstance(step, int) else getattr(message, step)
        except IndexError as error:
            raise InputError(f"{kind}: element {step} is beyond the length of its sequence") from error
    return message


def _setter(message: Any, kind: str, name: str) -> Callable[[Any], None]:
    """Sets a leaf of a message."""
    from rosbags.interfaces import Nodetype

    steps, (node, described) = _described(kind, name)
    owner, last = _at(message, steps[:-1], kind), steps[-1]
    if isinstance(last, int):
        raise InputError(f"{kind}: {name} is a structure; give its fields")
    if node is Nodetype.NAME:
        inner = getattr(owner, last)
        if described in TIMES:

            def stamp(value: Any) -> None:
                inner.sec, inner.nanosec = divmod(int(_item(value)), NS)

            return stamp
        parts = fields_of(described)
        if any(part[0] is not Nodetype.BASE or part[1][0] == "string" for _, part in parts):
            raise InputError(f"{kind}: {name} is a structure; give its fields")
        numbers = [field for field, _ in parts]

        def structure(value: Any) -> None:
            values = np.asarray(value).reshape(-1).tolist()
            for field, number in zip(numbers, values, strict=True):
                setattr(inner, field, number)

        return structure
    if node is Nodetype.BASE:
        whole = float if described[0].startswith("float") else operator.index
        convert: Callable[[Any], Any] = {"string": str, "bool": bool}.get(described[0], whole)
        return lambda value: setattr(owner, last, convert(_item(value)))
    (inner_node, element), count = described
    if inner_node is not Nodetype.BASE:
        raise InputError(f"{kind}: {name} is an array of structures; give the fields of each")
    if element[0] == "string":
        return lambda value: setattr(owner, last, list(value))
    dtype = _DTYPES.get(element[0], element[0])
    size = count if node is Nodetype.ARRAY else None

    def array(value: Any) -> None:
        values = np.ascontiguousarray(value, dtype).reshape(-1)
        if size is not None and len(values) != size:
            raise ValueError(f"it has {size} numbers")
        setattr(owner, last, values)

    return array


def _default(described: Any) -> Any:
    """Zero or empty."""
    from rosbags.interfaces import Nodetype

    node, content = described
    if node is Nodetype.NAME:
        return _empty(content)
    if node is Nodetype.BASE:
        zeros = {"string": "", "bool": False}
        return zeros.get(content[0], 0.0 if content[0].startswith("float") else 0)
    element, count = content
    count = count if node is Nodetype.ARRAY else 0
    if _named(element) or element[1][0] == "string":
        return [_default(element) for _ in range(count)]
    return np.zeros(count, _DTYPES.get(element[1][0], element[1][0]))


def _empty(kind: str) -> Any:
    """A message whose fields are zero or empty."""
    fields = fields_of(kind)
    return typestore().types[kind](**{name: _default(described) for name, described in fields})


@cache
def _getter(kind: str, name: str) -> Callable[[Any], Any]:
    """Gets a leaf of a message."""
    from rosbags.interfaces import Nodetype

    steps, (node, described) = _described(kind, name)

    def indexed(message: Any) -> Any:
        for step in steps:
            message = message[step] if isinstance(step, int) else getattr(message, step)
        return message

    plain = all(isinstance(step, str) for step in steps)
    part: Callable[[Any], Any] = operator.attrgetter(name) if plain else indexed
    if node is Nodetype.NAME:
        if described in TIMES:
            return lambda message: (stamp := part(message)).sec * NS + stamp.nanosec
        numbers = operator.attrgetter(*(field for field, _ in fields_of(described)))
        return lambda message: np.array(numbers(part(message)))
    if node is Nodetype.SEQUENCE and _named(described[0]):
        return lambda message: len(part(message))
    return part
