"""Folders: those in which a stage may name files, beside its own."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from magtwin.errors import InputError

ALLOW_DIR = "MAGTWIN_ALLOW_DIR"
"""Name of the variable that has these folders, separated by `:` (`;` on Windows)."""


def allowed_folders() -> tuple[str, ...]:
    """Folders that the user allows, with symlinks resolved.

    Raises:
        InputError: One of them does not exist or is a file.
    """
    folders = []
    for text in filter(None, os.environ.get(ALLOW_DIR, "").split(os.pathsep)):
        folder = Path(text).expanduser()
        if not folder.is_dir():
            what = "a file; give its folder" if folder.exists() else "no such folder"
            raise InputError(f"`allow` of {text}: {what}", parameter="allow")
        folders.append(str(folder.resolve()))
    return tuple(folders)


@contextmanager
def allow(*folders: str | os.PathLike[str]) -> Iterator[None]:
    """In the block, stages and robot descriptions may name files in these folders, and below them.

    A stage may name files of its own folder, and those that ship with magtwin. Any other file is refused,
    since a stage from a stranger could show it, or `export_scene` pack it. Processes that are started in the
    block have the permission too. The variable MAGTWIN_ALLOW_DIR gives it to all commands.

    Args:
        folders: Folders to allow, beside those that are allowed already.

    Raises:
        InputError: One of them does not exist or is a file.
    """
    before = os.environ.get(ALLOW_DIR)
    added = [str(Path(folder).absolute()) for folder in folders]
    if apart := [folder for folder in added if os.pathsep in folder]:
        raise InputError(f"{apart[0]}: a folder with {os.pathsep!r} in its name cannot be allowed; rename it")
    os.environ[ALLOW_DIR] = os.pathsep.join([*filter(None, [before]), *added])
    try:
        allowed_folders()
        yield
    finally:
        if before is None:
            del os.environ[ALLOW_DIR]
        else:
            os.environ[ALLOW_DIR] = before
