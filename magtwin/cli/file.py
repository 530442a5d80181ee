"""`magtwin info`, `view` and `fetch`: what a file holds, how it looks, where the originals come from."""

from pathlib import Path
from typing import Any, Literal

from magtwin.cli.app import app
from magtwin.cli.terminal import Force, Json, print_report, progress, say
from magtwin.names import RefusedError


@app.command
def info(file: Path, *, json: Json = False) -> None:
    """Say what a stage, a map, a run or a network holds.

    Parameters
    ----------
    file
        A .usd, .usda, .usdc, .usdz, .parquet, .safetensors or .pth file.
    json
        Print it as JSON.
    """
    from magtwin.files import existing
    from magtwin.names import find

    existing(file, "file")
    suffixes: dict[str, Any] = {
        ".usd": _info_of_usd,
        ".usda": _info_of_usd,
        ".usdc": _info_of_usd,
        ".usdz": _info_of_usd,
        ".parquet": _info_of_run,
        ".safetensors": _info_of_net,
        ".pth": _info_of_net,
    }
    if file.is_dir():
        raise RefusedError(f"{file}: a folder; name a file in it, or use `magtwin map info` for a survey")
    print_report(find("kind of file", file.suffix, suffixes)(file), json)


@app.command
def view(file: Path) -> None:
    """Open a recording, or the series of a run, in the Rerun viewer.

    Parameters
    ----------
    file
        A .rrd file, or a .parquet file of a run.
    """
    from magtwin.io.rerun import view as view_rrd

    view_rrd(file)


@app.command
def fetch(
    what: Literal["aprilab", "turtlebot4"],
    *,
    dest: Path | None = None,
    base_url: str | None = None,
    force: Force = False,
) -> None:
    """Fetch the originals, at a pinned commit, each file checked against its SHA-256.

    Parameters
    ----------
    what
        aprilab: the survey, the released network and paths (MIT). turtlebot4: the description packages
        (Apache-2.0, BSD-3-Clause).
    dest
        Folder to make; named after the source unless given.
    base_url
        Address of a mirror with the same paths.
    force
        Replace the folder if it exists.
    """
    from magtwin.fetch import fetch as fetch_files

    dest = dest or Path(what)
    with progress(f"Fetching {what}") as advance:
        files = fetch_files(what, dest, base_url=base_url, force=force, progress=advance)
    say(f"Wrote {len(files)} files to {dest}")


def _info_of_usd(file: Path) -> Any:
    from magtwin.usd.info import info_of_stage

    return info_of_stage(file)


def _info_of_run(file: Path) -> Any:
    from magtwin.io.tables import read_parquet

    return read_parquet(file).report(str(file))


def _info_of_net(file: Path) -> Any:
    from magtwin.learn.model import load_net

    return load_net(file).report(str(file))
