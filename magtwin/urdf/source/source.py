"""Source: a robot description as plain URDF, with the files and packages around it."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree

from magtwin.errors import InputError, near
from magtwin.files.file import existing
from magtwin.urdf.repairs import Repairs
from magtwin.urdf.source.markup import UnsafeError, read_markup
from magtwin.urdf.source.package import MissingFileError, Packages

EXPANDER = "magtwin.urdf.source.xacro"
"""Module of macros, with its interpreter, which a plain URDF does not need."""


@dataclass(frozen=True)
class Source:
    """A description as plain URDF, with its macros expanded."""

    path: Path
    """The file that the user gave."""

    xml: ElementTree.Element
    """Its `<robot>`."""

    places: Mapping[ElementTree.Element, tuple[Path, int]]
    """File and line of each element; for a xacro, those of the macro's text."""

    packages: Packages
    """Finds the folders of `package://`."""

    repairs: Repairs = field(default_factory=Repairs)
    """Receives every repair and note of the conversion; those of the expansion so far."""

    @cached_property
    def elements(self) -> Mapping[tuple[str, str], ElementTree.Element]:
        """The first element of each kind and name, from when every link and joint has its own name.

        Keys are `robot/TAG` and name of elements directly below `<robot>`; tag and filename of those that
        name a file, and "" and filename of the first of any tag.
        """
        first: dict[tuple[str, str], ElementTree.Element] = {}
        for element in self.xml:
            if "name" in element.attrib:
                first.setdefault((f"robot/{element.tag}", element.attrib["name"]), element)
        for element in self.xml.iter():
            filename = element.get("filename")
            if filename is not None:
                first.setdefault((element.tag, filename), element)
                first.setdefault(("", filename), element)
        return first

    def where(self, element: ElementTree.Element | None) -> str:
        """File and line of an element, as `file:line`; the file alone if it has none."""
        if element is None or element not in self.places:
            return str(self.path)
        file, line = self.places[element]
        return f"{file}:{line}"

    def place(self, element: ElementTree.Element | None) -> tuple[str, int]:
        """File, relative to the folder of the description, and line of an element; ("", 0) if unknown."""
        if element is None or element not in self.places:
            return "", 0
        file, line = self.places[element]
        return Path(os.path.relpath(file, self.path.parent)).as_posix(), line

    def find_file(self, filename: str, what: str, element: ElementTree.Element | None = None) -> Path:
        """The file that a `filename=` refers to.

        `package://NAME/rest` and `model://NAME/rest` lie in that package. Any other name is relative to the
        folder of the description, or else to its package, and may lie in its package or in other packages.

        Args:
            filename: Name in the description.
            what: Kind of file ("mesh", "texture"), for error messages.
            element: Element with the name, for error messages.

        Raises:
            MissingFileError: The file or its package does not exist; the message suggests a near name. Or
                its scheme is unknown, such as https: nothing is downloaded.
            UnsafeError: The description may not read the file.
            InputError: It cannot be looked for.
        """
        start = f"{self.where(element)}: {what} {filename!r}"
        try:
            return self._locate(filename, what, start)
        except (OSError, RuntimeError) as error:  # the name is too long, or links form a circle
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"{start} cannot be looked for ({reason})") from error

    def _locate(self, filename: str, what: str, start: str) -> Path:
        """The file of `find_file`; `start` begins its error messages."""
        scheme, separator, rest = filename.partition("://")
        if separator and scheme not in ("package", "model", "file"):
            raise MissingFileError(f"{start} has scheme {scheme!r}; known: file, model, package")
        if separator and scheme != "file":
            name, _, rest = rest.partition("/")
            try:
                folder = self.packages.find(name)
            except MissingFileError as error:
                missing = MissingFileError(f"{start} is in a package: {error}")
                missing.supply, missing.near = error.supply, error.near
                raise missing from error
            path = Path(os.path.normpath(folder / rest))
            inside = path.resolve().is_relative_to(folder.resolve())
        else:
            path = Path(os.path.normpath(self.path.resolve().parent / (rest if separator else filename)))
            folder, inside = self.packages.home, self.packages.holds(path)
            other = self.packages.home / filename
            if inside and not path.is_file() and self.packages.holds(other) and other.is_file():
                path = Path(os.path.normpath(other))
        if not inside:
            raise UnsafeError(
                f"{start} lies outside {folder}; files are read from there only: move it in, "
                "or name its folder by --package NAME=FOLDER"
            )
        if not path.is_file():
            siblings = (p.name for p in path.parent.iterdir()) if path.parent.is_dir() else ()
            advice = self.repairs.suggestion(path.name, siblings, near)
            absent = MissingFileError(f"{start} is missing{advice}; looked for {path}")
            absent.near = advice
            raise absent
        return path


def read_source(
    path: str | os.PathLike[str],
    *,
    packages: Mapping[str, Path] = MappingProxyType({}),
    arguments: Mapping[str, str] = MappingProxyType({}),
    skip_missing_includes: bool = False,
) -> Source:
    """Read a URDF, or a xacro with its macros expanded.

    Args:
        path: The file; it is a xacro if its suffix is .xacro or it has elements `xacro:`.
        packages: Folders of packages by name; they override packages that are found.
        arguments: Values of a xacro's `<xacro:arg>`.
        skip_missing_includes: Whether to skip missing includes of a xacro of which no macro is called.

    Raises:
        InputError: The file is missing, is not XML, has a DOCTYPE, is not a `<robot>`, or has macros that
            cannot be expanded. The message gives the line.
    """
    path = existing(path, "URDF file")
    markup = read_markup(path, "URDF file")
    if markup.root.tag != "robot":
        line = markup.lines[markup.root]
        raise InputError(f"{path}:{line}: a URDF begins with <robot>, this file with <{markup.root.tag}>")
    around = Packages(packages, path)
    if path.suffix == ".xacro" or any(element.tag.startswith("xacro:") for element in markup.lines):
        repairs, xacro = Repairs(), import_module(EXPANDER)
        xml, places = xacro.expand(
            path, around, arguments, repairs, skip_missing_includes=skip_missing_includes
        )
        return Source(path, xml, MappingProxyType(places), around, repairs)
    if arguments:
        raise InputError(f"{path}: is not a xacro and takes no arguments; leave out {', '.join(arguments)}")
    places = MappingProxyType({element: (path, line) for element, line in markup.lines.items()})
    return Source(path, markup.root, places, around)
