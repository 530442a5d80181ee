"""`magtwin reproduce`."""

from dataclasses import replace
from pathlib import Path

from magtwin.cli.app import app
from magtwin.cli.options import Force, RunScene
from magtwin.cli.terminal import Done, announce, print_report, say


@app.command
def reproduce(file: Path, *, scene: RunScene = None, out: Path | None = None, force: Force = False) -> Done:
    """Reproduce a run from its metadata and report whether the bytes match.

    It names what has changed since (scene, map, network, versions), and each column that differs and by how
    much. Exit status: 0 if all columns are equal, else 1.

    Parameters
    ----------
    file
        A run in any format that magtwin writes.
    out
        Run to write the result to, in the format of its name.
    """
    from magtwin.files.outputs import check_free
    from magtwin.io.formats import format_to_write, write_run
    from magtwin.io.provenance import repeat_of

    if out is not None:
        format_to_write(check_free(out, force=force))
    announce("Reproducing the run")
    found = repeat_of(file, scene)
    if out is not None:
        write_run(found.again, out, force=force)
    report = found.report(f"{file}, reproduced")

    def table() -> None:
        for cause in found.causes:
            say(cause)
        print_report(replace(report, metadata={}))

    return Done(report, out or (), table=table, status=0 if found.equal else 1)
