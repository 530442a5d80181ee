"""`magtwin schema` and `magtwin upgrade`."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from magtwin.cli.app import app
from magtwin.cli.options import Force
from magtwin.cli.terminal import Done


@app.command
def schema(*, out: Path | None = None, force: Force = False) -> Done:
    """Print the folder of magtwin's USD schemas, for PXR_PLUGINPATH_NAME; or copy it for another machine.

    usdview, Kit and any other program of OpenUSD then show the attributes with names, groups, units and
    fallbacks: see docs/schema.md.

    Parameters
    ----------
    out
        Folder to make, with plugInfo.json, generatedSchema.usda and schema.usda.
    """
    from magtwin.usd.schema import FOLDER, publish
    from magtwin.usd.schema.versions import TEXT

    data = {"version": TEXT, "folder": str(FOLDER if out is None else out)}
    if out is None:
        return Done(text=str(FOLDER), data=data)
    publish(out, force=force)
    return Done(wrote=out, data=data)


@app.command
def upgrade(*files: Annotated[Path, Parameter(required=True)]) -> Done:
    """Rewrite stages, robots and maps that an older magtwin wrote with the attribute names of today.

    Every layer that a file names is rewritten in its place, so keep a copy. Values stay as they are.

    Parameters
    ----------
    files
        Stages (.usd, .usda or .usdc).
    """
    from magtwin.usd.upgrade import upgrade as rewrite

    done = list(dict.fromkeys(written for file in files for written in rewrite(file)))
    text = "" if done else "Nothing to do: no layer has names of an older schema"
    return Done(wrote=tuple(done), text=text, data={})
