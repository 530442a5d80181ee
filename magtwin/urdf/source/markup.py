"""Markup: XML read with the line of each element, and with nothing in it that reaches out or blows up."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

from magtwin.errors import InputError

MAX_DEPTH = 200
"""Elements within elements; no description comes near it, and deeper ones exhaust the stack."""


@dataclass(frozen=True)
class Markup:
    """An XML file: its elements, comments left out, and the line that each starts on."""

    root: ElementTree.Element

    lines: dict[ElementTree.Element, int]
    """In the order of the file."""


def read_markup(path: Path, what: str) -> Markup:
    """Read an XML file.

    Args:
        path: The file.
        what: What it is, for refusals ("URDF file").

    Raises:
        InputError: The file cannot be read or decoded; is not XML (the line is given); has a DOCTYPE,
            through which entities could reach other files or fill the memory; or nests too deep.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); a {what} is wanted") from error
    return parse_markup(text, path)


def parse_markup(text: bytes, path: Path) -> Markup:
    """The elements of an XML text; `path` and the rest as for `read_markup`."""
    builder, lines, depth = ElementTree.TreeBuilder(), {}, 0
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > MAX_DEPTH:
            raise InputError(f"{path}:{parser.CurrentLineNumber}: nests deeper than {MAX_DEPTH} elements")
        lines[builder.start(tag, attributes)] = parser.CurrentLineNumber

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def doctype(*_: Any) -> None:
        raise InputError(
            f"{path}:{parser.CurrentLineNumber}: has a DOCTYPE, whose entities are not followed; "
            "remove it and write values out"
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
    except (LookupError, ValueError) as error:  # an encoding that Python does not know, or not as expat needs
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}:1: not XML: {error}; save the file as UTF-8") from error
    return Markup(builder.close(), lines)


def _undecodable(text: bytes, line: int) -> str:
    """What to say of a line that is not the UTF-8 that it is taken for; "" if it is."""
    try:
        text.split(b"\n")[line - 1].decode("utf-8")
    except (UnicodeDecodeError, IndexError) as error:
        if isinstance(error, UnicodeDecodeError):
            byte = error.object[error.start]
            return f"byte 0x{byte:02x} is not UTF-8; save the file as UTF-8, or declare its encoding"
    return ""
