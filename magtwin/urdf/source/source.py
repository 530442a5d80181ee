"""Source: a robot description as plain URDF, with the files and packages around it."""

import os
import re
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

SCHEMES = ("package", "model")
"""Schemes of names in packages."""

_SCHEME, _ODD = re.compile("(package|model|file):"), re.compile("(package|model):(?!//[^/])")
"""A name with a scheme, and one with too few or too many slashes after it."""

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

    _advised: set[Path] = field(default_factory=set)
    """Folders of missing files for which a near name was looked for."""

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
        """The file that a `filename=` refers to: the first of `_candidates` that exists and may be read.

        Any but the first is a repair. What lies outside the trusted area and all packages is never read.

        Args:
            filename: Name in the description.
            what: Kind of file ("mesh", "texture"), for messages.
            element: Element with the name, for messages.

        Raises:
            MissingFileError: The file or its package does not exist; the message suggests a near name, once
                for each folder. Or its scheme is unknown, such as https: nothing is downloaded.
            UnsafeError: The description may not read the file.
            InputError: It cannot be looked for.
        """
        start = f"{self.where(element)}: {what} {filename!r}"
        try:
            return self._locate(filename, what, start, element)
        except (OSError, RuntimeError) as error:  # the name is too long, or links form a circle
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"{start} cannot be looked for ({reason})") from error

    def _locate(self, filename: str, what: str, start: str, element: ElementTree.Element | None) -> Path:
        """The file of `find_file`; `start` begins its error messages."""
        scheme, separator, _ = filename.partition("://")
        if separator and scheme not in (*SCHEMES, "file"):
            raise MissingFileError(f"{start} has scheme {scheme!r}; known: file, model, package")
        written, unknown = self._as_written(filename)
        found = written if written and self.packages.holds(written) and written.is_file() else None
        others = () if found else self._others(filename)
        found = found or next((p for p in others if os.path.isfile(p) and self.packages.holds(p)), None)  # noqa: PTH113
        if found is not None:
            if found != written or "\\" in filename or _ODD.match(filename):
                shown = Path(os.path.relpath(found, self.path.resolve().parent)).as_posix()
                text = f"{what} {filename!r} is read as {shown!r}"
                self.repairs.add("file-name", text, self.place(element))
            return found
        if unknown is not None:
            missing = MissingFileError(f"{start} is in a package: {unknown}")
            missing.supply, missing.near = unknown.supply, unknown.near
            raise missing from unknown
        assert written is not None
        foreign = Path(filename.removeprefix("file://")).is_absolute() and not written.parent.is_dir()
        if not self.packages.holds(written) and not foreign:
            name = filename.partition("://")[2].partition("/")[0] if separator and scheme != "file" else ""
            folder = self.packages.find(name) if name else self.packages.home
            raise UnsafeError(
                f"{start} lies outside {folder}; files are read from there only: move it in, "
                "name its folder by --package NAME=FOLDER, or --allow it"
            )
        folder, advice = written.parent, ""
        if folder.is_dir() and folder not in self._advised:
            advice = self.repairs.suggestion(written.name, [p.name for p in folder.iterdir()], near)
        self._advised.add(folder)
        absent = MissingFileError(f"{start} is missing{advice}; looked for {written}")
        absent.near = advice
        raise absent

    def _as_written(self, filename: str) -> tuple[Path | None, MissingFileError | None]:
        """The file as the name says, in its package or beside the description; or why it is in no package."""
        name, here = filename.replace("\\", "/"), self.path.resolve().parent
        scheme, _, rest = name.partition(":") if _SCHEME.match(name) else ("", "", name)
        if scheme in SCHEMES:
            package, _, rest = rest.lstrip("/").partition("/")
            if name.startswith(f"{scheme}:///") and (not rest or (here / package / rest).is_file()):
                return Path(os.path.normpath(here / package / rest)), None  # it names no package
            try:
                return Path(os.path.normpath(self.packages.find(package) / rest)), None
            except MissingFileError as error:
                return None, error
        return Path(os.path.normpath(here / rest.removeprefix("//"))), None

    def _others(self, filename: str) -> list[Path]:
        """Where else a file may be: its tail at each folder from the description up, then in packages.

        The tail is the name without `..`, and what follows the name of a known package in it: a path of
        another machine begins anew there. A file that several packages have is in none of them.
        """
        rest = filename.replace("\\", "/").rpartition(":")[2]
        parts = [part for part in rest.split("/") if part not in ("", ".", "..")]
        folders, known = self.packages.up(), self.packages.known()
        rooted = [
            folder.joinpath(*parts[i + 1 :]) for i in range(len(parts)) for folder in known.get(parts[i], ())
        ]
        tails = [parts, parts[1:]] if filename.partition(":")[0] in SCHEMES else [parts]
        beside = [folders[0].joinpath(*parts[i:]) for i in range(len(parts))]
        above = [folder.joinpath(*tail) for tail in tails for folder in folders if tail]
        packages = {folder for some in known.values() for folder in some}
        held = {folder.joinpath(*tail) for tail in tails if tail for folder in packages}
        single = [path for path in held if os.path.isfile(path)]  # noqa: PTH113, which may raise
        return [*rooted, *beside, *above, *(single if len(single) == 1 else ())]


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
    given, path = path, existing(path, "URDF file")
    markup = read_markup(path, "URDF file")
    if markup.root.tag != "robot":
        line = markup.lines[markup.root]
        raise InputError(f"{path}:{line}: a URDF begins with <robot>, this file with <{markup.root.tag}>")
    around = Packages(packages, path, Path.cwd() if not Path(given).is_absolute() else None)
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
