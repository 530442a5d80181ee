"""Tried: the stages that passed their trial, remembered for later commands in the user's folder of caches.

There is one JSON file for each job of a trial that passed, with the stamp of every file that the trial met.
Refusals are not remembered, nor is a stage with a file so new that a change could leave its times as they
are. What is damaged, or could have been written by another user, is ignored, and the stage is tried again.
"""

import hashlib
import json
import os
import stat
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pxr import Usd

from magtwin.files.children import caches

Stamp = tuple[int, int, int, int, int]
"""Device, number, size and times of change of a file."""

YOUNGEST_S = 2.0
"""Least age of each file at the beginning of its trial [s]: some file systems count time in steps as long."""

MOST = 1000
"""Stages that are remembered at most."""


def stamp_of(file: str) -> Stamp | None:
    """What changes if a file does; None if there is none."""
    try:
        about = Path(file).stat()
    except (OSError, ValueError):  # no name can hold a null character
        return None
    return about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns


def key_of(job: Mapping[str, Any], program: Path) -> str:
    """Name under which a job is remembered: it differs if the job, its program or USD differs."""
    plugins = sorted(item for item in os.environ.items() if item[0].startswith("PXR_"))
    whole = [job, hashlib.sha256(program.read_bytes()).hexdigest(), Usd.GetVersion(), plugins]
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()


def recall(key: str, file: str) -> dict[str, Stamp | None] | None:
    """The files that a trial of the stage `file` met, if it passed and none has changed since; else None."""
    with suppress(OSError, ValueError, TypeError, AttributeError, RecursionError):  # missing or damaged
        text = (_folder() / f"{key}.json").read_text(encoding="utf-8")
        met = {name: None if then is None else tuple(then) for name, then in json.loads(text).items()}
        if met.get(file) is not None and all(stamp_of(name) == then for name, then in met.items()):
            return met
    return None


def keep(key: str, met: Mapping[str, Stamp | None], begun_s: float) -> None:
    """Remember that a trial passed.

    Args:
        key: Name of its job.
        met: Stamps of the files that it met, taken after the trial.
        begun_s: When the trial began, by the clock [s].
    """
    if any(max(stamp[3:]) > (begun_s - YOUNGEST_S) * 1e9 for stamp in met.values() if stamp is not None):
        return
    with suppress(OSError, ValueError):
        folder = _folder(make=True)
        number, aside = tempfile.mkstemp(dir=folder)
        with os.fdopen(number, "w", encoding="utf-8") as out:
            json.dump(met, out)
        Path(aside).replace(folder / f"{key}.json")
        files = sorted(folder.iterdir(), key=lambda file: file.stat().st_mtime_ns)
        for file in files[:-MOST]:
            file.unlink()


def _folder(*, make: bool = False) -> Path:
    """The folder of the memory, which nobody but this user can change.

    Raises:
        OSError: It is missing, or others can change it.
    """
    folder = Path(caches(), "magtwin", "trials")
    if not folder.is_absolute() or not hasattr(os, "getuid"):
        raise FileNotFoundError("there is no home folder, or no owner of files (Windows)")
    if make:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    about = folder.lstat()
    if not stat.S_ISDIR(about.st_mode) or about.st_uid != os.getuid() or about.st_mode & 0o077:
        raise PermissionError(f"{folder}: others can change it")
    return folder
