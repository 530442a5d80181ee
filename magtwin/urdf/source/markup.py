"""Markup: XML with the line of each element, without external references or entities."""

import io
import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.parsers import expat

from magtwin.errors import InputError
from magtwin.files.budget import BUDGETS, check_count, check_depth
from magtwin.files.file import read_bytes

_LONGEST_TAG = re.compile(rb"<[^<>]{%d}" % (1 << 20))
"""An element of over a million characters of attributes, which expat holds all at once."""


BLOCK = 1 << 16
"""Characters of a text that are worked on at once."""

LONG = 1 << 18
"""Characters of an element's text from which its attributes are not sorted."""


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
        InputError: The file cannot be read or decoded, is not XML, is too large, nests too deep, or has a
            DOCTYPE, whose entities could read other files or fill the memory. The message gives the line.
    """
    return parse_markup(read_bytes(path, what, "XML"), path)


def parse_markup(text: bytes, path: Path) -> Markup:
    """Elements of an XML text read from `path`; errors as for `read_markup`."""
    builder, depth, count = ElementTree.TreeBuilder(), 0, 0
    lines: dict[ElementTree.Element, int] = {}
    most_levels, most_elements = BUDGETS["XML"].depth, BUDGETS["XML"].count
    if _LONGEST_TAG.search(text):
        raise UnsafeError(f"{path}: not XML: an element of over a million characters")
    parser = expat.ParserCreate()
    parser.buffer_text, parser.buffer_size = True, BLOCK  # else each line becomes a text of its own

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth += 1
        count += 1 + len(attributes)
        if depth > most_levels or count > most_elements:
            where = f"{path}:{parser.CurrentLineNumber}"
            try:
                check_depth(where, "XML", depth, "elements")
                check_count(where, "XML", count, "elements and attributes")
            except InputError as error:
                raise UnsafeError(str(error)) from error
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
    """An element as text on one line, with sorted attributes unless it is `LONG`."""
    text = ElementTree.tostring(element, encoding="unicode").strip()
    text = text.encode("utf-8", "backslashreplace").decode("utf-8")
    if len(text) < LONG:
        with suppress(ElementTree.ParseError):  # a prefix without a namespace
            text = ElementTree.canonicalize(text, strip_text=True)
    line, apart = io.StringIO(), False
    for start in range(0, len(text), BLOCK):
        block = text[start : start + BLOCK]
        words = block.split()
        if words:
            line.write(" " * (start > 0 and (apart or block[0].isspace())) + " ".join(words))
        apart = block[-1].isspace() or (apart and not words)
    return line.getvalue()


def _undecodable(text: bytes, line: int) -> str:
    """The reason why a line is not UTF-8; "" if it is."""
    try:
        b"".join(text.split(b"\n")[line - 1 : line]).decode("utf-8")
    except UnicodeDecodeError as error:
        byte = error.object[error.start]
        return f"byte 0x{byte:02x} is not UTF-8; save the file as UTF-8, or declare its encoding"
    return ""
