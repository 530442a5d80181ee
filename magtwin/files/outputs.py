"""Outputs: files and folders that appear whole, or not at all.

An output is written in a hidden folder beside its place, is brought to the disk, and is then renamed. A
killed process leaves its hidden folder; each output is then as it was before, or whole and new.

A command asks for its names by `free`: an output that exists is not in the way, NAME-1 is made. Functions
refuse an output that exists, but for `force=True`.

A link at the place of an output is itself replaced: what it leads to stays as it is, so that no link in a
stranger's folder leads a write elsewhere. Only a file that is rewritten in its place is found through a link.
"""

import ctypes
import errno
import filecmp
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from zlib import crc32

from magtwin.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: names are not kept from other commands
    fcntl = None  # type: ignore[assignment]

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Errors of a disk that is full or read-only."""

HIDDEN = ".magtwin-"
"""In the name of every hidden folder."""

WORKSHOP = "magtwin-workshop-"
"""Begin of the name of a temporary folder with what a scene in memory needs until Python ends."""

_WRITTEN = re.compile(
    r"\.(bin|bmp|csv|dae|db3|exr|gif|glb|gltf|hdr|html|jpe?g|json|mcap|md|mtl|npz|obj|parquet|pgm|ply|png|rrd)"
    r"|\.(safetensors|sdf|stl|svg|tga|tiff?|toml|tum|urdf|usd[acz]?|webp|world|xml|yaml)|"
)
"""Suffixes of files that magtwin writes or copies into folders; none for a licence."""

_inputs: ContextVar[tuple[Path, ...]] = ContextVar("inputs", default=())
"""Files and folders that the command reads, which no output may remove."""

_names: ContextVar["_Names | None"] = ContextVar("names", default=None)
"""Names of the command's outputs; None outside of a command."""

_pending: ContextVar["tuple[list[_Aside], list[Callable[[], object]]] | None"] = ContextVar(
    "pending", default=None
)
"""Outputs and functions that wait for the end of the transaction; None outside of one."""


def check_free(path: str | os.PathLike[str], *, force: bool = False, in_place: bool = False) -> Path:
    """`path` if an output can be made there: it does not exist yet, or `force` is True.

    Raises:
        InputError: It exists and `force` is False, or it is an input of the command and not `in_place`. Or it
            cannot be replaced, or be the name of an output.
    """
    path = _named(Path(path))
    if os.path.lexists(path) and not force:
        link = " as a link" if path.is_symlink() else ""
        text = f"{path}: exists already{link}; give `force=True` to replace it, or another name"
        raise InputError(text, parameter="force")
    if not in_place and Path(os.path.realpath(path)) in _inputs.get():
        raise InputError(f"{path}: is read by this command and would be replaced; give another name")
    return path


def free(*paths: Path, beside: Iterable[str] = (), force: bool = False) -> list[Path]:
    """Names for a command's outputs that nothing has yet: NAME, else NAME-1, NAME-2, ..., all of one number.

    Until the command ends, no other command is given the same names: a hidden file beside each of them is
    locked. A killed command leaves that file, which the next one takes over and removes.

    Args:
        paths: The names asked for. Their folders are created; those that remain empty are removed.
        beside: Endings of what is made beside an output: ".md" stands for NAME.md.
        force: Whether outputs that exist are replaced: the names are those asked for.

    Raises:
        InputError: A folder cannot be written, or the path cannot be the name of an output.
    """
    if force:
        return [check_free(path, force=True) for path in paths]
    names, endings, number = _names.get(), tuple(beside), 0
    while True:
        found = [_numbered(_named(path), number) for path in paths]
        others = (path.with_name(f"{path.stem}{ending}") for path in found for ending in endings)
        taken = any(map(os.path.lexists, (*found, *others)))
        if not taken and (names is None or all(map(names.claim, found))):
            instead().update(zip(paths, found, strict=True) if number else ())
            return found
        number += 1


def instead() -> dict[Path, Path]:
    """Names that `free` gave in place of those asked for, so far in this command."""
    names = _names.get()
    return {} if names is None else names.instead


def _numbered(path: Path, number: int) -> Path:
    """NAME-1.txt for NAME.txt; NAME_1.py, as a module's name has no hyphen."""
    mark = "_" if path.suffix.lower() == ".py" else "-"
    return path.with_name(f"{path.stem}{mark}{number}{path.suffix}") if number else path


@dataclass
class _Names:
    """Names that a command claimed, and what is undone at its end."""

    end: ExitStack
    instead: dict[Path, Path] = field(default_factory=dict)

    def claim(self, path: Path) -> bool:
        """Keep a name from other commands; False if one has it, or has just made the output."""
        if fcntl is None:
            return True
        lock = path.with_name(f".{path.name[:60]}{HIDDEN}{crc32(os.fsencode(path.name)):08x}").absolute()
        try:
            for folder in reversed([folder for folder in lock.parents if not folder.exists()]):
                folder.mkdir(exist_ok=True)
                self.end.callback(_remove_empty, folder)
            number = os.open(lock, os.O_RDWR | os.O_CREAT, 0o600)
        except OSError as error:
            reason = f"cannot be written ({error.strerror})"
            raise InputError(f"{path}: {reason}; give a name in another folder") from error
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            mine = os.path.samestat(os.fstat(number), lock.stat())
        except BlockingIOError:
            os.close(number)
            return False
        except OSError:  # a file system without locks, or the file has gone
            mine = lock.exists()
        if not mine:  # the command that had it ended in this moment, and removed the file
            os.close(number)
            return self.claim(path)
        self.end.callback(os.close, number)
        self.end.callback(lock.unlink, missing_ok=True)
        return not os.path.lexists(path)


def _remove_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


def _named(path: Path) -> Path:
    """A path that can be the name of an output; raises InputError if it cannot."""
    if wrong := _wrong(path):
        raise InputError(f"{path if str(path).strip() else repr(str(path))}: {wrong}")
    return path


def _wrong(path: Path) -> str:
    """Why there can be no output of this name, and what to do; "" if there can."""
    real = Path(os.path.realpath(path))
    home = Path(os.path.expanduser("~"))  # noqa: PTH111 - Path.expanduser raises where there is no home
    for folder, what in ((Path.cwd(), "working"), (home, "home")):
        if real in (folder, *folder.parents):
            return f"is the {what} folder or contains it; give a folder inside it"
    if path.exists() and not (path.is_file() or path.is_dir()):
        return "a device or pipe, which cannot be replaced; give a file"
    if not path.name.strip():
        return "a blank name; give another"
    if _WRITTEN.fullmatch(path.name.lower()):
        return f"a suffix without a name; give one, such as run{path.name}"
    if any("\udc80" <= letter <= "\udcff" for letter in path.name):
        return "its name is not UTF-8, and file formats store names as UTF-8; give another"
    above = next(folder for folder in path.parents if folder.exists())
    if not above.is_dir():
        return f"cannot be written, as {above} is no folder; give another name"
    may = path.is_symlink() or os.access(above, os.W_OK | os.X_OK)  # in place, a link leads elsewhere
    return "" if may else f"cannot be written, as {above.absolute()} is read-only; give a name elsewhere"


def _doomed(folder: Path, new: Path) -> str:
    """A file of the user that would go with a folder; "" if there is none.

    It is an input of the command of which the new folder has no copy, or of a kind that magtwin writes
    nowhere.
    """
    if not folder.is_dir() or folder.is_symlink():
        return ""
    same, inputs = {file.name for file in new.iterdir()}, _inputs.get()
    for file in (file for file in sorted(folder.rglob("*")) if not file.is_dir()):
        part, real = file.relative_to(folder), Path(os.path.realpath(file))
        if real in inputs or {*real.parents}.intersection(inputs):
            if not ((new / part).is_file() and filecmp.cmp(new / part, file, shallow=False)):
                return f"{part}, which is read and"
        elif part.parts[0] not in same and not _WRITTEN.fullmatch(file.suffix.lower()):
            return f"{part}, which"
    return ""


@contextmanager
def output(
    path: str | os.PathLike[str], *, force: bool = False, at_once: bool = False, in_place: bool = False
) -> Iterator[Path]:
    """Write a file or a folder aside; it replaces `path` at the end of the block, or of the transaction.

    Create the file or folder at the yielded path, which has the suffix of `path`. If the block raises,
    nothing is left behind, so no output is ever half-written.

    Args:
        path: The file or folder to make. Its parents are created.
        force: Whether to replace an existing file or folder.
        at_once: Whether it appears at the end of the block even in a transaction.
        in_place: Whether it is a changed version of a file that the command reads.

    Raises:
        InputError: As for `check_free`, or its folder cannot be written, or the disk is full.
    """
    path = check_free(path, force=force, in_place=in_place)
    place = Path.cwd() / path  # absolute, since the working folder can be renamed
    place = Path(os.path.realpath(place)) if in_place else place
    inner = any(HIDDEN in folder.name for folder in place.parents)  # a part of another output
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        prefix = f".{place.name[:60]}{HIDDEN}"  # the whole name could be too long for the disk
        aside = _Aside(place, Path(tempfile.mkdtemp(prefix=prefix, dir=place.parent)), force)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}); give a name elsewhere") from error
    waits = False
    try:
        yield aside.new
        if place.exists() and place.is_dir() != aside.new.is_dir():
            kind = "folder" if place.is_dir() else "file"
            raise InputError(f"{path}: is a {kind}, and the output is not; remove it first")
        if doomed := _doomed(path, aside.new):
            text = "would be removed with it; move it away, remove the folder, or give another name"
            raise InputError(f"{path}: holds {doomed} {text}")
        if not inner:
            _sync(aside.new)
        pending = _pending.get()
        waits = not (pending is None or inner or at_once)
        if pending is not None and waits:
            pending[0].append(aside)
        else:
            _commit([aside])
    except InputError as error:
        text = str(error).replace(str(aside.new), str(path))
        raise InputError(text, parameter=error.parameter) from error
    except Exception as error:  # libraries have errors of their own for a full disk
        if reason := why_full(aside.folder, error):
            raise InputError(
                f"{path}: cannot be written ({reason}); make room there, or give a name elsewhere"
            ) from error
        raise
    finally:
        if not waits:
            shutil.rmtree(aside.folder, ignore_errors=True)


@contextmanager
def reading(files: Iterable[Path]) -> Iterator[None]:
    """A command that reads files and folders: no output of the block removes them, and `free` claims names.

    Files that do not exist are ignored.
    """
    named = set[Path]()
    for file in files:
        with suppress(OSError, ValueError):  # a text that is too long for a name
            named |= {Path(os.path.realpath(file))} if file.exists() else set()
    with ExitStack() as end:
        tokens = _inputs.set(tuple(sorted(named))), _names.set(_Names(end))
        try:
            yield
        finally:
            _inputs.reset(tokens[0])
            _names.reset(tokens[1])


def not_read(value: str | Path) -> None:
    """Take a value out of those of `reading`: it is a name that ships, and not the folder of that name."""
    _inputs.set(tuple(file for file in _inputs.get() if file != Path(os.path.realpath(value))))


@contextmanager
def transaction() -> Iterator[None]:
    """Make the outputs of the block appear at its end: all of them, or none if it raises.

    A transaction inside another one is a part of it. Outputs of other threads do not take part.

    Raises:
        InputError: An output cannot be renamed.
    """
    if _pending.get() is not None:
        yield
        return
    asides, functions = list[_Aside](), list[Callable[[], object]]()
    token = _pending.set((asides, functions))
    try:
        yield
        _commit(asides)
    except OSError as error:
        if error.errno not in FULL:
            raise
        raise InputError(f"the outputs cannot be written ({os.strerror(error.errno)})") from error
    finally:
        _pending.reset(token)
        for aside in asides:
            shutil.rmtree(aside.folder, ignore_errors=True)
    for function in functions:
        function()


def afterwards(function: Callable[[], object]) -> None:
    """Call a function once all outputs of the transaction are in their places; outside of one, now."""
    pending = _pending.get()
    if pending is None:
        function()
    else:
        pending[1].append(function)


@dataclass(frozen=True, eq=False)
class _Aside:
    """An output in its hidden folder, its place, and whether it may replace what is there."""

    place: Path
    folder: Path
    force: bool

    @property
    def new(self) -> Path:
        """The output until it is renamed."""
        return self.folder / self.place.name

    @property
    def old(self) -> Path:
        """What it replaces, from the renaming on."""
        return self.folder / ".old"

    def swap(self) -> None:
        """Rename the output to its place, and keep what was there."""
        if os.path.lexists(self.place) and self.new.is_dir():
            if exchanged(self.new, self.place):
                try:
                    self.new.rename(self.old)
                except BaseException:
                    exchanged(self.new, self.place)
                    raise
                return
            self.place.rename(self.old)
        elif os.path.lexists(self.place):
            try:
                os.link(self.place, self.old, follow_symlinks=False)
            except (OSError, NotImplementedError):  # a file system or a system without hard links
                self.place.rename(self.old)
        self.new.replace(self.place)

    def undo(self) -> None:
        """Take back a `swap`, which may have been broken off."""
        if not os.path.lexists(self.new):
            self.place.rename(self.new)
        if os.path.lexists(self.old) and not os.path.lexists(self.place):
            self.old.rename(self.place)


def _commit(asides: list[_Aside]) -> None:
    """Rename outputs to their places: all, or none."""
    begun: list[_Aside] = []
    try:
        for aside in asides:
            if not aside.force and os.path.lexists(aside.place):
                text = "another process has made it in the meantime; give another name"
                raise InputError(f"{aside.place}: {text}")
            begun.append(aside)
            aside.swap()
    except BaseException:
        for aside in reversed(begun):
            aside.undo()
        raise
    for parent in {aside.place.parent for aside in asides}:
        _sync(parent, inside=False)


def exchanged(one: Path, other: Path) -> bool:
    """Let two folders change places at one moment; False where the system cannot (renameat2 of Linux)."""
    here, exchange = -100, ctypes.c_uint(2)
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    return rename(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0


def why_full(folder: Path, error: Exception | None = None) -> str:
    """In which way the disk of a folder is full, or was when an error was raised; "" if it is not."""
    number = error.errno if isinstance(error, OSError) else None
    if full := [os.strerror(f) for f in FULL if f == number or os.strerror(f) in str(error)]:
        return full[0]
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(1 << 16))
            file.flush()
            os.fsync(file.fileno())
    except OSError as probe:
        return os.strerror(probe.errno) if probe.errno in FULL else ""
    return ""


def _sync(path: Path, *, inside: bool = True) -> None:
    """Bring a file, or a folder with its names and all that is inside, to the disk."""
    if path.is_symlink() or not path.exists():
        return
    for child in path.iterdir() if inside and path.is_dir() else ():
        _sync(child)
    with suppress(OSError) if path.is_dir() else nullcontext():  # not every system can for a folder
        number = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)
