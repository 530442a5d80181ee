"""`magtwin new`: a scene's TOML to start from."""

from pathlib import Path

from magtwin.cli.app import app
from magtwin.cli.options import Force
from magtwin.cli.terminal import check_suffix, say


@app.command
def new(file: Path, *, force: Force = False) -> None:
    """Write a TOML that describes a small furnished room, with comments on what can be changed.

    It works as it stands: `magtwin new room.toml && magtwin scene room.toml --out room`.

    Parameters
    ----------
    file
        TOML file to write; the scene gets its name.
    force
        Replace the file if it exists.
    """
    from magtwin.twin import new_scene

    check_suffix(file, (".toml",), "a scene's description")
    new_scene(file, force=force)
    folder = file.with_suffix("")
    say(f"Wrote {file}\nNext:  magtwin scene {_quoted(file)} --out {_quoted(folder)}")
    say(f"       magtwin run {_quoted(folder / f'{file.stem}.usda')}")


def _quoted(path: Path) -> str:
    """A path as a shell takes it."""
    import shlex

    return shlex.quote(str(path))
