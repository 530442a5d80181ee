"""Source: the text of a robot's description, with the files and packages around it."""

import difflib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from xml.etree import ElementTree

from magtwin.errors import InputError
from magtwin.files import existing
from magtwin.urdf.source.markup import read_markup
from magtwin.urdf.source.package import Packages
from magtwin.urdf.source.xacro import expand


class MissingFileError(InputError):
    """A file that a description names is not there; whoever can do without it may go on."""


@dataclass(frozen=True)
class Source:
    """A description as plain URDF, its macros expanded."""

    path: Path
    """The file that was given."""

    xml: ElementTree.Element
    """Its `<robot>`."""

    places: Mapping[ElementTree.Element, tuple[Path, int]]
    """File and line that each element stands on, in a xacro those of the macro's text."""

    packages: Packages
    """Where `package://` leads."""

    notes: tuple[str, ...] = ()
    """What happened on the way to plain URDF, one line each."""

    @property
    def text(self) -> str:
        """The description as URDF, without comments."""
        return ElementTree.tostring(self.xml, encoding="unicode")

    def where(self, element: ElementTree.Element | None) -> str:
        """File and line of an element, as `file:line`; the file alone if it has none."""
        if element is None or element not in self.places:
            return str(self.path)
        file, line = self.places[element]
        return f"{file}:{line}"

    def find_file(self, filename: str, what: str, element: ElementTree.Element | None = None) -> Path:
        """The file that a `filename=` means.

        `package://NAME/rest` and `model://NAME/rest` lie in that package. All else is relative to the
        description's folder and may reach to the package that holds it, and into other packages.

        Args:
            filename: As it is written in the description.
            what: What is looked for ("mesh", "texture"), for refusals.
            element: Where it is written, for refusals.

        Raises:
            MissingFileError: The file is not there; the text says which name is near.
            InputError: Its package is not there, or it lies outside of where the description may read.
        """
        start = f"{self.where(element)}: {what} {filename!r}"
        try:
            return self._found(filename, what, start)
        except (OSError, RuntimeError) as error:  # a name that is too long, links in a circle
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"{start} cannot be looked for ({reason})") from error

    def _found(self, filename: str, what: str, start: str) -> Path:
        """The file of `find_file`; `start` begins its refusals."""
        scheme, separator, rest = filename.partition("://")
        if separator and scheme not in ("package", "model", "file"):
            raise InputError(f"{start} is of scheme {scheme!r}; known: file, model, package")
        if scheme in ("package", "model") and separator:
            name, _, rest = rest.partition("/")
            try:
                folder = self.packages.find(name)
            except InputError as error:
                raise InputError(f"{start} is in a package: {error}") from error
            path = Path(os.path.normpath(folder / rest))
            inside = path.resolve().is_relative_to(folder.resolve())
        else:
            path = Path(os.path.normpath(self.path.resolve().parent / (rest if separator else filename)))
            folder, inside = self.packages.home, self.packages.holds(path)
        if not inside:
            raise InputError(
                f"{start} lies outside {folder}; files are read from there only: move it in, "
                "or name its folder by --package NAME=FOLDER"
            )
        if not path.is_file():
            siblings = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
            near = difflib.get_close_matches(path.name, siblings, n=1)
            advice = f"; did you mean {near[0]!r}?" if near else ""
            if what == "mesh":
                advice += "; --missing-meshes note does without it"
            raise MissingFileError(f"{start} is missing; looked for {path}{advice}")
        return path


def read_source(
    path: str | os.PathLike[str],
    *,
    packages: Mapping[str, Path] = MappingProxyType({}),
    arguments: Mapping[str, str] = MappingProxyType({}),
) -> Source:
    """Read a URDF, or a xacro with its macros expanded.

    Args:
        path: The file; a xacro by its suffix, or by its namespace in a file of another suffix.
        packages: Folders of packages by name, before those that are found.
        arguments: Values of a xacro's `<xacro:arg>`.

    Raises:
        InputError: The file is missing, is not XML (the line is given), has a DOCTYPE or is no
            `<robot>`; or its macros cannot be expanded.
    """
    path = existing(path, "URDF file")
    markup = read_markup(path, "URDF file")
    if markup.root.tag != "robot":
        line = markup.lines[markup.root]
        raise InputError(f"{path}:{line}: a URDF begins with <robot>, this file with <{markup.root.tag}>")
    around = Packages(packages, path)
    if path.suffix == ".xacro" or any(element.tag.startswith("xacro:") for element in markup.lines):
        xml, places, notes = expand(path, around, arguments)
        return Source(path, xml, MappingProxyType(places), around, notes)
    if arguments:
        raise InputError(f"{path}: is no xacro and takes no arguments; leave out {', '.join(arguments)}")
    return Source(
        path, markup.root, MappingProxyType({e: (path, n) for e, n in markup.lines.items()}), around
    )
