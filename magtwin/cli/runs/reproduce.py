"""`magtwin rerun-of`: a run made once more, and whether it is the same."""

import sys
from dataclasses import replace
from pathlib import Path

from magtwin.cli.app import app
from magtwin.cli.options import Force, Json
from magtwin.cli.terminal import announce, print_report, say


@app.command
def rerun_of(
    file: Path,
    *,
    scene: Path | None = None,
    out: Path | None = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Reproduce a run from its metadata and report whether the bytes match.

    What changed since (scene, map, network, versions) is named first, then every column that differs and by
    how much. Exit status 0 where all columns are equal, 1 where not.

    Parameters
    ----------
    file
        A run, in any format that magtwin writes.
    scene
        Where its scene lies now; looked for where the run says, from here and from the run's folder, unless
        given.
    out
        Run to write what came out to, in the format of its name.
    force
        Replace what exists.
    json
        Print the verdict as JSON.
    """
    from magtwin.files import check_free
    from magtwin.io.formats import write_run
    from magtwin.io.provenance import repeat_of

    if out is not None:
        check_free(out, force=force)
    steps = announce
    steps("Making it once more")
    found = repeat_of(file, scene)
    if out is not None:
        write_run(found.again, out, force=force)
    report = found.report(f"{file}, made once more")
    if not json:
        for cause in found.causes:
            say(cause)
        report = replace(report, metadata={})
    print_report(report, json)
    if out is not None and not json:
        say(f"Wrote {out}")
    if not found.equal:
        sys.exit(1)
