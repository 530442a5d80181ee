"""Files: those shipped with magtwin, outputs, checksums, and settings in TOML."""

import difflib
import errno
import hashlib
import os
import stat
import zipfile
from pathlib import Path
from typing import TypeVar

from magtwin.errors import NEAR, InputError
from magtwin.files.budget import check_count, check_decoded, check_size
from magtwin.files.children import run

T = TypeVar("T")


def shipped(*parts: str) -> Path:
    """A file or folder that ships with magtwin: `shipped("maps", "lab")`.

    `robots/`, `maps/`, `scenes/` and `weights/` are at the top of a checkout, or in the package under
    `_shipped/` if magtwin was installed from a wheel.
    """
    package = Path(__file__).resolve().parents[1]
    root = package / "_shipped"
    path = (root if root.is_dir() else package.parent).joinpath(*parts)
    if not path.exists():
        raise InputError(f"{path}: missing; reinstall magtwin")
    return path


NEAR_STEM = 0.5
"""Least similarity of a suggested file without its suffix, beside `NEAR` with it."""

_SPECIAL = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
"""Kinds of files that may never end, or never begin."""


MADE_BY = {
    "run": "magtwin run lab makes run/run.parquet",
    "file": "magtwin run lab makes run/run.parquet, and lab is a stage",
    "run, stage, map or recording": "magtwin run lab makes run/run.parquet, and lab is a stage",
    "recording": "magtwin sweep lab makes runs",
    "weights file": "magtwin train makes one",
    "data set": "magtwin dataset build makes one",
}
"""What makes a file of a kind, for one that is missing."""


def existing(path: str | os.PathLike[str], what: str) -> Path:
    """`path` if it is a regular file or a folder. Every file that a user names passes through here.

    Raises:
        InputError: It does not exist, or its links form a circle; the text names the expected kind of file
            and a similar name. Or it is a pipe, a socket or a device, which could be read without end.
    """
    path = Path(path)
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        made = f"; {MADE_BY[what]}" if what in MADE_BY else ""
        if not path.parent.is_dir():
            text = f"{path}: no such {what}; there is no folder {str(path.parent)!r}{made}"
            raise InputError(text) from None
        if path.is_symlink():
            text = f"a link to {str(path.readlink())!r}, which does not exist; restore that, or give another"
            raise InputError(f"{path}: no such {what}: {text}") from None
        near = _near_file(path)
        hint = f"; did you mean {near!r}?" if near else made
        raise InputError(f"{path}: no such {what}{hint}") from None
    except ValueError as error:  # a null character
        raise InputError(f"{str(path)!r}: no name of a {what}: {error}") from error
    except OSError as error:
        reason = "its links form a circle" if error.errno == errno.ELOOP else error.strerror
        raise InputError(f"{path}: no {what} can be read there ({reason})") from error
    for is_kind, kind in _SPECIAL:
        if is_kind(mode):
            raise InputError(f"{path}: {kind}, not a {what}; copy what it gives into a file")
    return path


def _near_file(path: Path) -> str:
    """The most similar name beside a file, "" if there is none: both with their suffixes and without."""
    names = difflib.get_close_matches(path.name, [p.name for p in path.parent.iterdir()], cutoff=NEAR)
    stems = (difflib.SequenceMatcher(None, path.stem, Path(name).stem) for name in names)
    return next((name for name, both in zip(names, stems, strict=True) if both.ratio() >= NEAR_STEM), "")


def existing_file(path: str | os.PathLike[str], what: str, kind: str) -> Path:
    """`path` if it is a regular file of a size that is read.

    Args:
        path: The file.
        what: Expected kind of file, for error messages ("path file").
        kind: Format in `magtwin.files.budget.BUDGETS`.

    Raises:
        InputError: As for `existing`; or it is a folder, or too large for its format.
    """
    path = existing(path, what)
    if path.is_dir():
        raise InputError(f"{path}: cannot be read (a folder); expected a {what}")
    check_size(path, kind)
    return path


def read_bytes(path: str | os.PathLike[str], what: str, kind: str) -> bytes:
    """Contents of a file; arguments and errors as for `existing_file`."""
    path = existing_file(path, what, kind)
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); expected a {what}") from error


def read_text(path: str | os.PathLike[str], what: str, kind: str, encoding: str = "utf-8") -> str:
    """Text of a file, with lines that end in a line feed.

    Arguments and errors are those of `existing_file`; a text that is not in the encoding is refused too.
    """
    data = read_bytes(path, what, kind)
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file ({error}); expected a {what} in UTF-8") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file, lower-case hex; of a file that is as it was, the one that is known."""
    path = existing(path, "file")
    if path.is_dir():
        raise InputError(f"{path}: a folder; name the file in it")
    status = path.stat()
    key = str(path.resolve()), status.st_ino, status.st_size, status.st_mtime_ns
    if key not in _SUMS:
        with path.open("rb") as file:
            _SUMS[key] = hashlib.file_digest(file, "sha256").hexdigest()
    return _SUMS[key]


_SUMS: dict[tuple[str, int, int, int], str] = {}
"""Checksums by name, inode, size and time of change, since several readers of a file each need it."""


def check_zip(path: Path, archive: zipfile.ZipFile, kind: str, noun: str) -> None:
    """Refuse a zip file that would become too large in memory.

    Args:
        path: The file.
        archive: The file, opened.
        kind: Format in `magtwin.files.budget.BUDGETS`.
        noun: Its entries, for error messages.

    Raises:
        InputError: It has too many entries, decompresses to too much, or is compressed other than by deflate,
            which alone needs no more memory than its budget.
    """
    entries = archive.infolist()
    check_count(path, kind, len(entries), noun)
    check_decoded(path, path.stat().st_size, sum(entry.file_size for entry in entries))
    for entry in entries:
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise InputError(
                f"{path}: compressed by method {entry.compress_type} of zip; use deflate, or none"
            )


_GIT_S = 60.0
"""Time limit of git [s]; it takes 0.01 s."""


def git_revision(folder: str | os.PathLike[str]) -> str:
    """The commit of the Git checkout that contains a folder.

    Returns:
        The commit, or "" if there is no checkout, no git, or no answer: a checkout of a stranger can name a
        pipe, for which git waits.
    """
    place = Path(folder).absolute()
    settings = [parent / ".git" / "config" for parent in (place, *place.parents)]
    if any(os.path.lexists(path) and not path.is_file() for path in settings):
        return ""
    command = ["git", "-c", "safe.directory=*", "-C", os.fspath(folder)]
    command += ["rev-parse", "--verify", "-q", "HEAD"]
    try:
        done = run(command, limit_s=_GIT_S, changes={n: None for n in os.environ if n.startswith("GIT_")})
    except OSError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
