"""Package: finds the folders that `package://`, `model://` and `$(find)` refer to."""

import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from magtwin.errors import InputError, hint, near
from magtwin.files.folders import allowed_folders
from magtwin.urdf.source.markup import read_markup

MANIFEST = "package.xml"

DEPTH, FOLDERS = 3, 5_000
"""Depth of the search for packages below a folder, and most folders searched."""

MARKS = (
    *(MANIFEST, "CMakeLists.txt", "launch", "mesh", "meshes", "model", "model.config", "models", "robots"),
    *("urdf", "xacro"),
)
"""Contents, any of which marks a folder without a manifest as a package."""


SUBFOLDERS = ("robot", "robots", "urdf", "xacro")
"""Usual names of a folder with descriptions, inside the folder of a robot."""

BESIDE = ("materials", "mesh", "meshes", "textures", *SUBFOLDERS)
"""Folders beside such a folder that a description without a package may read."""


class MissingFileError(InputError):
    """A file or package named in a description is missing; the caller may be able to continue without it."""

    supply = ""
    """Option of the command line that would supply it, such as `--package arm=FOLDER`."""

    near = ""
    """The nearest known name, as an addition to a text."""


class Packages:
    """Folders of packages by name: those given by the user, then those found around a file.

    The search order is: given packages; packages above the file, by their `package.xml`; packages beside
    those, down to DEPTH folders below (below the file's folder if no package contains the file); a folder
    of that name that contains the file or lies beside it or a parent, at most DEPTH levels up; last, the
    packages of ROS: `share/NAME` below each folder of AMENT_PREFIX_PATH. A folder found by its name alone
    must look like a package (see MARKS), because the description chooses the name: `package://home` must not
    lead to a home folder. Of the packages of ROS, only those that the description names are read. Nothing is
    executed, and symbolic links around the file are not followed.
    """

    def __init__(self, given: Mapping[str, Path], file: Path, root: Path | None = None) -> None:
        """Arguments: given packages, the description, and the folder from which its name was given."""
        for name, folder in given.items():
            if not Path(folder).is_dir():
                raise InputError(f"package {name!r}: {folder} is not a folder; give --package {name}=FOLDER")
        self._given = {name: Path(folder).resolve() for name, folder in given.items()}
        self._folder = file.resolve().parent
        folders = (self._folder, *self._folder.parents)
        self._above = [p for p in folders if (p / MANIFEST).is_file()]
        trusted = [p for p in folders if p in self._above or (p / ".git").exists()]
        whole = (Path.home(), folders[-1])  # of a user, and of a machine
        trusted += [p for p in folders if root is not None and p == root.resolve() and p not in whole]
        self.home: Path = trusted[0] if trusted else self._folder
        """Folder that the file may read: the nearest above it with `package.xml` or `.git`, or `root`, or its
        own."""
        beside = self._folder.parent if not trusted and self._folder.name in SUBFOLDERS else None
        self._beside = [beside / name for name in BESIDE] if beside else []
        self._found: dict[str, list[Path]] | None = None
        self._installed: dict[str, Path] = {}
        self._complete = True
        self.notes: list[str] = []
        """Ambiguous packages, one line each."""

    def up(self) -> list[Path]:
        """The folders from that of the file up to `home`."""
        return [p for p in (self._folder, *self._folder.parents) if p.is_relative_to(self.home)]

    def known(self) -> dict[str, list[Path]]:
        """Folders of the packages given and found, by name."""
        return self._search() | {name: [folder] for name, folder in self._given.items()}

    def find(self, name: str) -> Path:
        """Folder of a package.

        Raises:
            MissingFileError: No package of that name was found; the message suggests a near name.
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
                        self._installed[name] = path.resolve()
                        return path
            folder = self._installed.get(name) or _installed(name)
            if folder is not None:
                self._installed[name] = folder
                return folder
        known = {*self._given, *found}
        stopped = "" if self._complete else f" (the search ended after {FOLDERS} folders)"
        advice = f"; {hint(name, known)}" if known else ""
        error = MissingFileError(
            f"no package {name!r} around it{stopped}; give --package {name}=FOLDER{advice}"
        )
        error.supply, error.near = f"--package {name}=FOLDER", near(name, known)
        raise error

    def holds(self, path: Path) -> bool:
        """Whether a file lies in the home folder, beside it (see BESIDE), in a package, or where `allow` is.

        Packages are those given, those around the file, and those of ROS that `find` found.
        """
        path, installed = path.resolve(), self._installed.values()
        allowed = (self.home, *self._given.values(), *self._beside, *installed, *allowed_folders())
        if any(path.is_relative_to(str(folder)) for folder in allowed):
            return True
        return any(path.is_relative_to(p) for folders in self._search().values() for p in folders)

    def _search(self) -> dict[str, list[Path]]:
        if self._found is None:
            self._found, left = {}, FOLDERS
            for folder in self._above:
                _add(folder, self._found)
            for base in [p.parent for p in self._above] or dict.fromkeys((self._folder, self.home)):
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


def _installed(name: str) -> Path | None:
    """Folder of a package of ROS in AMENT_PREFIX_PATH; None if there is none."""
    if not name or Path(name).name != name:
        return None
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    folders = (Path(prefix) / "share" / name for prefix in prefixes)
    return next((folder.resolve() for folder in folders if _has_manifest(folder)), None)


def _has_manifest(folder: Path) -> bool:
    try:
        return (folder / MANIFEST).is_file()
    except OSError:  # the name is too long, or the folder is not readable
        return False


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
