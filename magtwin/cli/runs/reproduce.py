"""`magtwin reproduce`."""

from dataclasses import replace
from pathlib import Path

from magtwin.cli.app import app
from magtwin.cli.options import RunScene
from magtwin.cli.terminal import Done, announce, print_report, say


@app.command
def reproduce(file: Path, *, scene: RunScene = None) -> Done:
    """Reproduce a run from its metadata and report whether the bytes match.

    It names what has changed since (scene, map, network, versions), and each column that differs and by how
    much. Exit status: 0 if all columns are equal, else 1.

    Parameters
    ----------
    file
        A run in any format that magtwin writes.
    """
    from magtwin.io.provenance import repeat_of

    announce("Reproducing the run")
    found = repeat_of(file, scene)
    report = found.report(f"{file}, reproduced")

    def table() -> None:
        for cause in found.causes:
            say(cause)
        print_report(replace(report, metadata={}))

    return Done(report, table=table, status=0 if found.equal else 1)
