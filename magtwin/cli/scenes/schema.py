"""`magtwin schema`."""

from pathlib import Path

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
    from magtwin.files.outputs import free
    from magtwin.usd.schema import FOLDER, publish
    from magtwin.usd.schema.versions import TEXT

    if out is None:
        return Done(text=str(FOLDER), data={"version": TEXT, "folder": str(FOLDER)})
    (out,) = free(out, force=force)
    publish(out, force=force)
    return Done(wrote=out, data={"version": TEXT, "folder": str(out)})
