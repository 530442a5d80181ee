"""Package: finds the folders that `package://`, `model://` and `$(find)` refer to."""

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from magtwin.errors import InputError, hint
from magtwin.urdf.source.markup import read_markup

MANIFEST = "package.xml"

DEPTH, FOLDERS = 3, 5_000
"""Depth of the search for packages below a folder, and most folders searched."""

MARKS = (
    *(MANIFEST, "CMakeLists.txt", "launch", "mesh", "meshes", "model.config", "models", "robots", "urdf"),
    "xacro",
)
"""Contents, any of which marks a folder without a manifest as a package."""


class Packages:
    """Folders of packages by name: those given by the user, then those found around a file.

    The search order is: given packages; packages above the file, by their `package.xml`; packages beside
    those, down to DEPTH folders below (below the file's folder if no package contains the file); last, a
    folder of that name that contains the file or lies beside it or a parent, at most DEPTH levels up. That
    last folder must look like a package (see MARKS), because the description chooses the name:
    `package://home` must not lead to a home folder. Nothing is executed, environment variables are not
    read, and symbolic links are not followed.
    """

    def __init__(self, given: Mapping[str, Path], file: Path) -> None:
        for name, folder in given.items():
            if not Path(folder).is_dir():
                raise InputError(f"package {name!r}: {folder} is not a folder; give --package {name}=FOLDER")
        self._given = {name: Path(folder).resolve() for name, folder in given.items()}
        self._folder = file.resolve().parent
        self._above = [p for p in (self._folder, *self._folder.parents) if (p / MANIFEST).is_file()]
        self._found: dict[str, list[Path]] | None = None
        self._complete = True
        self.notes: list[str] = []
        """Ambiguous packages, one line each."""

    @property
    def home(self) -> Path:
        """Folder that the file may read by relative paths: that of its package, otherwise its own."""
        return self._above[0] if self._above else self._folder

    def find(self, name: str) -> Path:
        """Folder of a package.

        Raises:
            InputError: No package of that name was found; the message suggests a near name.
        """
        if name in self._given:
            return self._given[name]
        found = self._search()
        if name in found:
            first, *others = found[name]
            if others:
                used = Path(os.path.relpath(first, self._folder)).as_posix()
                note = f"package {name!r} exists {len(others) + 1} times; {used} is used"
                if note not in self.notes:
                    self.notes.append(note)
            return first
        if name not in ("", ".", ".."):
            for parent in (self._folder, *self._folder.parents[:DEPTH]):
                for path in (parent, parent / name):
                    if path.name == name and (path == self._folder or _looks_like_package(path)):
                        return path
        known = {*self._given, *found}
        stopped = "" if self._complete else f" (the search ended after {FOLDERS} folders)"
        advice = f"; {hint(name, known)}" if known else ""
        raise InputError(f"no package {name!r} around it{stopped}; give --package {name}=FOLDER{advice}")

    def holds(self, path: Path) -> bool:
        """Whether a file lies in the home folder, in a given package or in a package that was found."""
        path = path.resolve()
        if any(path.is_relative_to(folder) for folder in (self.home, *self._given.values())):
            return True
        return any(path.is_relative_to(p) for folders in self._search().values() for p in folders)

    def _search(self) -> dict[str, list[Path]]:
        if self._found is None:
            self._found, left = {}, FOLDERS
            for folder in self._above:
                _add(folder, self._found)
            for base in [p.parent for p in self._above] or [self._folder]:
                for folder in _below(base, DEPTH):
                    left -= 1
                    if left < 0:
                        self._complete = False
                        return self._found
                    if folder not in self._above and (folder / MANIFEST).is_file():
                        _add(folder, self._found)
        return self._found


def _add(folder: Path, found: dict[str, list[Path]]) -> None:
    """Add a folder to the packages by the name in its manifest; an unreadable one names no package."""
    with suppress(InputError):
        name = (read_markup(folder / MANIFEST, "package manifest").root.findtext("name") or "").strip()
        folders = found.setdefault(name or folder.name, [])
        if folder not in folders:
            folders.append(folder)


def _looks_like_package(folder: Path) -> bool:
    try:
        return not folder.is_symlink() and any((folder / mark).exists() for mark in MARKS)
    except OSError:  # the name is too long, or the folder is not readable
        return False


def _below(base: Path, depth: int) -> Iterator[Path]:
    """Folders below a folder, nearest first, then by name; not those in packages, hidden ones or links."""
    level = [base]
    for _ in range(depth):
        below: list[Path] = []
        for folder in level:
            try:
                with os.scandir(folder) as entries:
                    names = sorted(
                        e.name
                        for e in entries
                        if not e.name.startswith(".") and e.is_dir(follow_symlinks=False)
                    )
            except OSError:
                continue
            for name in names:
                yield folder / name
                if not (folder / name / MANIFEST).is_file():
                    below.append(folder / name)
        level = below
