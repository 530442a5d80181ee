"""Package: where the folders that `package://`, `model://` and `$(find)` name are."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from magtwin.errors import InputError, hint
from magtwin.urdf.source.markup import read_markup

MANIFEST = "package.xml"

DEPTH, FOLDERS = 3, 5_000
"""How far below a folder packages are looked for, and in how many folders at most."""

MARKS = (
    MANIFEST,
    "CMakeLists.txt",
    "launch",
    "mesh",
    "meshes",
    "model.config",
    "models",
    "robots",
    "urdf",
    "xacro",
)
"""What a folder holds, one of these, that is a package without saying so."""


class Packages:
    """Folders of packages by name: those that the user gave, then those found around a file.

    Looked at in this order: given ones; those above the file, by their `package.xml`; those beside
    them, down to DEPTH folders below (below the file's own folder where no package holds it); last, a
    folder of that name that holds the file or lies beside it or its parents, no more than DEPTH above. It
    must look like a package, see MARKS: a description chooses the name, and `package://home` is none.
    Nothing is executed, no environment variable is read, and symbolic links are not walked through.
    """

    def __init__(self, given: Mapping[str, Path], file: Path) -> None:
        for name, folder in given.items():
            if not Path(folder).is_dir():
                raise InputError(f"package {name!r}: {folder} is no folder; give --package {name}=FOLDER")
        self._given = {name: Path(folder).resolve() for name, folder in given.items()}
        self._folder = file.resolve().parent
        self._above = [p for p in (self._folder, *self._folder.parents) if (p / MANIFEST).is_file()]
        self._found: dict[str, list[Path]] | None = None
        self._complete = True
        self.notes: list[str] = []
        """What was ambiguous, one line each."""

    @property
    def home(self) -> Path:
        """Folder that the file may reach by relative paths: its package's, or else its own."""
        return self._above[0] if self._above else self._folder

    def find(self, name: str) -> Path:
        """Folder of a package.

        Raises:
            InputError: There is none of that name around; the text says what is.
        """
        if name in self._given:
            return self._given[name]
        found = self._search()
        if name in found:
            first, *others = found[name]
            if others:
                used = Path(os.path.relpath(first, self._folder)).as_posix()
                note = f"package {name!r} is there {len(others) + 1} times; {used} is used"
                if note not in self.notes:
                    self.notes.append(note)
            return first
        above = (self._folder, *self._folder.parents[:DEPTH])
        around = [p for parent in above for p in (parent, parent / name) if p.name == name]
        named = next((p for p in around if p == self._folder or _looks_like_one(p)), None)
        if named is not None and name not in ("", ".", ".."):
            return named
        known = {*self._given, *found}
        stopped = "" if self._complete else f" (the search ended after {FOLDERS} folders)"
        raise InputError(
            f"no package {name!r} around it{stopped}; give --package {name}=FOLDER"
            + (f"; {hint(name, known)}" if known else "")
        )

    def holds(self, path: Path) -> bool:
        """Whether a file lies in the home folder, in a given package or in one that was found."""
        path = path.resolve()
        if any(path.is_relative_to(folder) for folder in (self.home, *self._given.values())):
            return True
        return any(path.is_relative_to(p) for folders in self._search().values() for p in folders)

    def _search(self) -> dict[str, list[Path]]:
        if self._found is None:
            self._found, budget = {}, FOLDERS
            for folder in self._above:
                self._add(folder)
            bases = [p.parent for p in self._above] or [self._folder]
            for base in bases:
                for folder in _below(base, DEPTH):
                    budget -= 1
                    if budget < 0:
                        self._complete = False
                        return self._found
                    if folder not in self._above and (folder / MANIFEST).is_file():
                        self._add(folder)
        return self._found

    def _add(self, folder: Path) -> None:
        assert self._found is not None
        try:
            name = (read_markup(folder / MANIFEST, "package manifest").root.findtext("name") or "").strip()
        except InputError:
            return  # a manifest that cannot be read names no package
        folders = self._found.setdefault(name or folder.name, [])
        if folder not in folders:
            folders.append(folder)


def _looks_like_one(folder: Path) -> bool:
    """Whether a folder without a manifest is that of a package all the same."""
    try:
        return not folder.is_symlink() and any((folder / mark).exists() for mark in MARKS)
    except OSError:  # a name that is too long, or a folder that may not be read
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
