"""Packages: write and read .usdz files, by OpenUSD's "Usdz File Format Specification".

A package is a ZIP archive without compression. The data of each entry start at a multiple of 64 bytes. The
first entry is the layer to open. It may hold only layers, pictures and sounds.
"""

import shutil
import struct
import zipfile
from pathlib import Path, PurePosixPath

from magtwin.errors import InputError
from magtwin.files.budget import check_count
from magtwin.files.file import existing_file
from magtwin.usd.layers import SUFFIXES

ALLOWED = (*SUFFIXES, ".png", ".jpg", ".jpeg", ".exr", ".avif", ".m4a", ".mp3", ".wav")
"""Suffixes of files that a package may hold."""

ALIGNMENT = 64
"""Alignment of entries [bytes], so that USD can map arrays into memory."""

MOST_BYTES = 2**32 - 1
"""Largest size of a ZIP archive without ZIP64, which a package must not use."""

_HEADER = 30
_PADDING = 0x1986
"""Bytes of an entry's header before its name, and the identifier of the extra field that pads it."""

_DAY = (1980, 1, 1, 0, 0, 0)
"""The first date of ZIP, so that the same folder always makes the same bytes."""


def pack(root: Path, out: Path) -> None:
    """Write a stage's folder as a package.

    Args:
        root: The layer to open; all files of its folder are packed, except hidden ones.
        out: The .usdz file to make.

    Raises:
        InputError: A file is of another kind, or the package would be too large.
    """
    folder = root.parent
    hidden = {f for f in folder.rglob("*") if any(p.startswith(".") for p in f.relative_to(folder).parts)}
    files = sorted(f for f in folder.rglob("*") if f.is_file() and f not in hidden)
    for file in files:
        if file.suffix.lower() not in ALLOWED:
            raise InputError(
                f"{file.relative_to(folder)}: a .usdz may hold {', '.join(ALLOWED)}, and no other file; "
                "export to a folder, or convert it"
            )
    if sum(file.stat().st_size + 1024 for file in files) > MOST_BYTES:
        raise InputError(f"{out}: a .usdz holds at most 4 GiB; export to a folder")
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED, allowZip64=False) as archive:
        for file in (root, *(f for f in files if f != root)):
            entry = zipfile.ZipInfo(file.relative_to(folder).as_posix(), _DAY)
            entry.create_system, entry.external_attr = 3, 0o644 << 16
            assert archive.fp is not None
            begin = archive.fp.tell() + _HEADER + len(entry.filename.encode())
            fill = -(begin + 4) % ALIGNMENT
            entry.extra = struct.pack("<HH", _PADDING, fill) + bytes(fill)
            archive.writestr(entry, file.read_bytes())


def unpack(package: Path, folder: Path) -> Path:
    """Unpack a package into a folder.

    Args:
        package: The .usdz file.
        folder: An existing empty folder.

    Returns:
        The layer to open.

    Raises:
        InputError: The file is no package or is damaged, or an entry is outside the folder or of another
            kind.
    """
    existing_file(package, "package", "package")
    try:
        with zipfile.ZipFile(package) as archive:
            check_count(package, "package", len(archive.infolist()), "files")
            entries = [entry for entry in archive.infolist() if not entry.filename.endswith("/")]
            _check(package, entries)
            for entry in entries:
                place = folder / entry.filename
                place.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(entry) as source, open(place, "xb") as file:
                    shutil.copyfileobj(source, file)  # checks the CRC
    except (zipfile.BadZipFile, EOFError, NotImplementedError, struct.error, OSError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        raise InputError(f"{package}: damaged, or no .usdz: {reason}; copy or write it again") from error
    return folder / entries[0].filename


def _check(package: Path, entries: list[zipfile.ZipInfo]) -> None:
    """Check a package before anything is written."""
    if not entries or PurePosixPath(entries[0].filename).suffix.lower() not in SUFFIXES:
        raise InputError(f"{package}: no .usdz: its first entry is no layer; write it again")
    seen: set[str] = set()
    for entry in entries:
        name = entry.filename
        path = PurePosixPath(name)
        climbs = path.is_absolute() or ".." in path.parts or "\\" in name or ":" in name or "\0" in name
        if climbs or entry.orig_filename != name:
            raise InputError(
                f"{package}: its entry {entry.orig_filename!r} would be written outside its folder; the "
                "package may be malicious"
            )
        if path.as_posix().lower() in seen:
            raise InputError(f"{package}: holds {name!r} twice; write it again")
        seen.add(path.as_posix().lower())
        if entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1:
            raise InputError(
                f"{package}: its entry {name!r} is compressed or encrypted, which a .usdz must not be; pack "
                "it again with `magtwin export`"
            )
        if path.suffix.lower() not in ALLOWED:
            raise InputError(f"{package}: holds {name!r}, which a .usdz must not; pack it again without")
    size = package.stat().st_size
    if sum(entry.file_size for entry in entries) > size:
        raise InputError(f"{package}: its entries say that they are larger than it is; it is damaged")
