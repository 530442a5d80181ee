"""Fetch original data from their publishers; each file is checked against its SHA-256.

magtwin ships none of them. Each source is a table: name, checksum, and path in a repository at a pinned
commit.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from magtwin.errors import InputError, find
from magtwin.export.validation.isaac_sim import FILES, copy_folder
from magtwin.files.file import sha256
from magtwin.files.outputs import output

UNSTATED = "NOASSERTION"
"""SPDX's word for a licence that the publisher does not state."""

_GITHUB = "https://raw.githubusercontent.com"


@dataclass(frozen=True)
class Source:
    """A table of published files."""

    table: str
    """File beside this module, or a path; each line has name, SHA-256, and path below `base_url`."""

    base_url: str
    """Address to which the paths are appended."""

    licence: str
    """SPDX identifier of the licence."""

    def files(self) -> list[tuple[str, str, str]]:
        """Name, SHA-256 and path of each file."""
        text = (Path(__file__).parent / self.table).read_text(encoding="utf-8")
        lines = (line.split() for line in text.splitlines() if line and not line.startswith("#"))
        return [(name, checksum, path) for name, checksum, path in lines]


SOURCES = {
    "aprilab": (
        Source(
            "aprilab.txt",
            f"{_GITHUB}/aprilab-uf/nn_magnetometer/f81ff6c533745b62d97cf9f4775848d86f9e73b5",
            "MIT",
        ),
    ),
    "isaac-rules": (
        Source(
            str(FILES),
            f"{_GITHUB}/isaac-sim/IsaacSim/045ca8b59622b99a408092124377c66346e8d9c2",
            "Apache-2.0",
        ),
    ),
    "turtlebot4": (
        Source(
            "turtlebot4.txt",
            f"{_GITHUB}/turtlebot/turtlebot4/d6881758863264ca32cf2a965c2a0ddfb2cc3094",
            "Apache-2.0",
        ),
        Source(
            "create3.txt",
            f"{_GITHUB}/iRobotEducation/create3_sim/6a8bc44f9be2c260bc17e753c31455d6759af238",
            "BSD-3-Clause",
        ),
    ),
    "magnetic-data": (
        Source(
            "magnetic_data.txt",
            f"{_GITHUB}/AaltoML/magnetic-data/b45da3bc7ab623fdef6e01247021daebf7983f29",
            UNSTATED,
        ),
    ),
    "magslam": (
        Source(
            "magslam_ship.txt",
            f"{_GITHUB}/fridaviset/EKFMagSLAM/77a390260052f7d73d8cc31b750d388764386869",
            UNSTATED,
        ),
        Source(
            "magslam_1d.txt",
            f"{_GITHUB}/manonkok/1d-magnetic-field-slam/2cd608c6403d46c392a5c61d9bbf567861d7c2c4",
            "MIT",
        ),
    ),
}
"""Sources by name: the APRILab survey, network and paths; Isaac Sim's rules for assets; the TurtleBot 4's
description; drives of a robot with a magnetometer and true positions; recordings with published results of
magnetic SLAM."""


def default_folder(name: str) -> Path:
    """Folder of a source if none is given: its name, or for Isaac Sim's rules where `validate` finds them."""
    return copy_folder() if name == "isaac-rules" else Path(name)


def is_complete(name: str, folder: Path) -> bool:
    """Whether a folder has all files of a source, with the pinned checksums."""
    files = [each for source in find("source", name, SOURCES) for each in source.files()]
    return all((folder / file).is_file() and sha256(folder / file) == checksum for file, checksum, _ in files)


def fetch(
    name: str,
    dest: Path,
    *,
    base_url: str | None = None,
    force: bool = False,
    progress: Callable[[int, int, str], None] = lambda done, total, file: None,
) -> list[Path]:
    """Fetch a source into a new folder.

    Args:
        name: An entry of SOURCES.
        dest: Folder to make; it is removed if a file is missing or wrong.
        base_url: Address of a mirror with the same paths. Default: the publisher.
        force: Replace an existing folder.
        progress: Called with the number of files done, the number of all files, and the next file name.

    Returns:
        The files written.

    Raises:
        InputError: The source is unknown, a file cannot be fetched, or its checksum is wrong.
    """
    import pooch

    sources = find("source", name, SOURCES)
    if base_url is not None and urlsplit(base_url).scheme not in ("http", "https"):
        raise InputError(f"--base-url {base_url!r}: must begin with http:// or https://")
    jobs = [
        (file, checksum, f"{(base_url or source.base_url).rstrip('/')}/{path}")
        for source in sources
        for file, checksum, path in source.files()
    ]
    downloader = pooch.HTTPDownloader(timeout=30)
    pooch.get_logger().setLevel("ERROR")
    with output(dest, force=force) as folder:
        for done, (file, checksum, url) in enumerate(jobs):
            progress(done, len(jobs), file)
            target = folder / file
            try:
                pooch.retrieve(
                    url, f"sha256:{checksum}", fname=target.name, path=target.parent, downloader=downloader
                )
            except ValueError as error:  # pooch: the checksum differs
                raise InputError(f"{url}: its SHA-256 is not {checksum}; nothing was kept") from error
            except OSError as error:  # requests' exceptions are OSErrors
                cause = re.search(r"\[Errno -?\d+\] ([^'\")]+)", str(error))
                reason = cause[1] if cause else str(error).split("\n")[0]
                text = f"{url}: could not be fetched ({reason}); nothing was kept; try again with a network"
                raise InputError(f"{text}, or from a mirror with `base_url`") from error
        progress(len(jobs), len(jobs), "")
    return [dest / file for file, _, _ in jobs]
