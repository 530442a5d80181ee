"""Outputs: files and folders that appear whole, or not at all, whatever happens to the process or the disk.

An output is written in a hidden folder beside its place, is brought to the disk, and is then renamed. The
writing process keeps the hidden folder locked. One whose lock is free was left by a process that was killed:
the next process that writes there removes it. If a process is killed while it renames several outputs, the
first ones are new and the others old; each is whole.

A link at the place of an output is itself replaced: what it leads to stays as it is, so that no link in a
stranger's folder leads a write elsewhere. Only a file that is rewritten in its place is found through a link.
"""

import ctypes
import errno
import filecmp
import os
import re
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path

from magtwin.errors import InputError

try:
    import fcntl
except ImportError:  # Windows, where nothing is swept
    fcntl = None  # type: ignore[assignment]

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
"""Errors of a disk that is full or read-only."""

_OURS = ".magtwin-"
"""In the name of every hidden folder."""

_OLD = ".old"
"""What an output replaces, in its hidden folder."""

_AT_FDCWD, _EXCHANGE = -100, 2
"""Arguments of renameat2(2): paths are relative to the working folder; the two files change places."""

_WRITTEN = re.compile(
    r"\.(bin|bmp|csv|dae|db3|exr|gif|glb|gltf|hdr|html|jpe?g|json|mcap|md|mtl|npz|obj|parquet|pgm|ply|png|rrd)"
    r"|\.(safetensors|sdf|stl|svg|tga|tiff?|toml|tum|urdf|usd[acz]?|webp|world|xml|yaml)|"
)
"""Suffixes of files that magtwin writes or copies into folders; none for a licence."""

_PROBE = 1 << 16
"""Bytes that are written to see whether a disk is full."""

_ENDS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that end a command: Ctrl-C, the request to end, and the end of the terminal."""

_asides: set[Path] = set()
"""Hidden folders of this process."""

_swept: set[Path] = set()
"""Folders that this process has swept."""

_inputs: ContextVar[tuple[Path, ...]] = ContextVar("inputs", default=())
"""Files and folders that the command reads, which no output may remove."""

_pending: ContextVar["_Pending | None"] = ContextVar("pending", default=None)
"""What waits for the end of the transaction; None outside of one."""


def check_free(path: str | os.PathLike[str], *, force: bool = False) -> Path:
    """`path` if an output can be made there: it does not exist yet, or `force` is True.

    Raises:
        InputError: It exists and `force` is False, or it is an input of the command. Or it cannot be
            replaced, or be the name of an output.
    """
    path = Path(path)
    kept = _foreign(path) if path.is_dir() and not path.is_symlink() else ""
    if kept and not _wrong(path):
        text = "which would be removed with it; move it away, remove the folder, or give another name"
        raise InputError(f"{path}: {'holds' if force else 'exists already, with'} {kept}, {text}")
    return _free(path, force=force)


def _free(path: Path, *, force: bool, in_place: bool = False) -> Path:
    """As `check_free`, but for files in an existing folder, which the new one may have too."""
    if wrong := _wrong(path):
        raise InputError(f"{path if str(path).strip() else repr(str(path))}: {wrong}")
    _sweep((Path.cwd() / path).parent)
    if os.path.lexists(path) and not force:
        link = " as a link" if path.is_symlink() else ""
        raise InputError(
            f"{path}: exists already{link}; give `force=True` to replace it, or another name",
            parameter="force",
        )
    if not in_place and Path(os.path.realpath(path)) in _inputs.get():
        raise InputError(f"{path}: is read by this command and would be replaced; give another name")
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
    return ""


def _foreign(folder: Path) -> str:
    """A file in a folder that no output has; "" if there is none. Exports have scripts."""
    files = (file for file in sorted(folder.iterdir()) if file.suffix != ".py" and not file.is_dir())
    return next((file.name for file in files if not _WRITTEN.fullmatch(file.suffix.lower())), "")


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
    path = _free(Path(path), force=force, in_place=in_place)
    place = Path.cwd() / path  # absolute, since the working folder can be renamed
    place = Path(os.path.realpath(place)) if in_place else place
    inner = any(folder in place.parents for folder in _asides)  # a part of another output
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        aside = _Aside.beside(place, force=force)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error
    waits = False
    try:
        yield aside.new
        if place.exists() and place.is_dir() != aside.new.is_dir():
            kind = "folder" if place.is_dir() else "file"
            raise InputError(f"{path}: is a {kind}, and the output is not; remove it first")
        _check_replaceable(path, aside.new)
        if not inner:
            _sync(aside.new)
        others = _pending.get()
        if others is None or inner or at_once:
            _commit([aside])
        else:
            others.asides.append(aside)
            waits = True
    except InputError as error:
        if str(aside.new) not in str(error):
            raise
        text = str(error).replace(str(aside.new), str(path))
        raise InputError(text, parameter=error.parameter) from error
    except Exception as error:  # libraries have errors of their own for a full disk
        if reason := why_full(aside.folder, error):
            raise InputError(f"{path}: cannot be written ({reason})") from error
        raise
    finally:
        if not waits:
            aside.remove()


def _check_replaceable(folder: Path, new: Path) -> None:
    """Refuse to replace a folder with files of the user: inputs, or of a kind that magtwin writes nowhere.

    Raises:
        InputError: It holds an input, and the new folder no copy of it; or a file of another suffix, and the
            new folder none of its name.
    """
    if not folder.is_dir() or folder.is_symlink():
        return
    real = Path(os.path.realpath(folder))
    for file in _inputs.get():
        if real in file.parents and not _is_copy(new / file.relative_to(real), file):
            raise InputError(
                f"{folder}: holds {file.relative_to(real)}, which is read and would be removed with it; give "
                "another name"
            )
    same = {file.name for file in new.iterdir()}
    for file in folder.rglob("*"):
        part = file.relative_to(folder)
        if part.parts[0] not in same and not _WRITTEN.fullmatch(file.suffix.lower()) and not file.is_dir():
            raise InputError(
                f"{folder}: holds {part}, which would be removed with it; move it away, remove the folder, "
                "or give another name"
            )


def _is_copy(copy: Path, file: Path) -> bool:
    """Whether a file has the content of another one, or is a folder as that is."""
    if copy.is_file() and file.is_file():
        return filecmp.cmp(copy, file, shallow=False)
    return copy.is_dir() and file.is_dir()


@contextmanager
def reading(files: Iterable[Path]) -> Iterator[None]:
    """Let no output of the block remove these files and folders; those that do not exist are ignored."""
    named = {os.path.realpath(file) for file in files if _is_there(file)}
    token = _inputs.set(tuple(map(Path, sorted(named))))
    try:
        yield
    finally:
        _inputs.reset(token)


def not_read(value: str | Path) -> None:
    """Take a value out of those of `reading`: it is a name that ships, and not the folder of that name."""
    real = Path(os.path.realpath(value))
    _inputs.set(tuple(file for file in _inputs.get() if file != real))


def _is_there(file: Path) -> bool:
    try:
        return file.exists()
    except (OSError, ValueError):  # a text that is too long for a name
        return False


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
    pending = _Pending()
    token = _pending.set(pending)
    try:
        yield
        _commit(pending.asides)
    except OSError as error:
        if error.errno not in FULL:
            raise
        raise InputError(f"the outputs cannot be written ({os.strerror(error.errno)})") from error
    finally:
        _pending.reset(token)
        for aside in pending.asides:
            aside.remove()
    for function in pending.functions:
        function()


@contextmanager
def at_once() -> Iterator[None]:
    """Make outputs of the block appear at once, even in a transaction."""
    token = _pending.set(None)
    try:
        yield
    finally:
        _pending.reset(token)


def afterwards(function: Callable[[], object]) -> None:
    """Call a function once all outputs of the transaction are in their places; outside of one, now."""
    pending = _pending.get()
    if pending is None:
        function()
    else:
        pending.functions.append(function)


@dataclass
class _Pending:
    """What waits for the end of a transaction."""

    asides: "list[_Aside]" = field(default_factory=list)
    functions: list[Callable[[], object]] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _Aside:
    """A hidden folder in which an output is written."""

    place: Path
    """Where the output is to be."""

    folder: Path

    lock: int = -1
    """File descriptor of the lock; -1 if it is not held."""

    force: bool = True
    """Whether it may replace what is there."""

    @classmethod
    def beside(cls, place: Path, *, force: bool) -> "_Aside":
        """A new folder beside a place."""
        name = place.name[:60]  # a longer one with what is added could be too long for the disk
        while True:
            folder = Path(tempfile.mkdtemp(prefix=f".{name}{_OURS}", dir=place.parent))
            lock = _locked(folder)
            if folder.exists():  # no other process swept it before it was locked
                _asides.add(folder)
                return cls(place, folder, lock, force)

    @property
    def new(self) -> Path:
        """The output until it is renamed."""
        return self.folder / self.place.name

    @property
    def old(self) -> Path:
        """What it replaces, until that is removed."""
        return self.folder / _OLD

    def swap(self, *, keep: bool) -> None:
        """Rename the output to its place; `keep` an old file, so that `undo` can put it back."""
        if self.place.is_dir():
            if exchanged(self.new, self.place):
                return
            self.place.rename(self.old)
            try:
                self.new.rename(self.place)
            except BaseException:
                self.old.rename(self.place)
                raise
            return
        if keep and os.path.lexists(self.place):
            try:
                os.link(self.place, self.old, follow_symlinks=False)
            except OSError:  # a file system without hard links
                shutil.copy2(self.place, self.old, follow_symlinks=False)
        self.new.replace(self.place)

    def undo(self) -> None:
        """Take a `swap` back."""
        if os.path.lexists(self.new) and exchanged(self.new, self.place):
            return
        if (self.old.is_file() or self.old.is_symlink()) and not self.place.is_dir():
            self.old.replace(self.place)
            return
        self.place.rename(self.new)
        if self.old.exists():
            self.old.rename(self.place)

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)
        _asides.discard(self.folder)
        if self.lock >= 0:
            os.close(self.lock)


def _commit(asides: list[_Aside]) -> None:
    """Rename outputs to their places: all, or none."""
    with _uninterrupted():
        done: list[_Aside] = []
        try:
            for aside in asides:
                if not aside.force and os.path.lexists(aside.place):
                    raise InputError(
                        f"{aside.place}: another process has made it in the meantime; give another name"
                    )
                aside.swap(keep=len(asides) > 1)
                done.append(aside)
        except BaseException:
            for aside in reversed(done):
                aside.undo()
            raise
        for parent in {aside.place.parent for aside in asides}:
            _sync_entry(parent)


def _sweep(parent: Path) -> None:
    """Remove what killed processes left in a folder; once a process."""
    if fcntl is None or parent in _swept or not parent.is_dir():
        return
    _swept.add(parent)
    for folder in parent.glob(f".*{_OURS}*"):
        with suppress(OSError):  # no folder, or that of a living process or of another user
            lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _clear(folder)
            finally:
                os.close(lock)


def _clear(folder: Path) -> None:
    """Remove a hidden folder, and put back an older output that was moved out of the way for a new one."""
    old = folder / _OLD
    for new in folder.iterdir():
        place = folder.with_name(new.name)
        if new != old and old.is_dir() and not os.path.lexists(place):
            old.rename(place)
    shutil.rmtree(folder, ignore_errors=True)


def _locked(folder: Path) -> int:
    """Lock a folder as long as this process lives; its file descriptor, -1 where folders have no locks."""
    if fcntl is None:
        return -1
    try:
        lock = os.open(folder, os.O_RDONLY)
    except FileNotFoundError:  # swept
        return -1
    with suppress(OSError):  # a file system without locks
        fcntl.flock(lock, fcntl.LOCK_EX)
    return lock


def exchanged(one: Path, other: Path) -> bool:
    """Let two folders change places at one moment; False where the system cannot."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    return rename(_AT_FDCWD, os.fsencode(one), _AT_FDCWD, os.fsencode(other), ctypes.c_uint(_EXCHANGE)) == 0


def why_full(folder: Path, error: Exception | None = None) -> str:
    """In which way the disk of a folder is full, or was when an error was raised; "" if it is not."""
    number = error.errno if isinstance(error, OSError) else None
    reasons = [os.strerror(full) for full in FULL if full == number or os.strerror(full) in str(error)]
    if reasons:
        return reasons[0]
    try:
        with tempfile.TemporaryFile(dir=folder, buffering=0) as file:
            while file.write(bytes(_PROBE)) < _PROBE:
                pass
            os.fsync(file.fileno())
    except OSError as probe:
        return os.strerror(probe.errno) if probe.errno in FULL else ""
    return ""


def _sync(path: Path) -> None:
    """Bring a file, or all in a folder, to the disk."""
    if path.is_dir() and not path.is_symlink():
        for child in path.iterdir():
            _sync(child)
        _sync_entry(path)
    elif path.is_file():
        with open(path, "rb") as file:
            os.fsync(file.fileno())


def _sync_entry(folder: Path) -> None:
    """Bring the names in a folder to the disk, where the system can."""
    if os.name == "nt":
        return
    with suppress(OSError):
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Delay the signals `_ENDS` to the end of the block."""
    if threading.current_thread() is not threading.main_thread():  # Python interrupts the main thread only
        yield
        return
    came: list[int] = []
    before = {sign: signal.getsignal(sign) for sign in _ENDS}
    before = {sign: handler for sign, handler in before.items() if handler is not None}
    for sign in before:
        signal.signal(sign, lambda number, frame: came.append(number))
    try:
        yield
    finally:
        for sign, handler in before.items():
            signal.signal(sign, handler)
        for number in dict.fromkeys(came):
            signal.raise_signal(number)
