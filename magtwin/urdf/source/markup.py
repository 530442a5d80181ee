"""Markup: XML with the line of each element, without external references or entities."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

from magtwin.errors import InputError

MAX_DEPTH = 200
"""Most levels of nested elements; deeper nesting would exhaust the stack."""


class UnsafeError(InputError):
    """A file that could read other files or fill the memory; never repaired."""


@dataclass(frozen=True)
class Markup:
    """Elements of an XML file without comments, and the line on which each starts."""

    root: ElementTree.Element

    lines: dict[ElementTree.Element, int]
    """In the order of the file."""


def read_markup(path: Path, what: str) -> Markup:
    """Read an XML file.

    Args:
        path: The file.
        what: Kind of file, for error messages ("URDF file").

    Raises:
        InputError: The file cannot be read or decoded, is not XML, nests too deep, or has a DOCTYPE, whose
            entities could read other files or fill the memory. The message gives the line.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a {what}") from error
    return parse_markup(text, path)


def parse_markup(text: bytes, path: Path) -> Markup:
    """Elements of an XML text read from `path`; errors as for `read_markup`."""
    builder, lines, depth = ElementTree.TreeBuilder(), {}, 0
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH:
            raise UnsafeError(f"{path}:{parser.CurrentLineNumber}: nests deeper than {MAX_DEPTH} elements")
        lines[builder.start(tag, attributes)] = parser.CurrentLineNumber

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def doctype(*_: Any) -> None:
        raise UnsafeError(
            f"{path}:{parser.CurrentLineNumber}: has a DOCTYPE, whose entities are not followed; "
            "remove it and write the values in full"
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.CharacterDataHandler = builder.data
    parser.StartDoctypeDeclHandler = doctype
    try:
        parser.Parse(text, True)
    except expat.ExpatError as error:
        reason = expat.errors.messages[error.code]
        bad = _undecodable(text, error.lineno) if reason == "not well-formed (invalid token)" else ""
        raise InputError(
            f"{path}:{error.lineno}: not XML: {bad or reason} (column {error.offset})"
        ) from error
    except (LookupError, ValueError) as error:  # an encoding unknown to Python, or unusable for expat
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}:1: not XML: {error}; save the file as UTF-8") from error
    return Markup(builder.close(), lines)


def plain_text(element: ElementTree.Element) -> str:
    """An element as text on one line, with sorted attributes."""
    text = ElementTree.tostring(element, encoding="unicode").strip()
    with suppress(ElementTree.ParseError):  # a prefix without a namespace
        text = ElementTree.canonicalize(text, strip_text=True)
    return " ".join(text.split())


def _undecodable(text: bytes, line: int) -> str:
    """The reason why a line is not UTF-8; "" if it is."""
    try:
        b"".join(text.split(b"\n")[line - 1 : line]).decode("utf-8")
    except UnicodeDecodeError as error:
        byte = error.object[error.start]
        return f"byte 0x{byte:02x} is not UTF-8; save the file as UTF-8, or declare its encoding"
    return ""
